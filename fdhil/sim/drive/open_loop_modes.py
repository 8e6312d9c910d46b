"""Computes the set-points of the modes with open outer loops: velocity and torque, profile and cyclic."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from fdhil.sim.drive import operation_modes
from fdhil.sim.drive.drive_objects import DriveRatings
from fdhil.sim.drive.motion_limits import MotionLimits, TargetWindow
from fdhil.sim.drive.plant_physics import Command
from fdhil.sim.drive.setpoints import CycleSetpoint, ValueRamp

_FADE = 0.05  # of the motor speed limit: range in which a torque toward it fades


class MeasuredState(NamedTuple):
    """The drive's feedback at the start of a cycle: increments, increments/s, A, and the bits of 0x60FD."""

    position: int
    speed: float
    current_a: float
    inputs: int


class OpenLoopModes:
    """Ramps to 0x60FF and 0x6071, and cyclic set-points; ``at_speed`` and ``stands`` watch the actual speed."""

    def __init__(self, numbers: Mapping[int, int], limits: MotionLimits, ratings: DriveRatings) -> None:
        self._numbers, self._limits = numbers, limits
        self._rad_per_increment = 2 * math.pi / ratings.increments_per_rev
        self._amperes = ratings.rated_current_a * 1e-3  # per 0.1 %, of rated torque or rated current
        period_s = ratings.sync_period_s
        self._speed, self._torque = ValueRamp(period_s), ValueRamp(period_s)
        self.at_speed = TargetWindow(numbers, 0x606D00, 0x606E00, period_s)
        self.stands = TargetWindow(numbers, 0x606F00, 0x607000, period_s)

    def start_from(self, actual: MeasuredState) -> None:
        self._speed.start_from(actual.speed)
        self._torque.start_from(actual.current_a / self._amperes)

    def update_windows(self, actual: MeasuredState) -> None:
        self.at_speed.count_cycle(actual.speed - self._target_speed)
        self.stands.count_cycle(actual.speed)

    @property
    def is_torque_reached(self) -> bool:
        return self._torque.before == self._torque.now

    @property
    def _target_speed(self) -> float:
        return self._limits.limit_speed(float(self._numbers.get(0x60FF00, 0)))

    def compute_velocity_command(self, actual: MeasuredState) -> Command:
        """Return the command of profile velocity: the ramp of 0x6083 and 0x6084 to 0x60FF."""
        ramp, limits = self._speed, self._limits
        ramp.advance_cycle(self._target_speed, limits.read_acceleration(0x608300), limits.read_deceleration(0x608400))
        position, scale = float(actual.position), self._rad_per_increment
        return position, position, 0.0, 0.0, ramp.before * scale, ramp.now * scale, 0.0, 0.0

    def compute_torque_command(self, actual: MeasuredState) -> Command:
        """Return the command of profile torque: the slope of 0x6087 to 0x6071."""
        slope = float(self._numbers.get(0x608700, 0)) or math.inf
        self._torque.advance_cycle(float(self._numbers.get(0x607100, 0)), slope, slope)
        position, scale = float(actual.position), self._amperes * self._compute_torque_share(actual, self._torque.now)
        return position, position, 0.0, 0.0, 0.0, 0.0, self._torque.before * scale, self._torque.now * scale

    def build_cyclic_setpoint(self, mode: int, actual: MeasuredState) -> CycleSetpoint:
        """Return the latched set-point of a cyclic mode with open loops, at the actual position."""
        numbers = self._numbers
        torque = numbers.get(0x60B200, 0)
        if mode == operation_modes.CYCLIC_VELOCITY:
            speed = self._limits.limit_speed(float(numbers.get(0x60FF00, 0) + numbers.get(0x60B100, 0)))
            return CycleSetpoint(actual.position, 0.0, speed * self._rad_per_increment, torque * self._amperes)
        return CycleSetpoint(actual.position, 0.0, 0.0, (torque + numbers.get(0x607100, 0)) * self._amperes)

    def build_initial_setpoint(self, mode: int, actual: MeasuredState) -> CycleSetpoint:
        """Return the set-point that holds the present motion until the first one of a cyclic mode acts."""
        speed = actual.speed * self._rad_per_increment if mode == operation_modes.CYCLIC_VELOCITY else 0.0
        return CycleSetpoint(
            actual.position, 0.0, speed, actual.current_a if mode == operation_modes.CYCLIC_TORQUE else 0.0
        )

    def compute_cyclic_command(self, mode: int, actual: MeasuredState, command: Command) -> Command:
        """Return a cyclic command without the parts of its open loops."""
        position, share = float(actual.position), 1.0
        if mode == operation_modes.CYCLIC_TORQUE:
            share = self._compute_torque_share(actual, command[7])
        return position, position, 0.0, 0.0, command[4], command[5], command[6] * share, command[7] * share

    def _compute_torque_share(self, actual: MeasuredState, torque: float) -> float:
        """Return the effective share of a torque: it fades to zero toward the motor speed limit 0x6080."""
        highest = self._limits.motor_speed
        if math.isinf(highest) or torque * actual.speed <= 0:
            return 1.0
        return min(max((highest - abs(actual.speed)) / (_FADE * highest), 0.0), 1.0)
