"""Selects the set-point of the loops: modes of operation, ramps of the power state machine, the halt bit."""

import math
from enum import Enum, auto
from operator import itemgetter

from fdhil.sim.drive import modes
from fdhil.sim.drive.dictionary import Dictionary
from fdhil.sim.drive.homing import Homing, HomingRun, Switches
from fdhil.sim.drive.motion_limits import MotionLimits, Window
from fdhil.sim.drive.objects import Ratings
from fdhil.sim.drive.physics import Command, Loops
from fdhil.sim.drive.power import PowerStage, Ramp
from fdhil.sim.drive.sensors import DriveFaults
from fdhil.sim.drive.setpoints import CyclicSetpoints, Interpolation, Profile, Target
from fdhil.sim.drive.speed_and_torque import Actual, SpeedAndTorque

_REST: Command = (0.0,) * 8
_NEW_SETPOINT, _AT_ONCE, _RELATIVE, _HALT = 0x10, 0x20, 0x40, 0x100
# target, position offset, velocity offset, torque offset, software limits of the cyclic modes
_cyclic = itemgetter(0x607A00, 0x60B000, 0x60B100, 0x60B200, 0x607D01, 0x607D02)
_TARGET_REACHED, _MODE_SPECIFIC, _HOMING_ERROR = 1 << 10, 1 << 12, 1 << 13
_FAR = 1e12  # increments: a search runs until it finds its mark


class Source(Enum):
    OFF = auto()
    CYCLIC = auto()
    PROFILE = auto()
    VELOCITY = auto()
    TORQUE = auto()
    HOMING = auto()
    STOP = auto()


_SOURCES = {
    modes.PROFILE_POSITION: Source.PROFILE,
    modes.PROFILE_VELOCITY: Source.VELOCITY,
    modes.PROFILE_TORQUE: Source.TORQUE,
    modes.HOMING: Source.HOMING,
    **dict.fromkeys(modes.CYCLIC, Source.CYCLIC),
}
_LOOPS = {
    modes.PROFILE_VELOCITY: Loops.SPEED,
    modes.CYCLIC_VELOCITY: Loops.SPEED,
    modes.PROFILE_TORQUE: Loops.CURRENT,
    modes.CYCLIC_TORQUE: Loops.CURRENT,
}


class Motion:
    """Computes the set-point of each cycle, in increments. ``limited``: the software position limit is active.

    ``loops`` are the closed loops that ``command`` addresses; ``synced``: a SYNC begins the next cycle. ``shift`` is
    the drive's zero, raw increments, set by homing.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        power: PowerStage,
        ratings: Ratings,
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
        self.interpolation = Interpolation()
        self.synced = False
        self.homing = HomingRun(switches, ratings.increments_per_rev)
        self.shift = 0
        self._limits = MotionLimits(self._numbers, ratings)
        period_s = ratings.sync_period_s
        self._profile = Profile(period_s)
        self._open = SpeedAndTorque(self._numbers, self._limits, ratings)
        self._arrived = Window(self._numbers, 0x606700, 0x606800, period_s)
        self.source = Source.OFF
        self.loops = self._loops_before = Loops.POSITION
        self.command = _REST
        self.limited = False
        self.reset(0)

    def reset(self, position: int) -> None:
        """Reset to standstill at ``position`` increments, at power-on."""
        self._numbers[0x607A << 8] = position
        self._preset(Target(position, 0.0, 0.0, 0.0))
        self.source, self.loops, self.command = Source.OFF, Loops.POSITION, _REST
        self.homing.reset()
        self._target: float | None = None
        self._pending: float | None = None
        self._acknowledged = False
        self._position = float(position)
        self._pushed_mode = modes.CYCLIC_POSITION
        self._homing_asked = False
        self._last_word = 0

    @property
    def mode(self) -> int:
        """The mode in force, 0x6061."""
        if self._faults.not_csp:
            return modes.PROFILE_POSITION
        return self._numbers[0x606000]

    @property
    def bound(self) -> bool:
        return self._power.powered and self._numbers[0x606000] in modes.CYCLIC

    @property
    def status_bits(self) -> int:
        """Bits 10, 12 and 13 of the statusword, as the mode defines them; bit 13 in homing only."""
        halted = self.source is Source.STOP and self._profile.at_rest
        match self.mode:
            case modes.PROFILE_POSITION:
                return self._profile_position_bits(halted)
            case modes.PROFILE_VELOCITY:
                standing = _MODE_SPECIFIC if self._open.stands.reached else 0
                following = self.source is Source.VELOCITY and self._open.at_speed.reached
                return standing | (_TARGET_REACHED if following or halted else 0)
            case modes.PROFILE_TORQUE:
                following = self.source is Source.TORQUE and self._open.torque_reached
                return _TARGET_REACHED if following or halted else 0
            case modes.HOMING:
                return self._homing_bits()
            case modes.CYCLIC_POSITION | modes.CYCLIC_VELOCITY | modes.CYCLIC_TORQUE:
                if self.source is Source.CYCLIC:
                    return _MODE_SPECIFIC
                return _TARGET_REACHED if halted and self._power.follows else 0
        return 0

    def _profile_position_bits(self, halted: bool) -> int:
        bits = _MODE_SPECIFIC if self._acknowledged else 0
        reached = self._pending is None and self._profile.at_rest
        if self._target is not None:
            reached = reached and self._target == self._profile.now and self._arrived.reached
        return bits | (_TARGET_REACHED if reached or halted else 0)

    def _homing_bits(self) -> int:
        bits = {Homing.DONE: _MODE_SPECIFIC, Homing.ERROR: _HOMING_ERROR}.get(self.homing.state, 0)
        rests = self._profile.at_rest and self.homing.state is not Homing.RUNNING
        return bits | (_TARGET_REACHED if rests else 0)

    def control(self, word: int) -> None:
        """Evaluate bit 4 of a controlword: profile position handshake, start of a homing (CiA 402-2)."""
        rising = word & _NEW_SETPOINT and not self._last_word & _NEW_SETPOINT
        self._last_word = word
        mode = self.mode
        if mode == modes.HOMING and rising and self._power.follows:
            self._homing_asked = True
        if mode != modes.PROFILE_POSITION or not self._power.follows:
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
            target += self._base
        low, high = numbers.get(0x607D01, -(2**31)), numbers.get(0x607D02, 2**31 - 1)
        target = float(min(max(target, low), high))
        if word & _AT_ONCE or self._target is None or (self._profile.at_rest and self._profile.now == self._target):
            self._target, self._pending = target, None
        else:
            self._pending = target

    @property
    def _base(self) -> float:
        """The position to which a relative target is added: the previous target, else the actual demand."""
        if self._target is not None:
            return self._target
        return self._profile.now if self.source in (Source.PROFILE, Source.STOP) else self._position

    def begin_cycle(self, actual: Actual) -> Command:
        """Apply the present set-points and return the command of the cycle."""
        self._push(actual)
        source = self._choose()
        self._position = actual.position
        if source is not Source.PROFILE and source is not Source.STOP:
            self._target = self._pending = None
        if source is not Source.HOMING:
            self._homing_asked = False
            if self.homing.state is Homing.RUNNING:
                self.homing.reset()
        if self._numbers[0x606000] == modes.PROFILE_VELOCITY:
            self._open.watch(actual)
        self._loops_before, self.loops = self.loops, Loops.POSITION
        if source is Source.OFF:
            self.command = _REST
        elif source is Source.CYCLIC:
            self.command = self._cyclic_command(actual)
        else:
            self.command = self._own_command(source, actual)
        self.source = source
        return self.command

    @property
    def demand(self) -> float:
        """The position demand at the start of the cycle, increments; the actual position without a position loop."""
        if self.source is Source.OFF or (self.source is Source.CYCLIC and self.loops is Loops.POSITION):
            now = self.cyclic.now
            return now.position + now.offset
        return self.command[0]

    def _push(self, actual: Actual) -> None:
        mode = self._numbers[0x606000]
        if mode in _LOOPS and mode in modes.CYCLIC:
            if mode != self._pushed_mode:
                self._preset(self._open.held(mode, actual))
            self._pushed_mode = mode
            self._spread(self._open.target(mode, actual))
            return
        self._pushed_mode = modes.CYCLIC_POSITION
        position, offset, speed, torque, low, high = _cyclic(self._numbers)
        acting = offset * float(self._faults.offset_scale)
        self.limited = not low <= position + acting <= high
        target = min(max(position + acting, low), high) - acting if self.limited else position
        self._spread(Target(target, acting, speed * self._rad_per_increment, torque * 1e-3 * self._rated_current_a))

    def _spread(self, target: Target) -> None:
        self.cyclic.push(self.interpolation.next(target, synced=self.synced))
        self.synced = False

    def _preset(self, target: Target) -> None:
        self.cyclic.preset(target)
        self.interpolation.preset(target)

    def _choose(self) -> Source:
        if not self._power.powered:
            return Source.OFF
        numbers = self._numbers
        if not self._power.follows or numbers[0x604000] & _HALT or self._faults.not_csp:
            return Source.STOP
        return _SOURCES.get(numbers[0x606000], Source.STOP)

    def _cyclic_command(self, actual: Actual) -> Command:
        mode = self._pushed_mode
        if mode == modes.CYCLIC_POSITION:
            return self.cyclic.command()
        self.loops = _LOOPS[mode]
        return self._open.cyclic(mode, actual, self.cyclic.command())

    def _own_command(self, source: Source, actual: Actual) -> Command:
        if source is Source.VELOCITY or source is Source.TORQUE:
            if self.source is not source:
                self._open.start(actual)
            self.loops = _LOOPS[self._numbers[0x606000]]
            return self._open.velocity(actual) if source is Source.VELOCITY else self._open.torque(actual)
        self._enter_profile(actual)
        if source is Source.HOMING:
            self._home(actual)
        else:
            self._run_profile(source, actual)
        return self._profile.command()

    def _enter_profile(self, actual: Actual) -> None:
        if self.source is Source.OFF:
            self._profile.start(actual.position, 0.0)
        elif self.source is Source.CYCLIC and self._loops_before is Loops.POSITION:
            # the demand in force, not that of the new cycle's set-point
            self._profile.start(self.command[1], self.command[3])
        elif self.source in (Source.CYCLIC, Source.VELOCITY, Source.TORQUE):
            # so far ahead that the position loop demands the actual speed
            ahead = (1 - self._feedforward) * actual.speed / self._gain
            self._profile.start(actual.position + ahead, actual.speed)

    def _run_profile(self, source: Source, actual: Actual) -> None:
        limits = self._limits
        target = self._target if source is Source.PROFILE else None
        if source is Source.STOP and self._power.ramp is not None:
            self._target = self._pending = None
        self._profile.advance(
            target, limits.speed_of(0x608100), limits.acceleration(0x608300), limits.deceleration(self._stop_ramp())
        )
        self._arrived.step(self._profile.now - actual.position if self._target is not None else 0.0)
        if not self._profile.at_rest:
            return
        if source is Source.PROFILE and self._pending is not None and self._profile.now == self._target:
            self._target, self._pending = self._pending, None
        if source is Source.STOP:
            self._power.at_rest()

    def _stop_ramp(self) -> int:
        """Return the key of the deceleration: 0x6085 for a quick stop or a halt with option code 2."""
        ramp = self._power.ramp
        halt = ramp is None and self._numbers[0x604000] & _HALT and self._numbers.get(0x605D00, 1) == 2
        index: int = (Ramp.QUICK_STOP if ramp is Ramp.QUICK_STOP or halt else Ramp.SLOW_DOWN).value
        return index << 8

    def _home(self, actual: Actual) -> None:
        run, limits = self.homing, self._limits
        raw = float(actual.position + self.shift)
        if self._homing_asked and run.state is not Homing.RUNNING:
            run.start(self._numbers.get(0x609800, 0), raw, actual.inputs)
        self._homing_asked = False
        run.step(raw, actual.inputs)
        leg = run.leg
        target = None if leg is None else leg.direction * _FAR
        speed = limits.speed_of(0x609901 if leg is None or leg.fast else 0x609902)
        self._profile.advance(target, speed, limits.acceleration(0x609A00), limits.deceleration(0x609A00))
        if leg is None and self._profile.at_rest and run.rested():
            self._set_zero(round(run.home) - self._numbers.get(0x607C00, 0))

    def _set_zero(self, shift: int) -> None:
        """Shift the zero: the axis stays in place and gets new coordinates."""
        self._profile.start(self._profile.now + self.shift - shift, 0.0)
        self._preset(Target(self._profile.now, 0.0, 0.0, 0.0))
        self.shift = shift
