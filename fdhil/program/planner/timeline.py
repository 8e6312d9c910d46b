"""Motions with times: lines, arcs, rapids and holds in a row, and their positions at any rows of the SYNC grid."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.errors import ProgramError
from fdhil.program.arcs import sweep
from fdhil.program.motions import PLANE_AXES, PLANES, Arc, Dwell, Feed, Motion, Point, Rapid
from fdhil.program.planner.limits import AxisLimits, check_dwell
from fdhil.records import Float, Int

_BATCH = 4096
_BATCH_ROWS = 1 << 18
_TICK_TOLERANCE = 1e-6  # of a row: an end so little after a row counts as on it
# columns of a segment
_END_S, _SPAN_S, _LINE, _RAPID, _KIND = range(5)
_START, _STOP = slice(5, 8), slice(8, 11)
_EXTRA = slice(11, 17)
_STRAIGHT, _TRAPEZOID = -1.0, -2.0  # kinds; an arc's kind is the index of its plane
Row = tuple[float, ...]
_NO_EXTRA = (0.0,) * 6


@dataclass(frozen=True)
class Segments:
    """Consecutive segments, (m, 17), that order the rows from ``first_row`` to before ``end_row``."""

    table: Float
    first_row: int
    end_row: int

    def sample(self, rows: Int, dt_s: float) -> tuple[Float, Int, Int]:
        """Return position (n, 3) in mm, source line (n,) and rapid (n,) 0 or 1 at SYNC ``rows`` (n,)."""
        t = rows * dt_s
        index = np.searchsorted(self.table[:, _END_S], t - _TICK_TOLERANCE * dt_s, side="left")
        chosen = self.table[np.minimum(index, len(self.table) - 1)]
        span = chosen[:, _SPAN_S]
        into = np.clip(t - (chosen[:, _END_S] - span), 0.0, span)
        share = np.divide(into, span, out=np.ones_like(span), where=span > 0.0)
        kind = chosen[:, _KIND]
        trapezoid = kind == _TRAPEZOID
        if trapezoid.any():
            share[trapezoid] = _trapezoid_share(into[trapezoid], chosen[trapezoid])
        start, stop = chosen[:, _START], chosen[:, _STOP]
        position = start + (stop - start) * share[:, None]
        position[share >= 1.0] = stop[share >= 1.0]
        for plane, name in enumerate(PLANES):
            turning = (kind == plane) & (share < 1.0)
            if turning.any():
                first, second, _ = PLANE_AXES[name]
                position[turning, first], position[turning, second] = _on_arc(share[turning], chosen[turning, _EXTRA])
        return position, chosen[:, _LINE].astype(np.int64), chosen[:, _RAPID].astype(np.int64)


def _on_arc(share: Float, extra: Float) -> tuple[Float, Float]:
    first, second, begin_radius, end_radius, begin_angle, angle = extra.T
    radius = begin_radius + (end_radius - begin_radius) * share
    return first + radius * np.cos(begin_angle + angle * share), second + radius * np.sin(begin_angle + angle * share)


def _trapezoid_share(into: Float, chosen: Float) -> Float:
    """Share of the way after ``into`` seconds of a rapid: accelerate, cruise, brake."""
    acceleration, ramp_s = chosen[:, _EXTRA][:, 0], chosen[:, _EXTRA][:, 1]
    left = chosen[:, _SPAN_S] - into
    share = acceleration * ramp_s * (into - ramp_s / 2.0)
    share = np.where(into < ramp_s, acceleration * into**2 / 2.0, share)
    return np.asarray(np.where(left < ramp_s, 1.0 - acceleration * left**2 / 2.0, share))


class Timeline:
    """Gives motions their times, from rest at machine zero; ``settle_rows`` is what the smoothing needs to settle.

    ProgramError when they last longer than ``max_rows``.
    """

    def __init__(self, config: MachineConfig, settle_rows: int, max_rows: float = math.inf) -> None:
        self._dt_s = config.machine.sync_period_s
        self._max_s = max_rows * self._dt_s
        self._settle_rows = settle_rows + math.ceil(config.nc.settle_s / self._dt_s - _TICK_TOLERANCE)
        self._end_rows = settle_rows + 1 + math.ceil(config.nc.end_rest_s / self._dt_s - _TICK_TOLERANCE)
        self._stop_always = config.nc.corner == "exact_stop"
        self._limits = limits = AxisLimits.of(config)
        self._present, self._speed, self._acceleration = limits.present, limits.speed, limits.acceleration
        self._at: Point = (0.0, 0.0, 0.0)
        self._now_s = 0.0
        self._line = 0
        self._before: type[Motion] | None = None
        self._table: list[Row] = []

    def batches(self, motions: Iterable[Motion]) -> Iterator[Segments]:
        """Yield the segments of all motions, the rest before them and the settling after them."""
        first_row = 0
        self._hold(0.0, 0)
        for motion in motions:
            self._add(motion)
            due = math.floor(self._now_s / self._dt_s)
            if len(self._table) >= _BATCH or due - first_row > _BATCH_ROWS:
                end_row = max(first_row, due)
                yield Segments(np.array(self._table), first_row, end_row)
                first_row = end_row
                self._table = self._table[-1:]
        self._stop(self._end_rows)
        end_row = round(self._now_s / self._dt_s) + 1
        yield Segments(np.array(self._table), first_row, end_row)

    def _add(self, motion: Motion) -> None:
        kind = type(motion)
        feeding = kind is not Rapid and kind is not Dwell
        fed = self._before is not None and self._before is not Rapid and self._before is not Dwell
        if self._before is not None and not (feeding and fed and not self._stop_always):
            self._stop(self._settle_rows)
        self._line = motion.line
        if isinstance(motion, Dwell):
            self._dwell(motion)
        else:
            self._limits.check(motion, self._at)
            if isinstance(motion, Rapid):
                self._rapid(motion)
            elif isinstance(motion, Feed):
                self._feed(motion)
            else:
                self._arc(motion)
            self._at = motion.end
        self._before = kind

    def _append(self, span_s: float, end: Point, kind: float, extra: Row = _NO_EXTRA, rapid: bool = False) -> None:
        self._now_s += span_s
        if self._now_s > self._max_s:
            raise ProgramError(self._line, "", f"by here the program lasts {self._now_s / 3600:.3g} h; split it")
        self._table.append((self._now_s, span_s, float(self._line), float(rapid), kind, *self._at, *end, *extra))

    def _hold(self, span_s: float, line: int) -> None:
        self._line = line
        self._append(span_s, self._at, _STRAIGHT, rapid=self._before is Rapid)

    def _stop(self, settle_rows: int) -> None:
        """Hold until the next row, then until the smoothed demand has arrived."""
        row = math.ceil(self._now_s / self._dt_s - _TICK_TOLERANCE) + settle_rows
        self._hold(max(0.0, row * self._dt_s - self._now_s), self._line)
        self._now_s = row * self._dt_s

    def _dwell(self, motion: Dwell) -> None:
        check_dwell(motion, self._dt_s)
        self._before = Dwell
        self._hold(motion.seconds, motion.line)

    def _feed(self, motion: Feed) -> None:
        length = math.dist(self._at, motion.end)
        if length > 0.0:
            way = [abs(b - a) / length for a, b in zip(self._at, motion.end, strict=True)]
            speed = min(motion.feed / 60.0, *(v / w if w else math.inf for v, w in zip(self._speed, way, strict=True)))
            self._append(length / speed, motion.end, _STRAIGHT)

    def _arc(self, motion: Arc) -> None:
        first, second, normal = PLANE_AXES[motion.plane]
        centre = (motion.centre[first] or 0.0, motion.centre[second] or 0.0)
        begin = (self._at[first] - centre[0], self._at[second] - centre[1])
        finish = (motion.end[first] - centre[0], motion.end[second] - centre[1])
        angle = sweep(begin, finish, motion.turns)
        radii = math.hypot(*begin), math.hypot(*finish)
        length = math.hypot((radii[0] + radii[1]) / 2.0 * angle, motion.end[normal] - self._at[normal])
        speed = min(motion.feed / 60.0, *(v for v, here in zip(self._speed, self._present, strict=True) if here))
        extra = (*centre, *radii, math.atan2(begin[1], begin[0]), angle)
        self._append(length / speed, motion.end, float(PLANES.index(motion.plane)), extra)

    def _rapid(self, motion: Rapid) -> None:
        """A straight line with one trapezoid of speed for all axes, so that none exceeds its limits."""
        way = [abs(b - a) for a, b in zip(self._at, motion.end, strict=True)]
        if max(way) <= 0.0:
            return
        speed = min(v / w for v, w in zip(self._speed, way, strict=True) if w)  # shares of the way per second
        acceleration = min(a / w for a, w in zip(self._acceleration, way, strict=True) if w)
        ramp_s = min(speed / acceleration, 1.0 / math.sqrt(acceleration))
        span_s = 2.0 * ramp_s + max(0.0, (1.0 - acceleration * ramp_s**2) / (acceleration * ramp_s))
        self._append(span_s, motion.end, _TRAPEZOID, (acceleration, ramp_s, 0.0, 0.0, 0.0, 0.0), rapid=True)
