"""Chooses the set-point that the loops follow: modes of operation, ramps of the power state machine, the halt bit."""

from __future__ import annotations

import math
from enum import Enum, auto
from operator import itemgetter

from fdhil.sim.drive.dictionary import Dictionary
from fdhil.sim.drive.objects import CYCLIC_POSITION, PROFILE_POSITION, Ratings
from fdhil.sim.drive.physics import Command
from fdhil.sim.drive.power import PowerStage, Ramp
from fdhil.sim.drive.sensors import DriveFaults
from fdhil.sim.drive.setpoints import CyclicSetpoints, Profile, Target

_REST: Command = (0.0,) * 8
_NEW_SETPOINT, _AT_ONCE, _RELATIVE, _HALT = 0x10, 0x20, 0x40, 0x100
# target, position offset, velocity offset, torque offset, software limits
_cyclic = itemgetter(0x607A00, 0x60B000, 0x60B100, 0x60B200, 0x607D01, 0x607D02)
_TARGET_REACHED, _MODE_SPECIFIC = 1 << 10, 1 << 12


class Source(Enum):
    """Where the set-point comes from."""

    OFF = auto()
    CYCLIC = auto()
    PROFILE = auto()
    STOP = auto()


_SOURCES = {CYCLIC_POSITION: Source.CYCLIC, PROFILE_POSITION: Source.PROFILE}


class Motion:
    """Set-point of each cycle, in increments. ``limited``: the software position limit cut it."""

    def __init__(
        self, dictionary: Dictionary, power: PowerStage, ratings: Ratings, faults: DriveFaults, cyclic: CyclicSetpoints
    ) -> None:
        self._dictionary = dictionary
        self._power = power
        self._faults = faults
        self._rad_per_increment = 2 * math.pi / ratings.increments_per_rev
        self._rated_current_a = ratings.rated_current_a
        self.cyclic = cyclic
        self._profile = Profile(ratings.sync_period_s)
        self.source = Source.OFF
        self.command = _REST
        self.limited = False
        self.reset(0)

    def reset(self, position: int) -> None:
        """Power-on at ``position`` increments."""
        self._dictionary.numbers[0x607A << 8] = position
        self.cyclic.preset(Target(position, 0.0, 0.0, 0.0))
        self.source, self.command = Source.OFF, _REST
        self._target: float | None = None
        self._pending: float | None = None
        self._acknowledged = False
        self._position = float(position)
        self._last_word = 0

    @property
    def mode(self) -> int:
        """The mode in force, 0x6061."""
        if self._faults.not_csp:
            return PROFILE_POSITION
        return self._dictionary.numbers[0x606000]

    @property
    def status_bits(self) -> int:
        """Bits 10 and 12 of the statusword: in profile position target reached and acknowledge, in CSP following."""
        halted = self.source is Source.STOP and self._profile.at_rest
        if self.mode == CYCLIC_POSITION:
            if self.source is Source.CYCLIC:
                return _MODE_SPECIFIC
            return _TARGET_REACHED if halted and self._power.follows else 0
        if self.mode == PROFILE_POSITION:
            bits = _MODE_SPECIFIC if self._acknowledged else 0
            reached = self._pending is None and self._profile.at_rest and self._target in (None, self._profile.now)
            return bits | (_TARGET_REACHED if reached or halted else 0)
        return 0

    def control(self, word: int) -> None:
        """Evaluate the mode bits of a controlword: the handshake of profile position (CiA 402-2, 10.3)."""
        rising = word & _NEW_SETPOINT and not self._last_word & _NEW_SETPOINT
        self._last_word = word
        if self.mode != PROFILE_POSITION or not self._power.follows:
            self._acknowledged = False
            return
        if rising and not self._acknowledged:
            self._acknowledged = True
            self._take_target(word)
        elif not word & _NEW_SETPOINT and self._pending is None:
            self._acknowledged = False

    def _take_target(self, word: int) -> None:
        target = float(self._dictionary.number(0x607A))
        if word & _RELATIVE:
            target += self._base
        low, high = self._dictionary.number(0x607D, 1), self._dictionary.number(0x607D, 2)
        target = float(min(max(target, low), high))
        if word & _AT_ONCE or self._target is None or (self._profile.at_rest and self._profile.now == self._target):
            self._target, self._pending = target, None
        else:
            self._pending = target

    @property
    def _base(self) -> float:
        """The place from which a relative target counts: the target before it, else where the axis stands."""
        if self._target is not None:
            return self._target
        return self._profile.now if self.source in (Source.PROFILE, Source.STOP) else self._position

    def at_sync(self, position: float) -> Command:
        """A SYNC came: take the latched set-points and return the command of the cycle that begins.

        ``position`` is the actual position in increments.
        """
        self._push()
        source = self._choose()
        self._position = position
        if source is Source.CYCLIC or source is Source.OFF:
            self._target = self._pending = None
            self.command = self.cyclic.command() if source is Source.CYCLIC else _REST
        else:
            self._own_motion(source, position)
        self.source = source
        return self.command

    @property
    def demand(self) -> float:
        """The position demand at the SYNC, increments."""
        if self.source is Source.OFF or self.source is Source.CYCLIC:
            now = self.cyclic.now
            return now.position + now.offset
        return self.command[0]

    def _push(self) -> None:
        values = self._dictionary.numbers
        position, offset, speed, torque, low, high = _cyclic(values)
        acting = offset * float(self._faults.offset_scale)
        self.limited = not low <= position + acting <= high
        target = min(max(position + acting, low), high) - acting if self.limited else position
        self.cyclic.push(Target(target, acting, speed * self._rad_per_increment, torque * 1e-3 * self._rated_current_a))

    def _choose(self) -> Source:
        if not self._power.powered:
            return Source.OFF
        numbers = self._dictionary.numbers
        if not self._power.follows or numbers[0x604000] & _HALT or self._faults.not_csp:
            return Source.STOP
        return _SOURCES.get(numbers[0x606000], Source.STOP)

    def _own_motion(self, source: Source, position: float) -> None:
        if self.source is Source.OFF:
            self._profile.start(position, 0.0)
        elif self.source is Source.CYCLIC:
            # the demand that was in force, not where the new cycle's set-point would take it
            self._profile.start(self.command[1], self.command[3])
        number = self._dictionary.number
        ramp = self._power.ramp
        deceleration = number(Ramp.QUICK_STOP.value if ramp is Ramp.QUICK_STOP else Ramp.SLOW_DOWN.value)
        target = self._target if source is Source.PROFILE else None
        if source is Source.STOP and ramp is not None:
            self._target = self._pending = None
        self._profile.advance(target, number(0x6081), number(0x6083), deceleration)
        self.command = self._profile.command()
        if not self._profile.at_rest:
            return
        if source is Source.PROFILE and self._pending is not None and self._profile.now == self._target:
            self._target, self._pending = self._pending, None
        if source is Source.STOP:
            self._power.at_rest()
