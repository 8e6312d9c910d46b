"""Generate the set-points of a machine, one row per SYNC, and keep every row inside its bounds. Pure.

All set-points come from :meth:`SetPointGenerator.step` alone. A row is sent only if the axes can still be braked inside
their
travel from there: a stop is always possible, and always the same. It continues straight ahead from the last two rows
sent, each axis' speed falling to zero in the same n cycles, n = ceil(max |v|/a).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.config import Axis
from fdhil.records import Float

ROUNDING = 2.0  # increments: contribution of rounding to the second difference of a demand
AGE_CYCLES = 4  # largest age of a position in SYNCs, including sampling and loop lag
Row = Sequence[float]


@dataclass(frozen=True, slots=True)
class AxisBounds:
    """Limits of one axis' set-points, in drive increments and SYNC cycles.

    ``low`` and ``high`` bound the travel, ``speed`` is in increments per cycle, ``acceleration`` in increments per
    cycle squared; a position farther than ``following_error`` from the set-points ends the motion.
    """

    axis: str
    low: float
    high: float
    speed: float
    acceleration: float
    following_error: float
    delay_cycles: int = 2

    @classmethod
    def create_for_axis(
        cls,
        name: str,
        axis: Axis,
        period_s: float,
        travel_mm: tuple[float, float],
        speed_mm_s: float | None = None,
        acceleration_mm_s2: float | None = None,
    ) -> AxisBounds:
        """Return the bounds of an axis: the configuration's, or lower ones; half its following-error window."""
        scaling, own = axis.scaling, axis.setpoints
        low, high = sorted(scaling.sign * mm * scaling.increments_per_mm for mm in travel_mm)
        most = own.max_acceleration_mm_s2 if own is not None else None
        speed = min(speed_mm_s or math.inf, axis.top_speed_mm_s)
        acceleration = min(acceleration_mm_s2 or math.inf, most or axis.max_acceleration_mm_s2)
        return cls(
            name,
            low,
            high,
            speed * period_s * scaling.increments_per_mm,
            acceleration * period_s**2 * scaling.increments_per_mm,
            axis.drive.following_error_window_mm / 2 * scaling.increments_per_mm,
            axis.drive.setpoint_delay_cycles,
        )


class SetPointGenerator:
    """The set-points of some axes, at rest at ``start`` until :meth:`play`.

    ``stopped`` says why a motion ended before its last row, None otherwise; nothing is played afterwards. ``cycles``
    counts the steps, ``played`` the rows sent. One thread calls :meth:`step`; :meth:`play` and :meth:`stop` may be
    called by another.
    """

    def __init__(self, bounds: Sequence[AxisBounds], start: Sequence[int]) -> None:
        self.bounds = tuple(bounds)
        self.stopped: str | None = None
        self.cycles = self.played = 0
        self._last: tuple[float, ...] = tuple(map(float, start))
        self._before = self._last
        self._rows: Iterator[Row] | None = None
        self._brake: Iterator[tuple[float, ...]] | None = None
        self._sent = [
            deque([at], maxlen=of.delay_cycles + AGE_CYCLES) for at, of in zip(self._last, bounds, strict=True)
        ]

    @property
    def is_resting(self) -> bool:
        """Whether nothing is played and the axes are at standstill."""
        return self._rows is None and self._last == self._before

    @property
    def position(self) -> tuple[float, ...]:
        """The last row sent."""
        return self._last

    def play_rows(self, rows: Iterable[Row]) -> None:
        """Send these rows, in increments, one per cycle; they begin at the rest position. Ignored once stopped."""
        if self.stopped is None:
            self._rows = iter(rows)

    def brake_to_rest(self, why: str) -> None:
        """Brake to rest from the next cycle on; the first reason is kept."""
        if self.stopped is None:
            self.stopped = why

    def hold_last_row(self, why: str) -> None:
        """Stay at the last row sent, since the drives have long stopped there."""
        self.brake_to_rest(why)
        self._rows, self._brake, self._before = None, iter(()), self._last

    def advance_cycle(self, positions: Sequence[int | None] = ()) -> tuple[int, ...]:
        """Return the set-points of this cycle in whole increments; ``positions`` are the drives' newest."""
        self._check_following_error(positions)
        row = self._select_next_row()
        self._before, self._last = self._last, row
        self.cycles += 1
        for sent, value in zip(self._sent, row, strict=True):
            sent.append(value)
        return tuple(map(round, row))

    def _select_next_row(self) -> tuple[float, ...]:
        if self.stopped is None and self._rows is not None:
            row = next(self._rows, None)
            fault = self._find_row_fault(row) if row is not None else self._check_end_speed()
            if fault is None:
                self.played += row is not None
                return self._last if row is None else tuple(map(float, row))
            self.brake_to_rest(fault)
        if self.stopped is not None:
            self._rows = None  # another thread may have called play meanwhile
            self._brake = self._generate_braking_rows() if self._brake is None else self._brake
        braked = None if self._brake is None else next(self._brake, None)
        return self._last if braked is None else braked

    def _check_end_speed(self) -> str | None:
        """At the end of the rows the axes must be at standstill, or nearly."""
        self._rows = None
        still = all(
            abs(v) <= of.acceleration + ROUNDING for v, of in zip(self._compute_speed(), self.bounds, strict=True)
        )
        return None if still else "the set-points ended in motion"

    def _compute_speed(self) -> tuple[float, ...]:
        return tuple(now - then for now, then in zip(self._last, self._before, strict=True))

    def _count_cycles_to_stop(self, speed: Sequence[float]) -> int:
        return max(math.ceil(abs(v) / of.acceleration - 1e-9) for v, of in zip(speed, self.bounds, strict=True))

    def _generate_braking_rows(self) -> Iterator[tuple[float, ...]]:
        start, speed = self._last, self._compute_speed()
        n = self._count_cycles_to_stop(speed)
        for k in range(1, n + 1):
            way = k - k * (k + 1) / (2 * n)
            yield tuple(at + v * way for at, v in zip(start, speed, strict=True))

    def _find_row_fault(self, row: Row) -> str | None:
        """Return why this row must not be sent, None if it may; NaN fails every comparison."""
        if len(row) != len(self.bounds) or not all(map(math.isfinite, row)):
            return "a set-point is not a number"
        speed = [now - then for now, then in zip(row, self._last, strict=True)]
        way = max(self._count_cycles_to_stop(speed) - 1, 0) / 2
        for at, v, before, of in zip(row, speed, self._compute_speed(), self.bounds, strict=True):
            if not abs(v) <= of.speed + ROUNDING:
                return f"axis {of.axis}: a set-point exceeds the axis' speed"
            if not abs(v - before) <= of.acceleration + ROUNDING:
                return f"axis {of.axis}: a set-point exceeds the axis' acceleration"
            if not (of.low <= at <= of.high and of.low <= at + v * way <= of.high):
                return f"axis {of.axis}: it could not be braked inside its travel"
        return None

    def _check_following_error(self, positions: Sequence[int | None]) -> None:
        for position, sent, of in zip(positions, self._sent, self.bounds, strict=False):
            if position is not None:
                away = max(min(sent) - position, position - max(sent))
                if not away <= of.following_error:
                    self.brake_to_rest(f"axis {of.axis}: it does not follow its set-points")


def plan_straight_move(start: Row, goal: Row, speed: Row, acceleration: Row, rounding_cycles: int = 1) -> Float:
    """Return rows (n, axes) straight from ``start`` to ``goal``, at rest at both ends, in the units of the arguments.

    A trapezoid of speed in which the slowest axis has its ``speed`` and ``acceleration`` (per cycle and per cycle
    squared), averaged over ``rounding_cycles`` to avoid steps of acceleration. The last row is the goal.
    """
    begin, end = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
    way = np.abs(end - begin)
    moved = way > 0
    if not moved.any():
        return end[None, :]
    fastest = float(np.min(np.asarray(speed)[moved] / way[moved]))
    steepest = float(np.min(np.asarray(acceleration)[moved] / way[moved]))
    top = min(fastest, math.sqrt(steepest))
    ramp = top / steepest
    whole = 1 / top + ramp
    k = np.minimum(np.arange(math.ceil(whole) + 1), whole)
    up, down = np.minimum(k, ramp), np.minimum(whole - k, ramp)
    part = np.where(
        k <= ramp, steepest * up**2 / 2, np.where(k >= whole - ramp, 1 - steepest * down**2 / 2, top * (k - ramp / 2))
    )
    width = max(1, rounding_cycles)
    padded = np.concatenate([np.zeros(width - 1), part, np.ones(width - 1)])
    part = np.convolve(padded, np.full(width, 1 / width), mode="valid")
    rows = begin + np.outer(part, end - begin)
    rows[-1] = end
    return rows
