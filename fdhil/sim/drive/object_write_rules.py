"""Registers rules and actions for SDO writes to the drive's objects."""

from collections.abc import Callable

from fdhil.sim.drive.dictionary import AbortCode, Dictionary, Entry, TransferAbort
from fdhil.sim.drive.homing import METHODS
from fdhil.sim.drive.modes import MODES, SUPPORTED_MODES
from fdhil.sim.drive.objects import ERROR_HISTORY, INVALID
from fdhil.sim.drive.power import QUICK_STOP_CODES
from fdhil.sim.drive.trace import TraceBuffer

_SAVE, _LOAD = 0x65766173, 0x64616F6C  # "save" and "load", little-endian
_NOT_STORED = frozenset({0x1003, 0x1010, 0x1011, 0x6040, 0x6060, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x6071, 0x60FF})


class StoredParameters:
    """The non-volatile memory behind 0x1010 and 0x1011: power-on values that replace the defaults."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._values: dict[Entry, int] = {}

    def restore(self, which: Callable[[Entry], bool]) -> None:
        self._dictionary.reset(which)
        self._dictionary.numbers.update({e.place: v for e, v in self._values.items() if which(e)})
        for call in self._dictionary.restored:
            call()

    def save(self) -> None:
        """Save all parameters, without set-points and controlword."""
        self._values = {
            entry: self._dictionary.numbers[entry.place]
            for entry in self._dictionary.entries.values()
            if entry.access in ("rw", "rww", "rwr") and entry.size is not None and entry.index not in _NOT_STORED
        }

    def forget(self) -> None:
        """Discard the saved values: the next boot uses the defaults."""
        self._values = {}


def register_write_rules(
    dictionary: Dictionary,
    *,
    changeable: Callable[[], bool],
    powered: Callable[[], bool],
    stored: StoredParameters,
    trace: TraceBuffer,
    on_controlword: Callable[[], None],
    on_communication: Callable[[], None],
) -> None:
    """Attach the rules.

    ``changeable`` returns whether the drive is pre-operational, ``powered`` whether current flows; ``on_controlword``
    and ``on_communication`` are called after a write to 0x6040 or 0x6060 and to 0x1005.
    """

    def at_rest(_entry: Entry, _value: int) -> None:
        if not changeable():
            raise TransferAbort(AbortCode.DEVICE_STATE)

    def sync_id(entry: Entry, value: int) -> None:
        at_rest(entry, value)
        if value & ~0x7FF or value == 0:  # the drive consumes SYNC and never produces it
            raise TransferAbort(AbortCode.RANGE)

    def counter_overflow(entry: Entry, value: int) -> None:
        at_rest(entry, value)
        if value == 1 or value > 240:
            raise TransferAbort(AbortCode.RANGE)

    def emergency_id(_entry: Entry, value: int) -> None:
        if value & ~(INVALID | 0x7FF) or value & 0x7FF == 0:
            raise TransferAbort(AbortCode.RANGE)

    def without_power() -> None:
        if powered():  # writing to flash would stall the loops
            raise TransferAbort(AbortCode.DEVICE_STATE)

    def save() -> None:
        without_power()
        stored.save()

    def load() -> None:
        without_power()
        stored.forget()

    def mode(_entry: Entry, value: int) -> None:
        offered = dictionary.numbers.get(0x650200) or SUPPORTED_MODES
        if value and (value not in MODES or not offered >> (value - 1) & 1):
            raise TransferAbort(AbortCode.RANGE)

    def interpolation_time(entry: Entry, value: int) -> None:
        cycle = entry.default
        if entry.low is not None and isinstance(cycle, int) and value % cycle:  # must be whole drive cycles
            raise TransferAbort(AbortCode.RANGE)

    def homing_method(_entry: Entry, value: int) -> None:
        if value not in METHODS:
            raise TransferAbort(AbortCode.RANGE)

    def quick_stop(_entry: Entry, value: int) -> None:
        if value not in QUICK_STOP_CODES:
            raise TransferAbort(AbortCode.RANGE)

    dictionary.check.update(
        {
            0x100500: sync_id,
            0x101001: _signature(_SAVE, save),
            0x101101: _signature(_LOAD, load),
            0x101400: emergency_id,
            0x101900: counter_overflow,
            0x605A00: quick_stop,
            0x606000: mode,
            0x609800: homing_method,
            0x60C201: interpolation_time,
        }
    )
    dictionary.written.update(
        {
            0x100300: lambda _: _clear_history(dictionary),
            0x100500: lambda _: on_communication(),
            0x212100: lambda _: trace.clear(),
            0x604000: lambda _: on_controlword(),
            0x606000: lambda _: on_controlword(),
        }
    )
    # reads return the capability: parameters are saved on command
    dictionary.read_hooks.update({0x101001: lambda: 1, 0x101101: lambda: 1, 0x212000: trace.content})


def _signature(wanted: int, action: Callable[[], None]) -> Callable[[Entry, int], None]:
    def check(_entry: Entry, value: int) -> None:
        if value != wanted:
            raise TransferAbort(AbortCode.NOT_STORED)
        action()

    return check


def _clear_history(dictionary: Dictionary) -> None:
    for n in range(ERROR_HISTORY + 1):
        dictionary.numbers[0x1003 << 8 | n] = 0
