"""Keeps the recent samples of the sensors at one axis' table, and places them on the rows of a recording. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from fdhil.records import Float, TableSamples, TableSignal, freeze_array

UNSURE_MM = 2e-3  # largest motion within the uncertainty of a position's instant
LONGEST_STEP = 1.5  # interval of acceleration samples beyond which one was lost


@dataclass(frozen=True, slots=True)
class MotorMotion:
    """The motor's motion from tick ``start`` on: ``position_mm`` and ``speed_mm_tick`` (n,), lost ones NaN."""

    start: int
    position_mm: Float
    speed_mm_tick: Float

    @property
    def tick(self) -> Float:
        """The rows' ticks (n,)."""
        return self.start + np.arange(self.position_mm.size, dtype=np.float64)


class TableSampleBuffer:
    """The newest ``capacity`` ticks of an axis' table encoder and accelerometer."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._blocks: dict[TableSignal, deque[TableSamples]] = {"table_mm": deque(), "table_m_s2": deque()}

    def clear(self) -> None:
        """Discard everything."""
        for blocks in self._blocks.values():
            blocks.clear()

    def append_block(self, block: TableSamples) -> None:
        """Append a block and drop what is older than the capacity; a lower count means a restart."""
        if block.tick.size == 0:
            return
        blocks = self._blocks[block.signal]
        if blocks and block.tick[0] < blocks[-1].tick[-1] - 1.0:
            blocks.clear()
        blocks.append(block)
        while blocks[-1].tick[-1] - blocks[0].tick[-1] > self._capacity:
            blocks.popleft()

    def place_positions(self, motion: MotorMotion) -> Float | None:
        """Return the table's position (n,) in the rows whose instant is sufficiently known, else NaN; None without any.

        A position between two rows counts for the nearer one, less the motor's travel between both.
        """
        values = np.full(motion.position_mm.size, np.nan)
        known = np.isfinite(motion.position_mm)
        if not known.any():
            return None
        at = motion.tick[known]
        for block in self._blocks["table_mm"]:
            row = np.rint(block.tick).astype(np.int64) - motion.start
            inside = (row >= 0) & (row < values.size)
            row, tick, readings = row[inside], block.tick[inside], block.values[inside]
            further = np.interp(tick, at, motion.position_mm[known]) - motion.position_mm[row]
            sure = np.abs(motion.speed_mm_tick[row]) * block.tick_error <= UNSURE_MM
            values[row[sure]] = (readings - further)[sure]
        return freeze_array(values) if np.isfinite(values).any() else None

    def resample_accelerations(self, motion: MotorMotion) -> Float | None:
        """Return the table's acceleration (n,) at the rows, NaN where a sample is lost; None without any.

        From a sensor at least as fast as the rows it is the mean of the samples about a row, else a cubic through its
        samples.
        """
        blocks = [b for b in self._blocks["table_m_s2"] if b.tick[-1] >= motion.start - 4]
        n = motion.position_mm.size
        if not blocks or not n:
            return None
        tick, readings = (np.concatenate([getattr(b, name) for b in blocks]) for name in ("tick", "values"))
        rising = np.concatenate([[True], np.diff(tick) > 0])
        tick, readings, rate = tick[rising], readings[rising], blocks[-1].rate_per_tick
        values = (
            _average_per_row(tick - motion.start, readings, n)
            if rate >= 1.0
            else _interpolate_cubic(tick - motion.start, readings, n, 1 / rate)
        )
        return freeze_array(values) if np.isfinite(values).any() else None


def _average_per_row(place: Float, readings: Float, n: int) -> Float:
    row = np.rint(place).astype(np.int64)
    inside = (row >= 0) & (row < n)
    count = np.bincount(row[inside], minlength=n)
    with np.errstate(invalid="ignore", divide="ignore"):
        means: Float = np.bincount(row[inside], readings[inside], minlength=n) / count
    return means


def _interpolate_cubic(place: Float, readings: Float, n: int, step: float) -> Float:
    """Return (n,) the values at rows 0.. of the cubic through the two samples on either side; NaN over a lost one."""
    values = np.full(n, np.nan)
    if place.size < 4:
        return values
    rows = np.arange(n, dtype=np.float64)
    k = np.searchsorted(place, rows, side="right") - 1
    whole = (k >= 1) & (k < place.size - 2)
    rows, k = rows[whole], k[whole]
    close = np.max([np.diff(place)[k + shift] for shift in (-1, 0, 1)], axis=0) < LONGEST_STEP * step
    rows, k = rows[close], k[close]
    u = (rows - place[k]) / (place[k + 1] - place[k])
    before, left, right, after = (readings[k + shift] for shift in (-1, 0, 1, 2))
    # Catmull-Rom: the slope at a sample is that between its neighbours
    slope, slope_after = (right - before) / 2, (after - left) / 2
    values[np.flatnonzero(whole)[close]] = left + u * (
        slope + u * (3 * (right - left) - 2 * slope - slope_after + u * (slope + slope_after - 2 * (right - left)))
    )
    return values
