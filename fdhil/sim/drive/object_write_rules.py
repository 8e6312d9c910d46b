"""Registers rules and actions for SDO writes to the drive's objects."""

from collections.abc import Callable

from fdhil.sim.drive.drive_objects import ERROR_HISTORY, INVALID
from fdhil.sim.drive.homing import METHODS
from fdhil.sim.drive.object_dictionary import AbortCode, Entry, ObjectDictionary, TransferAbort
from fdhil.sim.drive.operation_modes import MODES, SUPPORTED_MODES
from fdhil.sim.drive.power_stage import QUICK_STOP_CODES
from fdhil.sim.drive.trace_buffer import TraceBuffer

_SAVE, _LOAD = 0x65766173, 0x64616F6C  # "save" and "load", little-endian
_NOT_STORED = frozenset({0x1003, 0x1010, 0x1011, 0x6040, 0x6060, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x6071, 0x60FF})


class StoredParameters:
    """The non-volatile memory behind 0x1010 and 0x1011: power-on values that replace the defaults."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self._values: dict[Entry, int] = {}

    def restore_entries(self, which: Callable[[Entry], bool]) -> None:
        self._dictionary.reset_entries(which)
        self._dictionary.numbers.update({e.storage_key: v for e, v in self._values.items() if which(e)})
        for call in self._dictionary.restore_hooks:
            call()

    def save_entries(self) -> None:
        """Save all parameters, without set-points and controlword."""
        self._values = {
            entry: self._dictionary.numbers[entry.storage_key]
            for entry in self._dictionary.entries.values()
            if entry.access in ("rw", "rww", "rwr") and entry.size is not None and entry.index not in _NOT_STORED
        }

    def forget_entries(self) -> None:
        """Discard the saved values: the next boot uses the defaults."""
        self._values = {}


def register_write_rules(
    dictionary: ObjectDictionary,
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

    def accept(valid: Callable[[Entry, int], object], *, when_running: bool = True) -> Callable[[Entry, int], None]:
        def check(entry: Entry, value: int) -> None:
            if not when_running and not changeable():
                raise TransferAbort(AbortCode.DEVICE_STATE)
            if not valid(entry, value):
                raise TransferAbort(AbortCode.RANGE)

        return check

    def execute(signature: int, action: Callable[[], None]) -> Callable[[Entry, int], None]:
        def check(_entry: Entry, value: int) -> None:
            if value != signature:
                raise TransferAbort(AbortCode.NOT_STORED)
            if powered():  # writing to flash would stall the loops
                raise TransferAbort(AbortCode.DEVICE_STATE)
            action()

        return check

    def is_supported_mode(_entry: Entry, value: int) -> bool:
        supported = dictionary.numbers.get(0x650200) or SUPPORTED_MODES
        return not value or (value in MODES and bool(supported >> (value - 1) & 1))

    def is_whole_cycles(entry: Entry, value: int) -> bool:
        return entry.low is None or not isinstance(entry.default, int) or value % entry.default == 0

    dictionary.write_checks.update(
        {
            # the drive consumes SYNC and never produces it
            0x100500: accept(lambda _, value: 0 < value <= 0x7FF, when_running=False),
            0x101001: execute(_SAVE, stored.save_entries),
            0x101101: execute(_LOAD, stored.forget_entries),
            0x101400: accept(lambda _, value: not value & ~(INVALID | 0x7FF) and value & 0x7FF),
            0x101900: accept(lambda _, value: value != 1 and value <= 240, when_running=False),
            0x605A00: accept(lambda _, value: value in QUICK_STOP_CODES),
            0x606000: accept(is_supported_mode),
            0x609800: accept(lambda _, value: value in METHODS),
            0x60C201: accept(is_whole_cycles),
        }
    )
    dictionary.write_hooks.update(
        {
            0x100300: lambda _: dictionary.numbers.update({0x1003 << 8 | n: 0 for n in range(ERROR_HISTORY + 1)}),
            0x100500: lambda _: on_communication(),
            0x212100: lambda _: trace.clear_rows(),
            0x604000: lambda _: on_controlword(),
            0x606000: lambda _: on_controlword(),
        }
    )
    # reads return the capability: parameters are saved on command
    dictionary.read_hooks.update({0x101001: lambda: 1, 0x101101: lambda: 1, 0x212000: trace.read_rows})
