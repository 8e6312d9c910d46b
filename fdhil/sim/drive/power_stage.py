"""Implements the power state machine of CiA 402-2, with the option codes for every kind of stop."""

from collections.abc import Callable
from enum import Enum, IntEnum, auto


class PowerState(IntEnum):
    """The states; the value is the statusword's pattern in bits 0-3, 5 and 6."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class StopRamp(Enum):
    """The deceleration to standstill before a change of state."""

    SLOW_DOWN = 0x6084
    QUICK_STOP = 0x6085


class _PowerCommand(Enum):
    SHUTDOWN = auto()
    SWITCH_ON = auto()  # from Operation enabled: disable operation
    ENABLE = auto()
    DISABLE_VOLTAGE = auto()
    QUICK_STOP = auto()


_S, _C = PowerState, _PowerCommand
# transitions without a stop, numbers of CiA 402-2 figure 3: 2, 3, 7, 4, 6, 10, 9, 12
_PLAIN = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY,
    (_S.READY, _C.SWITCH_ON): _S.SWITCHED_ON,
    (_S.READY, _C.ENABLE): _S.SWITCHED_ON,
    (_S.READY, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.READY, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,
    (_S.SWITCHED_ON, _C.ENABLE): _S.OPERATION_ENABLED,
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY,
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,
}
_POWERED = frozenset({_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE, _S.FAULT_REACTION_ACTIVE})
QUICK_STOP_CODES = frozenset(
    {0, 1, 2, 5, 6}
)  # disable; slow-down or quick-stop ramp; the same, staying in Quick stop active


def _decode_controlword(word: int) -> _PowerCommand | None:
    if word & 0x80:
        return None
    if not word & 0x02:
        return _C.DISABLE_VOLTAGE
    if not word & 0x04:
        return _C.QUICK_STOP
    if not word & 0x01:
        return _C.SHUTDOWN
    return _C.ENABLE if word & 0x08 else _C.SWITCH_ON


class PowerStage:
    """The state, and the ramp on the way to the next one.

    ``option`` returns the value of an option code object (0x605A, 0x605B, 0x605C, 0x605E). ``powered``: current flows.
    ``ramp`` is set while the drive must decelerate; it calls :meth:`at_rest` when its demand is at rest.
    """

    def __init__(self, option: Callable[[int], int]) -> None:
        self._option = option
        self.state = PowerState.NOT_READY
        self.powered = False
        self.ramp: StopRamp | None = None
        self._after_ramp = PowerState.SWITCH_ON_DISABLED
        self._last_word: int | None = None
        self._stopped_by_word: int | None = None  # transition 16 needs a different word than the quick stop

    def enter_switch_on_disabled(self) -> None:
        """Make transitions 0 and 1: power-on and self-test."""
        self._enter_state(PowerState.SWITCH_ON_DISABLED)
        self._last_word = None

    @property
    def is_faulty(self) -> bool:
        return self.state in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)

    @property
    def follows_setpoints(self) -> bool:
        return self.state is PowerState.OPERATION_ENABLED and self.ramp is None

    def evaluate_controlword(self, word: int) -> bool:
        """Evaluate a controlword (level-triggered); return True when a fault was reset."""
        if word == self._last_word and word & 0x8F == 0x0F and self.follows_setpoints:
            return False  # the common case, every cycle
        rising_reset = word & 0x80 and (self._last_word is None or not self._last_word & 0x80)
        self._last_word = word
        if self.state is PowerState.FAULT:
            if rising_reset:
                self._enter_state(PowerState.SWITCH_ON_DISABLED)
                return True
            return False
        command = _decode_controlword(word)
        while command is not None and self._make_transition(command, word):
            pass
        return False

    def _make_transition(self, command: _PowerCommand, word: int) -> bool:
        """Make one transition; return False when the command requests none."""
        target = _PLAIN.get((self.state, command))
        if target is not None:
            self._enter_state(target)
            return True
        if self.state is PowerState.OPERATION_ENABLED:
            self._stop_operation(command, word)
        elif (
            self.state is PowerState.QUICK_STOP_ACTIVE
            and command is _C.ENABLE
            and self._option(0x605A) >= 5
            and word != self._stopped_by_word
        ):
            self._enter_state(PowerState.OPERATION_ENABLED)
        return False

    def _stop_operation(self, command: _PowerCommand, word: int) -> None:
        if command is _C.ENABLE:
            self.ramp = None  # cancel a stop in progress
        elif command is _C.QUICK_STOP:
            self.start_quick_stop(word)
        elif self.ramp is None:
            option, target = (0x605B, PowerState.READY) if command is _C.SHUTDOWN else (0x605C, PowerState.SWITCHED_ON)
            if self._option(option) == 0:
                self._enter_state(target)
            else:
                self.ramp, self._after_ramp = StopRamp.SLOW_DOWN, target

    def start_quick_stop(self, word: int | None = None) -> None:
        """Make transition 11, by controlword or by the abort connection option."""
        if self.state is not PowerState.OPERATION_ENABLED:
            return
        code = self._option(0x605A)
        if code == 0:
            self._enter_state(PowerState.SWITCH_ON_DISABLED)
            return
        self._enter_state(PowerState.QUICK_STOP_ACTIVE)
        self._stopped_by_word = self._last_word if word is None else word
        self.ramp = StopRamp.SLOW_DOWN if code in (1, 5) else StopRamp.QUICK_STOP
        self._after_ramp = PowerState.QUICK_STOP_ACTIVE if code >= 5 else PowerState.SWITCH_ON_DISABLED

    def disable_voltage(self) -> None:
        """Make transitions 7, 9, 10 and 12 without a controlword."""
        if not self.is_faulty and self.state is not PowerState.NOT_READY:
            self._enter_state(PowerState.SWITCH_ON_DISABLED)

    def enter_fault(self) -> None:
        """Make transitions 13 and 14: react by 0x605E, at once when no current flows."""
        if self.is_faulty:
            return
        code = self._option(0x605E)
        if not self.powered or code == 0:
            self._enter_state(PowerState.FAULT)
            return
        self._enter_state(PowerState.FAULT_REACTION_ACTIVE)
        self.ramp = StopRamp.SLOW_DOWN if code == 1 else StopRamp.QUICK_STOP
        self._after_ramp = PowerState.FAULT

    def finish_ramp(self) -> None:
        """Complete the ramp: the demand is at rest."""
        if self.ramp is None:
            return
        if self.state is PowerState.QUICK_STOP_ACTIVE and self._after_ramp is PowerState.QUICK_STOP_ACTIVE:
            return  # option codes 5 and 6 hold the position in Quick stop active
        self._enter_state(self._after_ramp)

    def _enter_state(self, state: PowerState) -> None:
        self.state = state
        self.ramp = None
        self.powered = state in _POWERED
