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
from fdhil.program.motions import ORIGIN, Arc, Dwell, Feed, Motion, Rapid, compute_end
from fdhil.program.planner import speed_profile
from fdhil.program.planner.axis_limits import TICK_TOLERANCE, AxisLimits, check_duration
from fdhil.program.planner.corners import CornerRules
from fdhil.program.planner.path_curve import PathCurve
from fdhil.program.planner.path_pieces import LENGTH, LINE, RAPID, WIDTH, Row, build_piece
from fdhil.records import Float, Int

_BATCH = 512  # pieces planned together
_MOST = 4096  # pieces that may wait for their successors; beyond that a stop after them is assumed
_SHARP_ROWS = 1.5
_BATCH_ROWS = 1 << 18


@dataclass(frozen=True, slots=True)
class PlannedStretch:
    """Phases of speed for the rows from ``first_row`` to before ``end_row``; ``place`` is 2 line + rapid."""

    table: Float
    first_row: int
    end_row: int

    def sample_rows(self, rows: Int, dt_s: float) -> Float:
        """Return length of path in mm, source line and rapid (0 or 1) at SYNC ``rows`` (n,): (n, 3)."""
        path, place = speed_profile.evaluate_phases(self.table, np.asarray(rows * dt_s), TICK_TOLERANCE * dt_s)
        return np.column_stack([path, place // 2, place % 2])


class LookAhead:
    """Plans the speeds of motions, from rest at machine zero; ``curve`` has the points of the path.

    ProgramError if they last longer than ``max_rows``.
    """

    def __init__(self, config: MachineConfig, max_rows: float = math.inf) -> None:
        self._limits = limits = AxisLimits.create_from_config(config)
        self._dt_s = limits.dt_s
        self._max_s = max_rows * self._dt_s
        self._rapid_stop = config.nc.rapid_stop
        self._stop_always = config.nc.corner == "exact_stop"
        smooth = config.nc.profile == "jerk_limited"
        self.filter_rows = _count_filter_rows(config, limits) if smooth else 1
        self._filter_s = self.filter_rows * self._dt_s if smooth else 0.0
        fastest = math.hypot(*(v for v in limits.speed if math.isfinite(v)))
        self._reach_mm = fastest * self._filter_s / 2.0
        self._settle_rows = self.filter_rows - 1 + limits.count_rows(config.nc.settle_s)
        self._end_rows = self.filter_rows + limits.count_rows(config.nc.end_rest_s)
        self._rules = CornerRules(limits, self._filter_s)
        self.curve = PathCurve(smooth)
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

    def plan_stretches(self, motions: Iterable[Motion]) -> Iterator[PlannedStretch]:
        """Yield the phases of all motions, the rest before them and the settling after them."""
        for motion in motions:
            if isinstance(motion, Dwell):
                self._add_dwell(motion)
            else:
                self._add_motion(motion)
            if len(self._new) >= _BATCH:
                self._plan_pieces(stop=False)
            if sum(map(len, self._table)) > 8 * _BATCH or self._now_s / self._dt_s - self._row > _BATCH_ROWS:
                yield self._release_due_rows()
        self._plan_stop(self._end_rows)
        self._now_s += self._dt_s
        yield self._release_due_rows()

    def _release_due_rows(self) -> PlannedStretch:
        end_row = max(self._row, self._limits.count_rows(self._now_s))
        stretch = PlannedStretch(np.concatenate(self._table), self._row, end_row)
        self._row = end_row
        self._table = [stretch.table[-1:]]
        return stretch

    def _add_motion(self, motion: Rapid | Feed | Arc) -> None:
        row = build_piece(motion, self._at, self._limits)
        self._at = compute_end(motion, self._at)
        if row is None:
            return
        changes = self._rapid_stop and self._before_rapid is not None and self._before_rapid != row[RAPID]
        if self._stops_after or changes:
            self._plan_stop(self._settle_rows)
        self._stops_after = self._stop_always or motion.corner.mode == "exact_stop"
        self._before_rapid = row[RAPID]
        self._new.append(row)

    def _add_dwell(self, motion: Dwell) -> None:
        self._plan_stop(self._settle_rows)
        self._place = 2.0 * motion.line
        self._hold_rows(self._limits.count_rows(motion.seconds))

    def _plan_stop(self, rows: int) -> None:
        """Plan to a stop, and rest until the next row and ``rows`` more."""
        self._plan_pieces(stop=True)
        self._last = np.empty((0, WIDTH))
        self._ends, self._ahead = np.empty((0, 2)), np.empty((0, 4))
        self._stops_after, self._before_rapid = False, None
        self._hold_rows(rows)

    def _hold_rows(self, rows: int) -> None:
        end_row = self._limits.count_rows(self._now_s) + rows
        self._table.append(np.array([[self._now_s, self._planned_mm, 0.0, 0.0, self._place]]))
        self._pass_time(end_row * self._dt_s)

    def _pass_time(self, now_s: float) -> None:
        self._now_s = now_s
        check_duration(int(self._place) // 2, now_s, self._max_s)

    def _plan_pieces(self, stop: bool) -> None:
        if self._new:
            self._add_new_pieces()
        last = self._path_mm if stop else self._compute_sure_mm()
        if not last > self._planned_mm:
            return
        cuts, at_cut, between, acceleration = speed_profile.build_speed_grid(
            self._ahead, self._ends[:, 0], self._planned_mm, last
        )
        gain = 2.0 * acceleration * np.diff(cuts)
        energy = speed_profile.compute_squared_speeds(at_cut, gain, self._energy, 0.0)
        count = between.size
        if not stop:
            free = speed_profile.compute_squared_speeds(at_cut, gain, self._energy, math.inf)
            count = int(np.argmin(np.append(energy == free, False))) - 1
            if count <= 0 and len(self._ends) > _MOST:
                count = between.size // 2
        if count > 0:
            self._append_phases(cuts[: count + 1], energy[: count + 1], between[:count], acceleration[:count])

    def _add_new_pieces(self) -> None:
        new = np.array(self._new)
        pieces = np.concatenate([self._last, new])
        self._new, self._last = [], pieces[-1:]
        corners = self._rules.limit_corners(pieces)
        first = pieces.shape[0] - new.shape[0]  # 0 if the first piece begins at rest
        half = np.concatenate([np.zeros(1 - first), corners.half])
        self.curve.append_pieces(new, half)
        ends = self._path_mm + np.cumsum(new[:, LENGTH])
        begins = np.concatenate([[self._path_mm], ends[:-1]])  # identical numbers, so that no gap remains
        self._path_mm = float(ends[-1])
        along, acceleration = self._rules.limit_pieces(new)
        turns = begins[1 - first :]
        # constant speed around a sharp corner over the span of a third difference, so that nothing adds to its step
        around = np.maximum(corners.half, _SHARP_ROWS * self._dt_s * corners.speed)
        limits = [
            np.column_stack([begins, ends, along, acceleration]),
            np.column_stack([turns - around, turns + around, corners.speed, corners.acceleration]),
        ]
        self._ahead = np.concatenate([self._ahead, speed_profile.widen_limits(np.concatenate(limits), self._filter_s)])
        self._ends = np.concatenate([self._ends, np.column_stack([ends, 2.0 * new[:, LINE] + new[:, RAPID]])])

    def _compute_sure_mm(self) -> float:
        """Return the path length up to which no future motion can set a limit."""
        reach = self._last[0, LENGTH] / 2.0 if self._last.size else 0.0
        return self._path_mm - float(reach) - self._reach_mm

    def _append_phases(self, cuts: Float, energy: Float, between: Float, acceleration: Float) -> None:
        middles = (cuts[:-1] + cuts[1:]) / 2.0
        index = np.minimum(np.searchsorted(self._ends[:, 0], middles), len(self._ends) - 1)
        table = speed_profile.build_phases(cuts, energy, between, acceleration, self._ends[index, 1], self._now_s)
        self._table.append(table)
        self._place = float(table[-1, speed_profile.PLACE])
        self._planned_mm, self._energy = float(cuts[-1]), float(energy[-1])
        self._pass_time(float(table[-1, speed_profile.T]))
        self._ends = self._ends[self._ends[:, 0] > self._planned_mm]
        self._ahead = self._ahead[self._ahead[:, speed_profile.HIGH] > self._planned_mm]


def _count_filter_rows(config: MachineConfig, limits: AxisLimits) -> int:
    """Return the length of the average that turns a step between the acceleration limits into a ramp of the jerk."""
    return max(
        1, limits.count_rows(max(2.0 * axis.max_acceleration_mm_s2 / axis.jerk_mm_s3 for axis in config.axis.values()))
    )
