"""From [axis.X.correction] to what an offset may do per SYNC: the one derivation, for the planner and for the guard."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.config.axis import CEILING_ACCELERATION_MM_S2, Axis

AXIS_SPEED_SHARE = 0.10  # an offset never takes more than this of the axis' own speed
AXIS_ACCELERATION_SHARE = 0.50
VARIATION_MM = 3.0
DEFAULT_ACCELERATION_MM_S2 = 250.0
VARIATION_S = 1.0
TIME_TO_SAFE_S = 0.120
DETECTION_CYCLES = 3
_ULPS = 1e-9  # so that 20 mm/s of 50 per mm are one increment, and not one less


@dataclass(frozen=True, slots=True)
class OffsetLimits:
    """``offset`` increments, ``rate`` per cycle, ``acceleration`` per cycle^2, ``variation`` per ``window`` cycles."""

    offset: float
    rate: float
    acceleration: float
    variation: float
    window: int

    @staticmethod
    def of(axis: Axis, sync_period_s: float) -> OffsetLimits:
        """Return the limits of an axis; ValueError when writing is off (no ``[axis.X.correction]``)."""
        if axis.correction is None:
            raise ValueError("writing is off for this axis")
        scale, given = axis.scaling.increments_per_mm, axis.correction
        speed = min(given.max_speed_mm_s, AXIS_SPEED_SHARE * axis.top_speed_mm_s)
        finest = max(DEFAULT_ACCELERATION_MM_S2, 1 / (scale * sync_period_s**2))
        acceleration = given.max_acceleration_mm_s2 or min(finest, CEILING_ACCELERATION_MM_S2)
        acceleration = min(acceleration, AXIS_ACCELERATION_SHARE * axis.max_acceleration_mm_s2)
        return OffsetLimits(
            offset=given.max_offset_um * 1e-3 * scale,
            rate=speed * scale * sync_period_s,
            acceleration=acceleration * scale * sync_period_s**2,
            variation=VARIATION_MM * scale,
            window=round(VARIATION_S / sync_period_s),
        )

    @property
    def whole(self) -> tuple[int, int, int, int, int]:
        """The same in whole increments, rounded down: what the guard holds every frame to."""
        offset, rate = math.floor(self.offset + _ULPS), math.floor(self.rate + _ULPS)
        return offset, rate, math.floor(self.acceleration + _ULPS), math.floor(self.variation + _ULPS), self.window


def limit_faults(axis: Axis, sync_period_s: float) -> list[str]:
    """Say why the limits of an axis cannot be kept: its increments are too coarse, or the way to zero is too long."""
    if axis.correction is None:
        return []
    limits = OffsetLimits.of(axis, sync_period_s)
    offset, rate, acceleration, _, _ = limits.whole
    if min(offset, rate, acceleration) < 1:
        return [_too_coarse(axis, limits)]
    cycles = DETECTION_CYCLES + 1 + -(-offset // rate) + 3 * -(-rate // acceleration)
    if cycles * sync_period_s > TIME_TO_SAFE_S:
        return [
            f"from the largest offset to zero these limits need {cycles * sync_period_s * 1e3:.0f} ms, 120 are allowed"
            " (lower max_offset_um, or raise max_speed_mm_s or max_acceleration_mm_s2 where the axis allows more)"
        ]
    return []


def _too_coarse(axis: Axis, limits: OffsetLimits) -> str:
    """Name the finest limit that is less than one increment, and the resolution that would do for all."""
    name, finest = min(
        ("max_offset_um", limits.offset),
        ("max_speed_mm_s", limits.rate),
        ("max_acceleration_mm_s2", limits.acceleration),
        key=lambda pair: pair[1],
    )
    per_turn = axis.drive.increments_per_rev
    text = f"{per_turn:,} increments per turn are too coarse: {name} is {finest:.2g} of an increment per SYNC cycle"
    if not finest * 2**31 > per_turn:
        return f"{text}, and no resolution would do (raise {name}, or sync_period_s)"
    return f"{text} (set the drive to {math.ceil(per_turn / finest - 1e-6):,} or more per turn, or raise {name})"
