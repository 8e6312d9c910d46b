"""Reads limits, rates and windows of the drive's own motion; a missing object, or a value of 0, means no limit."""

import math
from collections.abc import Mapping

from fdhil.sim.drive.drive_objects import DriveRatings
from fdhil.sim.drive.motion_objects import NO_WINDOW

_REVOLUTIONS_PER_S2 = 100  # default of a drive without acceleration objects


class MotionLimits:
    """The limits of one drive, in increments and seconds, read from its objects on each call."""

    def __init__(self, numbers: Mapping[int, int], ratings: DriveRatings) -> None:
        self._numbers = numbers
        self._per_rev = ratings.increments_per_rev
        self._default_rate = float(_REVOLUTIONS_PER_S2 * ratings.increments_per_rev)

    def _read_limit(self, key: int) -> float:
        return float(self._numbers.get(key, 0)) or math.inf

    @property
    def motor_speed(self) -> float:
        """0x6080, increments/s."""
        return self._read_limit(0x608000) * self._per_rev / 60

    def limit_speed(self, wanted: float) -> float:
        """Limit a signed speed to 0x607F and 0x6080."""
        highest = min(self._read_limit(0x607F00), self.motor_speed)
        return min(max(wanted, -highest), highest)

    def read_speed(self, key: int) -> float:
        """Return the speed of an object such as 0x6081."""
        return self.limit_speed(float(self._numbers.get(key, 0)) or math.inf)

    def read_acceleration(self, key: int) -> float:
        """Return the acceleration of an object such as 0x6083, limited to 0x60C5."""
        return min(float(self._numbers.get(key, 0)) or self._default_rate, self._read_limit(0x60C500))

    def read_deceleration(self, key: int) -> float:
        """Return the deceleration of an object such as 0x6084, limited to 0x60C6."""
        return min(float(self._numbers.get(key, 0)) or self._default_rate, self._read_limit(0x60C600))


class TargetWindow:
    """Detects that a value has stayed near its target for a time, as defined by objects such as 0x6067 and 0x6068."""

    def __init__(self, numbers: Mapping[int, int], width: int, time: int, period_s: float) -> None:
        self._numbers, self._width, self._time = numbers, width, time
        self._period_ms = period_s * 1e3
        self._cycles = 0

    def count_cycle(self, error: float) -> None:
        inside = abs(error) <= self._numbers.get(self._width, NO_WINDOW)
        self._cycles = self._cycles + 1 if inside else 0

    @property
    def is_reached(self) -> bool:
        """Whether the target is reached; always True for a missing window."""
        wide = self._numbers.get(self._width, NO_WINDOW) == NO_WINDOW
        return wide or (self._cycles > 0 and (self._cycles - 1) * self._period_ms >= self._numbers.get(self._time, 0))
