"""Monitors the difference between the two drives of a gantry axis: the beam between them must not be skewed."""

from collections.abc import Sequence

import numpy as np

from fdhil.config import MachineConfig, is_second_drive
from fdhil.records import AxisSamples, Float, Int, Notice

MOST_SAMPLES = 20_000  # waiting for the other drive's
Rows = tuple[Int, Float]


class GantryWatch:
    """Compares the following errors of both drives at the same SYNC: their zeros may differ."""

    def __init__(self, config: MachineConfig) -> None:
        seconds = [name for name in config.axis if is_second_drive(name)]
        self._limit_um = {name[0]: config.axis[name].largest_difference_um for name in seconds}
        self._waiting: dict[str, Rows] = {}
        self._largest_um = dict.fromkeys(self._limit_um, 0.0)
        self._skewed: set[str] = set()

    def take_samples(self, samples: AxisSamples) -> None:
        """Take a block of one drive."""
        axis = samples.axis[0]
        if axis not in self._limit_um or samples.tick.size == 0:
            return
        error_um = 1e3 * (samples.position_mm - samples.demand_mm)
        before = self._waiting.get(samples.axis)
        if before is not None and samples.tick[0] > before[0][-1]:
            rows = np.concatenate([before[0], samples.tick]), np.concatenate([before[1], error_um])
        else:  # the first, or the SYNC count began again
            rows = samples.tick, error_um
        self._waiting[samples.axis] = rows[0][-MOST_SAMPLES:], rows[1][-MOST_SAMPLES:]
        other = self._waiting.get(axis if is_second_drive(samples.axis) else f"{axis}2")
        if other is None:
            return
        own = self._waiting[samples.axis]
        common, here, there = np.intersect1d(own[0], other[0], assume_unique=True, return_indices=True)
        if common.size:
            apart_um = np.abs(own[1][here] - other[1][there])
            self._largest_um[axis] = max(self._largest_um[axis], float(np.nanmax(apart_um, initial=0.0)))
            for name in (axis, f"{axis}2"):
                tick, error_um = self._waiting[name]
                self._waiting[name] = tick[tick > common[-1]], error_um[tick > common[-1]]
                if not self._waiting[name][0].size:
                    del self._waiting[name]

    def check_skew(self) -> tuple[bool, Sequence[Notice]]:
        """Return whether any axis was skewed since the last call, and a notice for each skew that begins or ends."""
        found = {axis: um for axis, um in self._largest_um.items() if um > self._limit_um[axis]}
        new = [axis for axis in found if axis not in self._skewed]
        over = [Notice("GantrySkew", "info", "the drives agree again", axis) for axis in self._skewed - set(found)]
        self._skewed = set(found)
        self._largest_um = dict.fromkeys(self._limit_um, 0.0)
        begun = [Notice("GantrySkew", "MAJOR", self._describe_skew(axis, found[axis]), axis) for axis in new]
        return bool(found), begun + over

    def _describe_skew(self, axis: str, um: float) -> str:
        return f"the drives {axis} and {axis}2 are {um:.0f} um apart, {self._limit_um[axis]:g} are allowed"
