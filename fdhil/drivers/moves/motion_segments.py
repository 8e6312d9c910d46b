"""Segments one axis' demand into moves in one direction. Pure."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from fdhil.records import AxisSamples, Float, Int

REST_S = 0.010  # a demand at standstill for so long has ended the move
LONG_S = 10.0  # a longer move is reported in parts
KEPT_S = 45.0


@dataclass(frozen=True, slots=True)
class MotionSegment:
    """A move in one direction between two ticks; ``goes_on`` where it was only divided because it is long."""

    begin: int
    end: int
    goes_on: bool = False


class MotionSegmenter:
    """The segments of one axis; ``rounding_mm`` is the change per sample of a demand at standstill."""

    def __init__(self, period_s: float, rounding_mm: float) -> None:
        self._period_s = period_s
        self._rounding_mm = rounding_mm
        self.reset_segments()

    def reset_segments(self) -> None:
        """Drop everything: the SYNC count restarted."""
        self._kept: deque[tuple[Int, Float]] = deque()
        self._side = 0  # of the open segment
        self._begin = 0
        self._still: int | None = None

    @property
    def newest_tick(self) -> int | None:
        return int(self._kept[-1][0][-1]) if self._kept else None

    def split_demand(self, samples: AxisSamples) -> list[MotionSegment]:
        """Take a block that is not empty; return the completed segments."""
        tick, demand = samples.tick, samples.demand_mm
        if self._kept:
            tick = np.append(self._kept[-1][0][-1], tick)
            demand = np.append(self._kept[-1][1][-1], demand)
        self._kept.append((samples.tick, samples.demand_mm))
        while self._kept[-1][0][-1] - self._kept[0][0][-1] > KEPT_S / self._period_s:
            self._kept.popleft()
        step = np.diff(demand) / np.diff(tick)
        side = np.where(np.abs(step) > self._rounding_mm, np.sign(step), 0.0)
        edges = np.flatnonzero(np.diff(side)) + 1
        found: list[MotionSegment] = []
        for first, stop in zip([0, *edges], [*edges, side.size], strict=True):
            if stop > first:
                found += self._process_piece(int(side[first]), int(tick[first]), int(tick[stop]))
        if self._side and tick[-1] - self._begin > LONG_S / self._period_s:
            found.append(MotionSegment(self._begin, int(tick[-1]), goes_on=True))
            self._begin, self._still = int(tick[-1]), None
        return found

    def _process_piece(self, side: int, begin: int, end: int) -> list[MotionSegment]:
        if side == 0:
            if self._side and self._still is None:
                self._still = begin
            over = self._still is not None and (end - self._still) * self._period_s >= REST_S
            return self._close_segment(begin) if over else []
        found = self._close_segment(begin) if self._side not in (0, side) else []
        if self._side == 0:
            self._side, self._begin = side, begin
        self._still = None
        return found

    def _close_segment(self, turn: int) -> list[MotionSegment]:
        end = turn if self._still is None else self._still
        self._side, self._still = 0, None
        return [MotionSegment(self._begin, end)] if end > self._begin else []

    def find_slowest_tick(self, low: int, high: int) -> int:
        """Return the tick in [low, high] after which the demand is slowest; ``low`` if there is none."""
        blocks = [block for block in self._kept if block[0][-1] >= low and block[0][0] <= high]
        if not blocks:
            return low
        tick, demand = (np.concatenate([block[k] for block in blocks]) for k in (0, 1))
        inside = (tick >= low) & (tick <= high) & np.isfinite(demand)
        tick, demand = tick[inside], demand[inside]
        if tick.size < 2:
            return low
        return int(tick[int(np.argmin(np.abs(np.diff(demand) / np.diff(tick))))])
