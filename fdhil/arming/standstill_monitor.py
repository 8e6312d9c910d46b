"""Tracks the holding current of each axis at standstill: the state in which its regulators start a program."""

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fdhil.config import MachineConfig
from fdhil.records import AxisSamples, Float

WATCHED_S = 0.06  # of standstill that is required
RECENT_S = 0.02  # over which the current is averaged: with a residual error it drifts
STILL_INCREMENTS = 1.5


class StandstillState(NamedTuple):
    """An axis at standstill: its demand, its position, and the mean of its current."""

    demand_mm: float
    position_mm: float
    current_a: float


class StandstillMonitor:
    """Keeps the last samples of each axis."""

    def __init__(self, config: MachineConfig) -> None:
        self._axes, self._period_s = config.axis, config.machine.sync_period_s
        self._blocks: Mapping[str, deque[AxisSamples]] = {axis: deque() for axis in config.axis}

    def take_samples(self, samples: AxisSamples) -> None:
        blocks = self._blocks[samples.axis]
        if samples.tick.size == 0:
            return
        if blocks and blocks[-1].tick[-1] >= samples.tick[0]:  # the SYNC count restarted
            blocks.clear()
        blocks.append(samples)
        while samples.tick[-1] - blocks[0].tick[-1] > WATCHED_S / self._period_s:
            blocks.popleft()

    def find_standing_axes(self) -> dict[str, StandstillState]:
        """Return the axes at standstill without an offset."""
        found = {axis: self._measure_axis(axis, tuple(blocks)) for axis, blocks in self._blocks.items() if blocks}
        return {axis: rest for axis, rest in found.items() if rest is not None}

    def _measure_axis(self, axis: str, blocks: tuple[AxisSamples, ...]) -> StandstillState | None:
        demand, position, current, offset = (
            np.concatenate([getattr(block, name) for block in blocks])
            for name in ("demand_mm", "position_mm", "current_a", "offset_mm")
        )
        ticks = blocks[-1].tick[-1] - blocks[0].tick[0] + 1
        whole = np.isfinite(demand).all() and np.isfinite(position).all() and np.isfinite(current).all()
        if not whole or ticks < WATCHED_S / self._period_s or ticks != demand.size or np.any(np.nan_to_num(offset)):
            return None
        room_mm = STILL_INCREMENTS / self._axes[axis].scaling.increments_per_mm
        if np.ptp(demand) > room_mm or np.ptp(position) > room_mm:
            return None
        recent = round(RECENT_S / self._period_s)
        return StandstillState(float(demand[-1]), _average_recent(position, recent), _average_recent(current, recent))


def _average_recent(values: Float, rows: int) -> float:
    return float(values[-rows:].mean())
