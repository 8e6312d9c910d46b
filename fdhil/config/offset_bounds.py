"""Derives the offset limits per SYNC from [axis.X.correction], for the planner and for the guard."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from fdhil.config.axis_section import CEILING_ACCELERATION_MM_S2, CEILING_OFFSET_UM, CEILING_SPEED_MM_S, Axis

AXIS_SPEED_SHARE = 0.10  # largest share of the axis' speed for an offset
AXIS_ACCELERATION_SHARE = 0.50
VARIATION_MM = 3.0
VARIATION_S = 1.0
TIME_TO_SAFE_S = 0.120
BRAKING_S = 0.020  # of a slow axis; braking counts three times
DETECTION_CYCLES = 3
LEAST_INCREMENTS = 0.5  # one increment would more than double a smaller value
_ULPS = 1e-9  # against rounding: 20 mm/s at 50 per mm are one increment


@dataclass(frozen=True, slots=True)
class OffsetBounds:
    """``offset`` increments, ``rate`` per cycle, ``acceleration`` per cycle^2, ``variation`` per ``window`` cycles."""

    offset: float
    rate: float
    acceleration: float
    variation: float
    window: int

    @staticmethod
    def compute_configured(axis: Axis, sync_period_s: float) -> OffsetBounds:
        """Convert the configured limits to increments; ValueError when writing is off."""
        if axis.correction is None:
            raise ValueError("writing is off for this axis")
        own, scale = axis.correction, axis.scaling.increments_per_mm
        return OffsetBounds(
            offset=own.max_offset_um * 1e-3 * scale,
            rate=own.max_speed_mm_s * scale * sync_period_s,
            acceleration=own.max_acceleration_mm_s2 * scale * sync_period_s**2,
            variation=VARIATION_MM * scale,
            window=round(VARIATION_S / sync_period_s),
        )

    @staticmethod
    def derive(axis: Axis, sync_period_s: float) -> OffsetBounds:
        """Return the effective limits: the configured ones within the axis' share, lowered until an offset can be
        removed in time.

        ValueError when writing is off (no ``[axis.X.correction]``).
        """
        given, scale = OffsetBounds.compute_configured(axis, sync_period_s), axis.scaling.increments_per_mm
        share = AXIS_ACCELERATION_SHARE * axis.max_acceleration_mm_s2 * scale * sync_period_s**2
        limits = replace(
            given,
            rate=min(given.rate, AXIS_SPEED_SHARE * axis.top_speed_mm_s * scale * sync_period_s),
            acceleration=min(given.acceleration, share),
        )
        if not limits.is_too_coarse and limits.compute_time_to_safe_s(sync_period_s) > TIME_TO_SAFE_S:
            braking = max(1, math.floor(BRAKING_S / sync_period_s))
            ramp = max(1, math.floor(TIME_TO_SAFE_S / sync_period_s) - DETECTION_CYCLES - 2 - 3 * braking)
            rate = min(limits.rate, float(braking * _round_down(limits.acceleration)))
            limits = replace(limits, rate=rate, offset=min(limits.offset, float(ramp * _round_down(rate))))
        return limits

    @property
    def is_too_coarse(self) -> bool:
        """Whether an increment is more than the largest offset, or more than twice what a cycle may change."""
        return self.offset < 1.0 - _ULPS or min(self.rate, self.acceleration) < LEAST_INCREMENTS

    def compute_time_to_safe_s(self, sync_period_s: float) -> float:
        """Return the longest time from a fault to zero: n_detect + 1 + L/S + 3 S/A cycles."""
        offset, rate, acceleration, _, _ = self.whole_increments
        return (DETECTION_CYCLES + 1 - (-offset // rate) - 3 * (-rate // acceleration)) * sync_period_s

    @property
    def whole_increments(self) -> tuple[int, int, int, int, int]:
        """The limits in whole increments, rounded down but at least one, as the guard enforces them on every frame."""
        offset, rate, acceleration = map(_round_down, (self.offset, self.rate, self.acceleration))
        return offset, rate, acceleration, math.floor(self.variation + _ULPS), self.window


def _round_down(increments: float) -> int:
    """Round down; one increment is the least that can be sent."""
    return max(1, math.floor(increments + _ULPS))


def find_limit_faults(axis: Axis, sync_period_s: float) -> list[str]:
    """Explain why the configured limits cannot be kept: increments too coarse, or ramp to zero too long."""
    if axis.correction is None:
        return []
    if axis.unit == "deg":
        own, per_deg = axis.correction, axis.mm_per_unit
        for key, value, most in (
            ("max_offset_mdeg", own.max_offset_um / per_deg, CEILING_OFFSET_UM),
            ("max_speed_deg_s", own.max_speed_mm_s / per_deg, CEILING_SPEED_MM_S),
            ("max_acceleration_deg_s2", own.max_acceleration_mm_s2 / per_deg, CEILING_ACCELERATION_MM_S2),
        ):
            if value > most * (1 + 1e-9):
                return [f"{key} is {value:.4g}; a rotary axis is limited to {most:g}, whatever its radius"]
    limits = OffsetBounds.compute_configured(axis, sync_period_s)
    if limits.is_too_coarse:
        return [_describe_coarse_limit(axis, limits)]
    needed_s = limits.compute_time_to_safe_s(sync_period_s)
    if needed_s > TIME_TO_SAFE_S:
        return [
            f"from the largest offset to zero these limits need {needed_s * 1e3:.0f} ms, 120 are allowed"
            " (lower max_offset_um or raise max_speed_mm_s)"
        ]
    return []


def find_share_fault(axis: Axis, sync_period_s: float) -> str | None:
    """Explain why so slow an axis cannot be corrected: its share of speed or acceleration is below one increment."""
    limits = OffsetBounds.derive(axis, sync_period_s)
    return _describe_coarse_limit(axis, limits) if limits.is_too_coarse else None


def _describe_coarse_limit(axis: Axis, limits: OffsetBounds) -> str:
    name, finest = min(
        ("max_offset_um", limits.offset),
        ("max_speed_mm_s", limits.rate),
        ("max_acceleration_mm_s2", limits.acceleration),
        key=lambda pair: pair[1] if pair[0] == "max_offset_um" else pair[1] / LEAST_INCREMENTS,
    )
    per_turn = axis.drive.increments_per_rev
    text = f"{per_turn:,} increments per turn are too coarse: {name} is {finest:.2g} of an increment per SYNC cycle"
    if not finest * 2**31 > per_turn:
        return f"{text}, and no resolution suffices (raise {name}, or sync_period_s)"
    return f"{text} (set the drive to {math.ceil(per_turn / finest - 1e-6):,} or more per turn, or raise {name})"
