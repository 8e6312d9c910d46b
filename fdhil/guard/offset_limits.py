"""Limits an offset, in whole drive increments per SYNC cycle, and moves it within these limits.

All of it is integer arithmetic: no NaN, no rounding, and a test can enumerate every start. The check of a frame
(``find_limit_violation``) shares no formula with the motion (``move_toward_goal``), so that each guards the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, isqrt

# ceilings that no settings file can raise
CEILING_OFFSET_UM = 250.0
CEILING_SPEED_MM_S = 20.0
CEILING_ACCELERATION_MM_S2 = 2000.0
CEILING_VARIATION_MM = 3.0  # in any second
LEAST_INCREMENTS = 0.5
SPEED_SHARE, ACCELERATION_SHARE = 0.10, 0.50  # of the axis' own
# a table is a rounded curve: its first difference may be 1, its second 2 increments beyond the curve's own
ROUNDING_RATE = 1
ROUNDING_ACCELERATION = 2


@dataclass(frozen=True, slots=True)
class OffsetLimits:
    """``offset`` in increments, ``rate`` per cycle, ``acceleration`` per cycle^2, ``variation`` per ``window``.

    ``window`` is one second in SYNC cycles: within it the offset may travel ``variation`` increments in total, which
    bounds an oscillating table.
    """

    offset: int
    rate: int
    acceleration: int
    variation: int
    window: int

    @property
    def hard_rate(self) -> int:
        """Largest first difference of two frames."""
        return self.rate + ROUNDING_RATE

    @property
    def hard_acceleration(self) -> int:
        """Largest second difference of three frames."""
        return self.acceleration + ROUNDING_ACCELERATION


def compute_offset_ceiling(increments_per_mm: float) -> int:
    """Return the largest offset, in increments, that may ever be sent, whatever is read or configured."""
    return floor(CEILING_OFFSET_UM * 1e-3 * increments_per_mm + 1e-9)


def compute_limit_ceilings(
    increments_per_mm: float, sync_period_s: float, max_speed_mm_s: float, max_acceleration_mm_s2: float
) -> OffsetLimits:
    """Return the largest limits that settings may give such an axis, rounded down; 0: its increments are too coarse."""
    speed = min(CEILING_SPEED_MM_S, SPEED_SHARE * max_speed_mm_s)
    acceleration = min(CEILING_ACCELERATION_MM_S2, ACCELERATION_SHARE * max_acceleration_mm_s2)
    return OffsetLimits(
        offset=compute_offset_ceiling(increments_per_mm),
        rate=_round_down_to_increment(speed * increments_per_mm * sync_period_s),
        acceleration=_round_down_to_increment(acceleration * increments_per_mm * sync_period_s**2),
        variation=floor(CEILING_VARIATION_MM * increments_per_mm + 1e-9),
        window=round(1.0 / sync_period_s),
    )


def _round_down_to_increment(increments: float) -> int:
    """Round down, but to at least 1, the smallest step; 0 where 1 is more than twice the value."""
    return max(1, floor(increments + 1e-9)) if increments >= LEAST_INCREMENTS else 0


def compute_stopping_distance(rate: int, acceleration: int) -> int:
    """Return the distance that an offset at ``rate`` >= 0 still travels, braking by ``acceleration`` each cycle."""
    steps = rate // acceleration
    return steps * rate - acceleration * steps * (steps + 1) // 2


def compute_approach_rate(distance: int, acceleration: int) -> int:
    """Return the largest rate u with u + its stopping distance <= ``distance`` >= 0.

    It is the fastest move that still stops there.
    """
    steps = (isqrt(8 * distance // acceleration + 1) + 1) // 2
    return (distance + acceleration * steps * (steps - 1) // 2) // steps


def limit_value(value: int, low: int, high: int) -> int:
    """Return ``value`` limited to [low, high]."""
    return min(max(value, low), high)


def move_toward_goal(limits: OffsetLimits, offset: int, rate: int, wanted: int, wanted_rate: int) -> int:
    """Return the next offset toward a moving goal: ``wanted`` next cycle, moving at ``wanted_rate``.

    The difference is closed without overshoot and within the acceleration; once on the goal it is met exactly. A goal
    that stands at 0 is the ramp to zero.
    """
    missing = wanted - offset - wanted_rate
    closing = compute_approach_rate(abs(missing), limits.acceleration)
    speed = wanted_rate + (closing if missing > 0 else -closing)
    if speed != wanted_rate or abs(speed - rate) > limits.hard_acceleration:
        speed = limit_value(speed, rate - limits.acceleration, rate + limits.acceleration)
    speed = limit_value(speed, -limits.hard_rate, limits.hard_rate)
    return _limit_outward_speed(limits, offset, rate, speed)


def decelerate_offset(limits: OffsetLimits, offset: int, rate: int) -> int:
    """Return the next offset of one that brakes to a stop."""
    speed = rate - limit_value(rate, -limits.acceleration, limits.acceleration)
    return _limit_outward_speed(limits, offset, rate, limit_value(speed, -limits.hard_rate, limits.hard_rate))


def _limit_outward_speed(limits: OffsetLimits, offset: int, rate: int, speed: int) -> int:
    """Brake an outward speed in time for the largest offset, harder than usual where rounding requires it."""
    outward = 1 if speed > 0 else -1
    room = max(0, limits.offset - outward * offset)
    allowed = compute_approach_rate(room, limits.hard_acceleration)
    if abs(speed) > allowed:
        speed = outward * max(allowed, outward * rate - limits.hard_acceleration)
    return offset + speed


def find_limit_violation(limits: OffsetLimits, before: int, rate: int, offset: int) -> str | None:
    """Check one frame against the one before it and its rate; return the class of the broken limit, or None.

    Braking-aware: an offset that moves outward must still be able to stop at the limit.
    """
    speed = offset - before
    if not abs(offset) <= max(limits.offset, abs(before)):  # an adopted offset may start beyond the limit
        return "OffsetLimit"
    if not abs(speed) <= limits.hard_rate or not abs(speed - rate) <= limits.hard_acceleration:
        return "OffsetRate"
    outward = speed > 0 if offset > 0 else speed < 0 if offset < 0 else False
    if outward and not abs(offset) + compute_stopping_distance(abs(speed), limits.hard_acceleration) <= limits.offset:
        return "OffsetLimit"
    return None


@dataclass(frozen=True, slots=True)
class OffsetTravel:
    """Distance that an offset travelled within the last second, in tenths of a second to keep it cheap."""

    current: int = 0
    filled: int = 0
    past: tuple[int, ...] = ()

    def add_move(self, move: int, window: int) -> OffsetTravel:
        """Return the record with one more cycle; ``window`` is one second in cycles."""
        share = max(1, window // 10)
        if self.filled + 1 < share:
            return OffsetTravel(self.current + abs(move), self.filled + 1, self.past)
        return OffsetTravel(0, 0, (*self.past, self.current + abs(move))[-(window // share - 1) :])

    @property
    def total(self) -> int:
        """Increments travelled within the last 0.9 to 1.0 second."""
        return self.current + sum(self.past)
