"""Timed motions: consecutive lines, arcs, rapids and holds, and their positions at any rows of the SYNC grid."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.program.motions import ORIGIN, Dwell, Motion, Rapid, compute_end
from fdhil.program.planner.axis_limits import TICK_TOLERANCE, AxisLimits, check_duration
from fdhil.program.planner.path_pieces import (
    KIND,
    LENGTH,
    LINE,
    LINE_KIND,
    RAPID,
    SPEED,
    START,
    STOP,
    WIDTH,
    Row,
    build_piece,
    compute_points_at_share,
    limit_path_speed,
    measure_length,
)
from fdhil.records import Float, Int

_BATCH = 4096
_BATCH_ROWS = 1 << 18
# columns after those of a piece: end time, duration, and for a rapid the ramps at both ends
_END_S, _SPAN_S, _RATE, _RAMP_S = range(WIDTH, WIDTH + 4)
_EVEN = (0.0, 0.0)  # no ramps


@dataclass(frozen=True)
class TimedSegments:
    """Consecutive segments, (m, WIDTH + 4), for the rows from ``first_row`` to before ``end_row``."""

    table: Float
    first_row: int
    end_row: int

    def sample_rows(self, rows: Int, dt_s: float) -> Float:
        """Return the positions of ``ALL_AXES``, source line and rapid (0 or 1) at SYNC ``rows`` (n,): (n, 11)."""
        t = rows * dt_s
        index = np.searchsorted(self.table[:, _END_S], t - TICK_TOLERANCE * dt_s, side="left")
        chosen = self.table[np.minimum(index, len(self.table) - 1)]
        span = chosen[:, _SPAN_S]
        into = np.clip(t - (chosen[:, _END_S] - span), 0.0, span)
        share = np.divide(into, span, out=np.ones_like(span), where=span > 0.0)
        ramped = chosen[:, _RAMP_S] > 0.0
        if ramped.any():
            share[ramped] = _compute_ramped_share(into[ramped], chosen[ramped])
        return np.column_stack([compute_points_at_share(chosen, share), chosen[:, LINE], chosen[:, RAPID]])


def _compute_ramped_share(into: Float, chosen: Float) -> Float:
    acceleration, ramp_s = chosen[:, _RATE], chosen[:, _RAMP_S]
    left = chosen[:, _SPAN_S] - into
    share = acceleration * ramp_s * (into - ramp_s / 2.0)
    share = np.where(into < ramp_s, acceleration * into**2 / 2.0, share)
    return np.asarray(np.where(left < ramp_s, 1.0 - acceleration * left**2 / 2.0, share))


class Timeline:
    """Assigns times to motions, from rest at machine zero; ``settle_rows`` is the settling time of the smoothing.

    ProgramError if they last longer than ``max_rows``.
    """

    def __init__(self, config: MachineConfig, settle_rows: int, max_rows: float = math.inf) -> None:
        self._limits = limits = AxisLimits.create_from_config(config)
        self._dt_s = limits.dt_s
        self._max_s = max_rows * self._dt_s
        self._settle_rows = settle_rows + limits.count_rows(config.nc.settle_s)
        self._end_rows = settle_rows + 1 + limits.count_rows(config.nc.end_rest_s)
        self._stop_always = config.nc.corner == "exact_stop"
        self._at = ORIGIN
        self._now_s = 0.0
        self._line = 0
        self._before: type[Motion] | None = None
        self._table: list[Row] = []

    def plan_batches(self, motions: Iterable[Motion]) -> Iterator[TimedSegments]:
        """Yield the segments of all motions, the rest before them and the settling after them."""
        first_row = 0
        self._hold_position(0.0)
        for motion in motions:
            self._add_motion(motion)
            due = math.floor(self._now_s / self._dt_s)
            if len(self._table) >= _BATCH or due - first_row > _BATCH_ROWS:
                end_row = max(first_row, due)
                yield TimedSegments(np.array(self._table), first_row, end_row)
                first_row = end_row
                self._table = self._table[-1:]
        self._hold_until_settled(self._end_rows)
        yield TimedSegments(np.array(self._table), first_row, round(self._now_s / self._dt_s) + 1)

    def _add_motion(self, motion: Motion) -> None:
        kind = type(motion)
        goes_on = kind not in (Rapid, Dwell) and self._before not in (Rapid, Dwell) and not self._stop_always
        if self._before is not None and not goes_on:
            self._hold_until_settled(self._settle_rows)
        self._line = motion.line
        self._before = kind
        if isinstance(motion, Dwell):
            self._hold_position(motion.seconds)
            return
        row = build_piece(motion, self._at, self._limits)
        if row is not None:
            span_s, ramps = self._time_rapid(motion) if isinstance(motion, Rapid) else (row[LENGTH] / row[SPEED], _EVEN)
            self._append_row(row, span_s, ramps)
        self._at = compute_end(motion, self._at)

    def _append_row(self, row: Row, span_s: float, ramps: Row) -> None:
        self._now_s += span_s
        check_duration(self._line, self._now_s, self._max_s)
        self._table.append((*row, self._now_s, span_s, *ramps))

    def _hold_position(self, span_s: float) -> None:
        still = [0.0] * WIDTH
        still[KIND], still[LINE], still[RAPID] = LINE_KIND, self._line, float(self._before is Rapid)
        still[START] = still[STOP] = self._at
        self._append_row(tuple(still), span_s, _EVEN)

    def _hold_until_settled(self, settle_rows: int) -> None:
        row = self._limits.count_rows(self._now_s) + settle_rows
        self._hold_position(max(0.0, row * self._dt_s - self._now_s))
        self._now_s = row * self._dt_s

    def _time_rapid(self, motion: Rapid) -> tuple[float, Row]:
        """Return the duration and ramps of a rapid: one trapezoid for all axes, so that none exceeds its limits."""
        end = compute_end(motion, self._at)
        way = [abs(b - a) for a, b in zip(self._at, end, strict=True)]
        speed = min(
            v / w for v, w in zip(self._limits.speed, way, strict=True) if w
        )  # share of the distance per second
        speed = min(speed, limit_path_speed(self._at, end, self._limits) / measure_length(self._at, end))
        acceleration = min(a / w for a, w in zip(self._limits.acceleration, way, strict=True) if w)
        ramp_s = min(speed / acceleration, 1.0 / math.sqrt(acceleration))
        span_s = 2.0 * ramp_s + max(0.0, (1.0 - acceleration * ramp_s**2) / (acceleration * ramp_s))
        return span_s, (acceleration, ramp_s)
