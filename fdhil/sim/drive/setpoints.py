"""Computes the loops' set-points: the cyclic ones with their delay, and the drive's own ramps and profiles.

For the beginning cycle, the cyclic set-points and the profile give the demand at its start, at its end and one cycle
later (increments): the feed-forward runs linearly from the slope of this cycle to that of the next.
"""

import math
from collections import deque
from typing import NamedTuple

from fdhil.sim.drive.plant_physics import Command


class CycleSetpoint(NamedTuple):
    """One cycle's set-point: target and offset in increments, speed offset in rad/s, current offset in A."""

    position: float
    offset: float
    speed: float
    current: float


class CyclicSetpoints:
    """The set-points of cyclic synchronous position, executed ``delay`` SYNC cycles late."""

    def __init__(self, delay: int, sync_period_s: float, offset_in_feedforward: bool) -> None:
        self._delay = delay
        self._period_s = sync_period_s
        self._offset_in_feedforward = offset_in_feedforward
        # the cycle before, the cycle in force, and those to come
        self._queue: deque[CycleSetpoint] = deque(maxlen=delay + 2)
        self.fill_delay(CycleSetpoint(0.0, 0.0, 0.0, 0.0))

    def fill_delay(self, target: CycleSetpoint) -> None:
        self._queue.extend([target] * (self._delay + 2))

    def push_setpoint(self, target: CycleSetpoint) -> None:
        self._queue.append(target)

    @property
    def current(self) -> CycleSetpoint:
        """The target in force at the SYNC that was pushed last."""
        return self._queue[1]

    def compute_command(self) -> Command:
        """Return the command of the beginning cycle, see :func:`fdhil.sim.drive.plant_physics.simulate_sync_cycle`.

        With a delay of one cycle the slope after this cycle is unknown and is held. Without a delay the set-point is a
        staircase, and its slope is that of the last step.
        """
        queue, period = self._queue, self._period_s
        first = queue[1]
        second = queue[2] if self._delay >= 1 else first
        p0, p1 = first.position + first.offset, second.position + second.offset
        if self._delay >= 2:
            f0, f1 = self._compute_slope(first, second), self._compute_slope(second, queue[3])
        elif self._delay == 1:
            f0 = f1 = self._compute_slope(first, second)
        else:
            f0 = f1 = self._compute_slope(queue[0], first)
        return p0, p1, f0 / period, f1 / period, first.speed, second.speed, first.current, second.current

    def _compute_slope(self, first: CycleSetpoint, second: CycleSetpoint) -> float:
        slope = second.position - first.position
        return slope + second.offset - first.offset if self._offset_in_feedforward else slope


class SetpointInterpolation:
    """Interpolates set-points that come every ``cycles`` cycles (0x60C2) linearly, one interval late."""

    def __init__(self) -> None:
        self.cycles = 1
        self._step = 0
        self._from = self._to = CycleSetpoint(0.0, 0.0, 0.0, 0.0)

    def reset_target(self, target: CycleSetpoint) -> None:
        self._from = self._to = target
        self._step = 0

    def interpolate_next(self, target: CycleSetpoint, *, synced: bool) -> CycleSetpoint:
        """Return this cycle's set-point; ``target`` was received last, ``synced``: a SYNC begins the cycle."""
        if self.cycles == 1:
            self.reset_target(target)
            return target
        if synced or self._step >= self.cycles:
            self._from, self._to, self._step = self._interpolate(), target, 0
        self._step += 1
        return self._interpolate()

    def _interpolate(self) -> CycleSetpoint:
        if not 0 < self._step < self.cycles:
            return self._to if self._step else self._from
        part = self._step / self.cycles
        return CycleSetpoint(*(a + (b - a) * part for a, b in zip(self._from, self._to, strict=True)))


class ValueRamp:
    """A speed or torque ramp to a target: ``before`` at the start of a cycle, ``now`` at its end."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self.start_from(0.0)

    def start_from(self, value: float) -> None:
        self.before = self.now = float(value)

    def advance_cycle(self, target: float, rising: float, falling: float) -> None:
        """Advance by one cycle; ``rising`` and ``falling`` are the rates (1/s) of a growing and a falling magnitude."""
        self.before = self.now
        grows = abs(target) > abs(self.now) and target * self.now >= 0
        step = (rising if grows else falling) * self._period_s
        self.now += min(max(target - self.now, -step), step)


class MotionProfile:
    """The drive's own motion: a trapezoid to a target, or a ramp to standstill. Increments and seconds."""

    def __init__(self, sync_period_s: float) -> None:
        self._period_s = sync_period_s
        self._points = (0.0, 0.0, 0.0)
        self._speed = 0.0

    def start_from(self, position: float, speed: float) -> None:
        position = float(position)  # an int would make numba compile the cycle again
        before = position - speed * self._period_s
        self._points = (before, position, position + speed * self._period_s)
        self._speed = speed

    @property
    def is_at_rest(self) -> bool:
        """Whether the demand is at rest, now and in the cycles already planned."""
        return self._points[0] == self._points[1] == self._points[2]

    @property
    def current(self) -> float:
        """The demand at the present cycle."""
        return self._points[0]

    def advance_cycle(self, target: float | None, speed: float, acceleration: float, deceleration: float) -> None:
        """Advance by one cycle; without a target the demand decelerates to rest."""
        last = self._points[2]
        if target is None:
            drop = deceleration * self._period_s
            following = math.copysign(max(abs(self._speed) - drop, 0.0), self._speed)
            position = last + (self._speed + following) / 2 * self._period_s
        else:
            following, position = self._approach_target(target, last, speed, acceleration, deceleration)
        self._speed = following
        self._points = (self._points[1], last, position)

    def _approach_target(
        self, target: float, position: float, speed: float, acceleration: float, deceleration: float
    ) -> tuple[float, float]:
        period = self._period_s
        distance = target - position
        toward = math.copysign(1.0, distance)
        # the fastest speed from which whole cycles of deceleration still stop at the target
        step = deceleration * period / 2
        reachable = math.sqrt(step * step + 2 * deceleration * abs(distance)) - step
        wanted = toward * min(speed, reachable)
        rate = acceleration if wanted * self._speed >= 0 and abs(wanted) > abs(self._speed) else deceleration
        following = self._speed + min(max(wanted - self._speed, -rate * period), rate * period)
        moved = following * period
        if moved * toward >= abs(distance) and abs(following) <= 2 * deceleration * period:
            return 0.0, target
        return following, position + moved

    def compute_command(self) -> Command:
        first, second, third = self._points
        return (
            first, second, (second - first) / self._period_s, (third - second) / self._period_s, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip
