"""Selects the set-point of the loops: modes of operation, ramps of the power state machine, the halt bit."""

import math
from enum import Enum, auto
from operator import itemgetter

from fdhil.sim.drive import operation_modes
from fdhil.sim.drive.drive_objects import DriveRatings
from fdhil.sim.drive.drive_sensors import DriveFaults
from fdhil.sim.drive.homing import HomingRun, HomingState, Switches
from fdhil.sim.drive.motion_limits import MotionLimits, TargetWindow
from fdhil.sim.drive.object_dictionary import ObjectDictionary
from fdhil.sim.drive.open_loop_modes import MeasuredState, OpenLoopModes
from fdhil.sim.drive.plant_physics import ClosedLoops, Command
from fdhil.sim.drive.power_stage import PowerStage, StopRamp
from fdhil.sim.drive.setpoints import CycleSetpoint, CyclicSetpoints, MotionProfile, SetpointInterpolation

_REST: Command = (0.0,) * 8
_NEW_SETPOINT, _AT_ONCE, _RELATIVE, _HALT = 0x10, 0x20, 0x40, 0x100
# target, position offset, velocity offset, torque offset, software limits of the cyclic modes
_cyclic = itemgetter(0x607A00, 0x60B000, 0x60B100, 0x60B200, 0x607D01, 0x607D02)
_TARGET_REACHED, _MODE_SPECIFIC, _HOMING_ERROR = 1 << 10, 1 << 12, 1 << 13
_FAR = 1e12  # increments: a search runs until it finds its mark


class SetpointSource(Enum):
    OFF = auto()
    CYCLIC = auto()
    PROFILE = auto()
    VELOCITY = auto()
    TORQUE = auto()
    HOMING = auto()
    STOP = auto()


_SOURCES = {
    operation_modes.PROFILE_POSITION: SetpointSource.PROFILE,
    operation_modes.PROFILE_VELOCITY: SetpointSource.VELOCITY,
    operation_modes.PROFILE_TORQUE: SetpointSource.TORQUE,
    operation_modes.HOMING: SetpointSource.HOMING,
    **dict.fromkeys(operation_modes.CYCLIC, SetpointSource.CYCLIC),
}
_LOOPS = {
    operation_modes.PROFILE_VELOCITY: ClosedLoops.SPEED,
    operation_modes.CYCLIC_VELOCITY: ClosedLoops.SPEED,
    operation_modes.PROFILE_TORQUE: ClosedLoops.CURRENT,
    operation_modes.CYCLIC_TORQUE: ClosedLoops.CURRENT,
}


class SetpointSelector:
    """Computes the set-point of each cycle, in increments. ``limited``: the software position limit is active.

    ``loops`` are the closed loops that ``command`` addresses; ``synced``: a SYNC begins the next cycle. ``shift`` is
    the drive's zero, raw increments, set by homing.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        power: PowerStage,
        ratings: DriveRatings,
        faults: DriveFaults,
        cyclic: CyclicSetpoints,
        switches: Switches,
        position_loop: tuple[float, float],
    ) -> None:
        self._numbers = dictionary.numbers
        self._power = power
        self._faults = faults
        self._rad_per_increment = 2 * math.pi / ratings.increments_per_rev
        self._rated_current_a = ratings.rated_current_a
        self._gain, self._feedforward = position_loop
        self.cyclic = cyclic
        self.interpolation = SetpointInterpolation()
        self.synced = False
        self.homing = HomingRun(switches, ratings.increments_per_rev)
        self.shift = 0
        self._limits = MotionLimits(self._numbers, ratings)
        period_s = ratings.sync_period_s
        self._profile = MotionProfile(period_s)
        self._open = OpenLoopModes(self._numbers, self._limits, ratings)
        self._arrived = TargetWindow(self._numbers, 0x606700, 0x606800, period_s)
        self.source = SetpointSource.OFF
        self.loops = self._loops_before = ClosedLoops.POSITION
        self.command = _REST
        self.limited = False
        self.reset_position(0)

    def reset_position(self, position: int) -> None:
        """Reset to standstill at ``position`` increments, at power-on."""
        self._numbers[0x607A << 8] = position
        self._preset_setpoint(CycleSetpoint(position, 0.0, 0.0, 0.0))
        self.source, self.loops, self.command = SetpointSource.OFF, ClosedLoops.POSITION, _REST
        self.homing.reset_search()
        self._target: float | None = None
        self._pending: float | None = None
        self._acknowledged = False
        self._position = float(position)
        self._pushed_mode = operation_modes.CYCLIC_POSITION
        self._homing_asked = False
        self._last_word = 0

    @property
    def mode(self) -> int:
        """The mode in force, 0x6061."""
        if self._faults.not_csp:
            return operation_modes.PROFILE_POSITION
        return self._numbers[0x606000]

    @property
    def is_sync_bound(self) -> bool:
        return self._power.powered and self._numbers[0x606000] in operation_modes.CYCLIC

    @property
    def status_bits(self) -> int:
        """Bits 10, 12 and 13 of the statusword, as the mode defines them; bit 13 in homing only."""
        halted = self.source is SetpointSource.STOP and self._profile.is_at_rest
        match self.mode:
            case operation_modes.PROFILE_POSITION:
                return self._compute_profile_position_bits(halted)
            case operation_modes.PROFILE_VELOCITY:
                standing = _MODE_SPECIFIC if self._open.stands.is_reached else 0
                following = self.source is SetpointSource.VELOCITY and self._open.at_speed.is_reached
                return standing | (_TARGET_REACHED if following or halted else 0)
            case operation_modes.PROFILE_TORQUE:
                following = self.source is SetpointSource.TORQUE and self._open.is_torque_reached
                return _TARGET_REACHED if following or halted else 0
            case operation_modes.HOMING:
                return self._compute_homing_bits()
            case operation_modes.CYCLIC_POSITION | operation_modes.CYCLIC_VELOCITY | operation_modes.CYCLIC_TORQUE:
                if self.source is SetpointSource.CYCLIC:
                    return _MODE_SPECIFIC
                return _TARGET_REACHED if halted and self._power.follows_setpoints else 0
        return 0

    def _compute_profile_position_bits(self, halted: bool) -> int:
        bits = _MODE_SPECIFIC if self._acknowledged else 0
        reached = self._pending is None and self._profile.is_at_rest
        if self._target is not None:
            reached = reached and self._target == self._profile.current and self._arrived.is_reached
        return bits | (_TARGET_REACHED if reached or halted else 0)

    def _compute_homing_bits(self) -> int:
        bits = {HomingState.DONE: _MODE_SPECIFIC, HomingState.ERROR: _HOMING_ERROR}.get(self.homing.state, 0)
        rests = self._profile.is_at_rest and self.homing.state is not HomingState.RUNNING
        return bits | (_TARGET_REACHED if rests else 0)

    def evaluate_controlword(self, word: int) -> None:
        """Evaluate bit 4 of a controlword: profile position handshake, start of a homing (CiA 402-2)."""
        rising = word & _NEW_SETPOINT and not self._last_word & _NEW_SETPOINT
        self._last_word = word
        mode = self.mode
        if mode == operation_modes.HOMING and rising and self._power.follows_setpoints:
            self._homing_asked = True
        if mode != operation_modes.PROFILE_POSITION or not self._power.follows_setpoints:
            self._acknowledged = False
            return
        if rising and not self._acknowledged:
            self._acknowledged = True
            self._take_target(word)
        elif not word & _NEW_SETPOINT and self._pending is None:
            self._acknowledged = False

    def _take_target(self, word: int) -> None:
        numbers = self._numbers
        target = float(numbers[0x607A00])
        if word & _RELATIVE:
            target += self._relative_base
        low, high = numbers.get(0x607D01, -(2**31)), numbers.get(0x607D02, 2**31 - 1)
        target = float(min(max(target, low), high))
        if (
            word & _AT_ONCE
            or self._target is None
            or (self._profile.is_at_rest and self._profile.current == self._target)
        ):
            self._target, self._pending = target, None
        else:
            self._pending = target

    @property
    def _relative_base(self) -> float:
        """The position to which a relative target is added: the previous target, else the actual demand."""
        if self._target is not None:
            return self._target
        return self._profile.current if self.source in (SetpointSource.PROFILE, SetpointSource.STOP) else self._position

    def begin_cycle(self, actual: MeasuredState) -> Command:
        """Apply the present set-points and return the command of the cycle."""
        self._push_setpoint(actual)
        source = self._choose_source()
        self._position = actual.position
        if source is not SetpointSource.PROFILE and source is not SetpointSource.STOP:
            self._target = self._pending = None
        if source is not SetpointSource.HOMING:
            self._homing_asked = False
            if self.homing.state is HomingState.RUNNING:
                self.homing.reset_search()
        if self._numbers[0x606000] == operation_modes.PROFILE_VELOCITY:
            self._open.update_windows(actual)
        self._loops_before, self.loops = self.loops, ClosedLoops.POSITION
        if source is SetpointSource.OFF:
            self.command = _REST
        elif source is SetpointSource.CYCLIC:
            self.command = self._compute_cyclic_command(actual)
        else:
            self.command = self._compute_own_command(source, actual)
        self.source = source
        return self.command

    @property
    def demand(self) -> float:
        """The position demand at the start of the cycle, increments; the actual position without a position loop."""
        if self.source is SetpointSource.OFF or (
            self.source is SetpointSource.CYCLIC and self.loops is ClosedLoops.POSITION
        ):
            now = self.cyclic.current
            return now.position + now.offset
        return self.command[0]

    def _push_setpoint(self, actual: MeasuredState) -> None:
        mode = self._numbers[0x606000]
        if mode in _LOOPS and mode in operation_modes.CYCLIC:
            if mode != self._pushed_mode:
                self._preset_setpoint(self._open.build_initial_setpoint(mode, actual))
            self._pushed_mode = mode
            self._interpolate_setpoint(self._open.build_cyclic_setpoint(mode, actual))
            return
        self._pushed_mode = operation_modes.CYCLIC_POSITION
        position, offset, speed, torque, low, high = _cyclic(self._numbers)
        acting = offset * float(self._faults.offset_scale)
        self.limited = not low <= position + acting <= high
        target = min(max(position + acting, low), high) - acting if self.limited else position
        self._interpolate_setpoint(
            CycleSetpoint(target, acting, speed * self._rad_per_increment, torque * 1e-3 * self._rated_current_a)
        )

    def _interpolate_setpoint(self, target: CycleSetpoint) -> None:
        self.cyclic.push_setpoint(self.interpolation.interpolate_next(target, synced=self.synced))
        self.synced = False

    def _preset_setpoint(self, target: CycleSetpoint) -> None:
        self.cyclic.fill_delay(target)
        self.interpolation.reset_target(target)

    def _choose_source(self) -> SetpointSource:
        if not self._power.powered:
            return SetpointSource.OFF
        numbers = self._numbers
        if not self._power.follows_setpoints or numbers[0x604000] & _HALT or self._faults.not_csp:
            return SetpointSource.STOP
        return _SOURCES.get(numbers[0x606000], SetpointSource.STOP)

    def _compute_cyclic_command(self, actual: MeasuredState) -> Command:
        mode = self._pushed_mode
        if mode == operation_modes.CYCLIC_POSITION:
            return self.cyclic.compute_command()
        self.loops = _LOOPS[mode]
        return self._open.compute_cyclic_command(mode, actual, self.cyclic.compute_command())

    def _compute_own_command(self, source: SetpointSource, actual: MeasuredState) -> Command:
        if source is SetpointSource.VELOCITY or source is SetpointSource.TORQUE:
            if self.source is not source:
                self._open.start_from(actual)
            self.loops = _LOOPS[self._numbers[0x606000]]
            return (
                self._open.compute_velocity_command(actual)
                if source is SetpointSource.VELOCITY
                else self._open.compute_torque_command(actual)
            )
        self._start_profile(actual)
        if source is SetpointSource.HOMING:
            self._advance_homing(actual)
        else:
            self._run_profile(source, actual)
        return self._profile.compute_command()

    def _start_profile(self, actual: MeasuredState) -> None:
        if self.source is SetpointSource.OFF:
            self._profile.start_from(actual.position, 0.0)
        elif self.source is SetpointSource.CYCLIC and self._loops_before is ClosedLoops.POSITION:
            # the demand in force, not that of the new cycle's set-point
            self._profile.start_from(self.command[1], self.command[3])
        elif self.source in (SetpointSource.CYCLIC, SetpointSource.VELOCITY, SetpointSource.TORQUE):
            # so far ahead that the position loop demands the actual speed
            ahead = (1 - self._feedforward) * actual.speed / self._gain
            self._profile.start_from(actual.position + ahead, actual.speed)

    def _run_profile(self, source: SetpointSource, actual: MeasuredState) -> None:
        limits = self._limits
        target = self._target if source is SetpointSource.PROFILE else None
        if source is SetpointSource.STOP and self._power.ramp is not None:
            self._target = self._pending = None
        self._profile.advance_cycle(
            target,
            limits.read_speed(0x608100),
            limits.read_acceleration(0x608300),
            limits.read_deceleration(self._select_stop_ramp()),
        )
        self._arrived.count_cycle(self._profile.current - actual.position if self._target is not None else 0.0)
        if not self._profile.is_at_rest:
            return
        if source is SetpointSource.PROFILE and self._pending is not None and self._profile.current == self._target:
            self._target, self._pending = self._pending, None
        if source is SetpointSource.STOP:
            self._power.finish_ramp()

    def _select_stop_ramp(self) -> int:
        """Return the key of the deceleration: 0x6085 for a quick stop or a halt with option code 2."""
        ramp = self._power.ramp
        halt = ramp is None and self._numbers[0x604000] & _HALT and self._numbers.get(0x605D00, 1) == 2
        index: int = (StopRamp.QUICK_STOP if ramp is StopRamp.QUICK_STOP or halt else StopRamp.SLOW_DOWN).value
        return index << 8

    def _advance_homing(self, actual: MeasuredState) -> None:
        run, limits = self.homing, self._limits
        raw = float(actual.position + self.shift)
        if self._homing_asked and run.state is not HomingState.RUNNING:
            run.start_search(self._numbers.get(0x609800, 0), raw, actual.inputs)
        self._homing_asked = False
        run.update_search(raw, actual.inputs)
        leg = run.current_move
        target = None if leg is None else leg.direction * _FAR
        speed = limits.read_speed(0x609901 if leg is None or leg.fast else 0x609902)
        self._profile.advance_cycle(
            target, speed, limits.read_acceleration(0x609A00), limits.read_deceleration(0x609A00)
        )
        if leg is None and self._profile.is_at_rest and run.finish_search():
            self._shift_zero(round(run.home) - self._numbers.get(0x607C00, 0))

    def _shift_zero(self, shift: int) -> None:
        """Shift the zero: the axis stays in place and gets new coordinates."""
        self._profile.start_from(self._profile.current + self.shift - shift, 0.0)
        self._preset_setpoint(CycleSetpoint(self._profile.current, 0.0, 0.0, 0.0))
        self.shift = shift
