"""Look-ahead planning: the path at the highest speed that the axes and corners allow, braking in time.

The profile ``trapezoidal`` keeps each axis' speed and acceleration; ``jerk_limited`` passes the length of path through
a moving average as long as the jerk requires, which keeps the path, makes ramps S-shaped and rounds corners smoothly.
Decisions are final: a part is released only when no further motion can slow it down.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.program.motions import ORIGIN, Arc, Dwell, Feed, Motion, Rapid, reached
from fdhil.program.planner import speed
from fdhil.program.planner.corners import CornerRules
from fdhil.program.planner.curve import Curve
from fdhil.program.planner.limits import TICK_TOLERANCE, AxisLimits, check_duration
from fdhil.program.planner.pieces import LENGTH, LINE, RAPID, WIDTH, Row, piece
from fdhil.records import Float, Int

_BATCH = 512  # pieces planned together
_MOST = 4096  # pieces that may wait for their successors; beyond that a stop after them is assumed
_SHARP_ROWS = 1.5
_BATCH_ROWS = 1 << 18


@dataclass(frozen=True, slots=True)
class Stretch:
    """Phases of speed for the rows from ``first_row`` to before ``end_row``; ``place`` is 2 line + rapid."""

    table: Float
    first_row: int
    end_row: int

    def sample(self, rows: Int, dt_s: float) -> Float:
        """Return length of path in mm, source line and rapid (0 or 1) at SYNC ``rows`` (n,): (n, 3)."""
        path, place = speed.at(self.table, np.asarray(rows * dt_s), TICK_TOLERANCE * dt_s)
        return np.column_stack([path, place // 2, place % 2])


class LookAhead:
    """Plans the speeds of motions, from rest at machine zero; ``curve`` has the points of the path.

    ProgramError if they last longer than ``max_rows``.
    """

    def __init__(self, config: MachineConfig, max_rows: float = math.inf) -> None:
        self._limits = limits = AxisLimits.of(config)
        self._dt_s = limits.dt_s
        self._max_s = max_rows * self._dt_s
        self._rapid_stop = config.nc.rapid_stop
        self._stop_always = config.nc.corner == "exact_stop"
        smooth = config.nc.profile == "jerk_limited"
        self.filter_rows = _filter_rows(config, limits) if smooth else 1
        self._filter_s = self.filter_rows * self._dt_s if smooth else 0.0
        fastest = math.hypot(*(v for v in limits.speed if math.isfinite(v)))
        self._reach_mm = fastest * self._filter_s / 2.0
        self._settle_rows = self.filter_rows - 1 + limits.rows(config.nc.settle_s)
        self._end_rows = self.filter_rows + limits.rows(config.nc.end_rest_s)
        self._rules = CornerRules(limits, self._filter_s)
        self.curve = Curve(smooth)
        self._at = ORIGIN
        self._new: list[Row] = []
        self._last = np.empty((0, WIDTH))  # the newest piece of the curve, unless a stop followed it
        self._stops_after = False
        self._before_rapid: float | None = None
        self._ends = np.empty((0, 2))  # of unreleased pieces: path at their end, and place
        self._ahead = np.empty((0, 4))  # limits of speed that still apply
        self._path_mm = self._planned_mm = self._energy = 0.0
        self._now_s = 0.0
        self._place = 0.0
        self._table: list[Float] = [np.zeros((1, 5))]
        self._row = 0

    def stretches(self, motions: Iterable[Motion]) -> Iterator[Stretch]:
        """Yield the phases of all motions, the rest before them and the settling after them."""
        for motion in motions:
            if isinstance(motion, Dwell):
                self._dwell(motion)
            else:
                self._take(motion)
            if len(self._new) >= _BATCH:
                self._plan(stop=False)
            if sum(map(len, self._table)) > 8 * _BATCH or self._now_s / self._dt_s - self._row > _BATCH_ROWS:
                yield self._due()
        self._stop(self._end_rows)
        self._now_s += self._dt_s
        yield self._due()

    def _due(self) -> Stretch:
        end_row = max(self._row, self._limits.rows(self._now_s))
        stretch = Stretch(np.concatenate(self._table), self._row, end_row)
        self._row = end_row
        self._table = [stretch.table[-1:]]
        return stretch

    def _take(self, motion: Rapid | Feed | Arc) -> None:
        row = piece(motion, self._at, self._limits)
        self._at = reached(motion, self._at)
        if row is None:
            return
        changes = self._rapid_stop and self._before_rapid is not None and self._before_rapid != row[RAPID]
        if self._stops_after or changes:
            self._stop(self._settle_rows)
        self._stops_after = self._stop_always or motion.corner.mode == "exact_stop"
        self._before_rapid = row[RAPID]
        self._new.append(row)

    def _dwell(self, motion: Dwell) -> None:
        self._stop(self._settle_rows)
        self._place = 2.0 * motion.line
        self._hold(self._limits.rows(motion.seconds))

    def _stop(self, rows: int) -> None:
        """Plan to a stop, and rest until the next row and ``rows`` more."""
        self._plan(stop=True)
        self._last = np.empty((0, WIDTH))
        self._ends, self._ahead = np.empty((0, 2)), np.empty((0, 4))
        self._stops_after, self._before_rapid = False, None
        self._hold(rows)

    def _hold(self, rows: int) -> None:
        end_row = self._limits.rows(self._now_s) + rows
        self._table.append(np.array([[self._now_s, self._planned_mm, 0.0, 0.0, self._place]]))
        self._pass_time(end_row * self._dt_s)

    def _pass_time(self, now_s: float) -> None:
        self._now_s = now_s
        check_duration(int(self._place) // 2, now_s, self._max_s)

    def _plan(self, stop: bool) -> None:
        if self._new:
            self._learn()
        last = self._path_mm if stop else self._sure_mm()
        if not last > self._planned_mm:
            return
        cuts, at_cut, between, acceleration = speed.grid(self._ahead, self._ends[:, 0], self._planned_mm, last)
        gain = 2.0 * acceleration * np.diff(cuts)
        energy = speed.energies(at_cut, gain, self._energy, 0.0)
        count = between.size
        if not stop:
            free = speed.energies(at_cut, gain, self._energy, math.inf)
            count = int(np.argmin(np.append(energy == free, False))) - 1
            if count <= 0 and len(self._ends) > _MOST:
                count = between.size // 2
        if count > 0:
            self._give(cuts[: count + 1], energy[: count + 1], between[:count], acceleration[:count])

    def _learn(self) -> None:
        new = np.array(self._new)
        pieces = np.concatenate([self._last, new])
        self._new, self._last = [], pieces[-1:]
        corners = self._rules.corners(pieces)
        first = pieces.shape[0] - new.shape[0]  # 0 if the first piece begins at rest
        half = np.concatenate([np.zeros(1 - first), corners.half])
        self.curve.add(new, half)
        ends = self._path_mm + np.cumsum(new[:, LENGTH])
        begins = np.concatenate([[self._path_mm], ends[:-1]])  # identical numbers, so that no gap remains
        self._path_mm = float(ends[-1])
        along, acceleration = self._rules.pieces(new)
        turns = begins[1 - first :]
        # constant speed around a sharp corner over the span of a third difference, so that nothing adds to its step
        around = np.maximum(corners.half, _SHARP_ROWS * self._dt_s * corners.speed)
        limits = [
            np.column_stack([begins, ends, along, acceleration]),
            np.column_stack([turns - around, turns + around, corners.speed, corners.acceleration]),
        ]
        self._ahead = np.concatenate([self._ahead, speed.widened(np.concatenate(limits), self._filter_s)])
        self._ends = np.concatenate([self._ends, np.column_stack([ends, 2.0 * new[:, LINE] + new[:, RAPID]])])

    def _sure_mm(self) -> float:
        """Return the path length up to which no future motion can set a limit."""
        reach = self._last[0, LENGTH] / 2.0 if self._last.size else 0.0
        return self._path_mm - float(reach) - self._reach_mm

    def _give(self, cuts: Float, energy: Float, between: Float, acceleration: Float) -> None:
        middles = (cuts[:-1] + cuts[1:]) / 2.0
        index = np.minimum(np.searchsorted(self._ends[:, 0], middles), len(self._ends) - 1)
        table = speed.phases(cuts, energy, between, acceleration, self._ends[index, 1], self._now_s)
        self._table.append(table)
        self._place = float(table[-1, speed.PLACE])
        self._planned_mm, self._energy = float(cuts[-1]), float(energy[-1])
        self._pass_time(float(table[-1, speed.T]))
        self._ends = self._ends[self._ends[:, 0] > self._planned_mm]
        self._ahead = self._ahead[self._ahead[:, speed.HIGH] > self._planned_mm]


def _filter_rows(config: MachineConfig, limits: AxisLimits) -> int:
    """Return the length of the average that turns a step between the acceleration limits into a ramp of the jerk."""
    return max(
        1, limits.rows(max(2.0 * axis.max_acceleration_mm_s2 / axis.jerk_mm_s3 for axis in config.axis.values()))
    )
