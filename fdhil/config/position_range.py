"""The positions that an axis can be commanded to: set-points have 32 bits, and the largest offset is added to them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.cia402 import compute_target_range
from fdhil.config.axis_section import Axis
from fdhil.config.offset_bounds import OffsetBounds

_SHOWN = 1e4  # resolution of shown positions, 1/mm


@dataclass(frozen=True, slots=True)
class PositionRange:
    """The set-points of one axis in increments, from ``low`` to ``high``; ``per_mm`` has the sign of the drive.

    ``unit`` of ``mm_per_unit`` is the unit in which the axis is shown.
    """

    axis: str
    low: int
    high: int
    per_mm: float
    unit: str = "mm"
    mm_per_unit: float = 1.0

    @staticmethod
    def build_for_axis(name: str, axis: Axis, sync_period_s: float) -> PositionRange:
        """Return the range of an axis: INTEGER32 less the largest offset that may be sent to it."""
        most = (
            OffsetBounds.compute_configured(axis, sync_period_s).whole_increments[0]
            if axis.correction is not None
            else 0
        )
        per_mm = axis.scaling.sign * axis.scaling.increments_per_mm
        return PositionRange(name, *compute_target_range(most), per_mm, axis.unit, axis.mm_per_unit)

    def can_reach(self, position_mm: float) -> bool:
        """Return whether the set-point of a finite position, with any allowed offset, fits into 32 bits."""
        return self.low <= round(position_mm * self.per_mm) <= self.high

    def find_last_mm(self, position_mm: float) -> float:
        """Return the last position that fits on the way to one that does not, rounded towards zero."""
        end = self.high if position_mm * self.per_mm > 0.0 else self.low
        return math.trunc(end / self.per_mm * _SHOWN) / _SHOWN

    def describe_fault(self, position_mm: float) -> str:
        unit, here, last = self.unit, position_mm / self.mm_per_unit, self.find_last_mm(position_mm) / self.mm_per_unit
        text = f"axis {self.axis} at {here:.10g} {unit}: the set-point with its largest offset exceeds 32 bits"
        text += f" of increments ({abs(self.per_mm) * self.mm_per_unit:.10g} per {unit}); the last position that fits"
        text += f" is {last:.10g} {unit}; move the workpiece, or set the drive to coarser increments"
        return text
