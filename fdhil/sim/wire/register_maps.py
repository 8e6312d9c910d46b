"""Builds the register contents of the simulated sensors: words by address, for any server.

Written from the configuration keys as a device maker would: numbers are packed here with ``struct``.
"""

import math
import struct
from collections.abc import Callable
from typing import Protocol

from fdhil.config import TableEncoder, Thermometer, Voltage, VoltageBlock

_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f", "float64": ">d"}


class SampleMemory(Protocol):
    """The sample memory of a sensor."""

    celsius: float

    def read_newest(self, number: int) -> tuple[int, list[float]]:
        """Return the number of samples so far, and up to ``number`` of the newest (V), the oldest first."""


class RegisterMap(Protocol):
    """A device's registers, the same as input and holding registers. Only ``trigger`` may be written, with 1."""

    trigger: int | None

    def list_words(self) -> dict[int, int]:
        """Return the present content of all registers, by address."""

    def latch_samples(self) -> None:
        """Latch the samples: the trigger was written."""


def pack_registers(value: float, kind: str, word_order: str, byte_order: str = "big") -> list[int]:
    """Return a number as registers; an integer saturates at the ends of its type, as in a converter."""
    if not kind.startswith("float"):
        bits = 8 * struct.calcsize(_FORMATS[kind])
        low, high = (0, 2**bits - 1) if kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        value = min(max(round(value), low), high) if math.isfinite(value) else high
    data = struct.pack(_FORMATS[kind], value)
    words = list(struct.unpack(f"{'>' if byte_order == 'big' else '<'}{len(data) // 2}H", data))
    return words if word_order == "big" else words[::-1]


def _place_words(address: int, words: list[int]) -> dict[int, int]:
    return {address + n: word for n, word in enumerate(words)}


class SingleValueMap:
    """A meter or a thermometer: one number, its newest."""

    trigger: int | None = None

    def __init__(self, settings: Voltage | Thermometer | TableEncoder, kind: str, read: Callable[[], float]) -> None:
        self._settings, self._kind, self._read = settings, kind, read

    def list_words(self) -> dict[int, int]:
        settings = self._settings
        raw = (self._read() - settings.offset) / settings.scale
        return _place_words(settings.address, pack_registers(raw, self._kind, settings.word_order, settings.byte_order))

    def latch_samples(self) -> None:
        """Do nothing: there are no samples to latch."""


class SampleBlockMap:
    """A device that keeps its newest samples with a counter, at the registers of ``[axis.X.voltage.block]``."""

    def __init__(self, settings: Voltage, block: VoltageBlock, kind: str, samples: SampleMemory) -> None:
        self.trigger = block.trigger_address
        self._settings, self._block, self._kind, self._samples = settings, block, kind, samples
        self._latched: dict[int, int] | None = None

    def list_words(self) -> dict[int, int]:
        """Return the registers of samples, counter and number of samples."""
        if self.trigger is None:
            return self._build_words()
        if self._latched is None:
            self.latch_samples()
        return {**(self._latched or {}), self.trigger: 0}

    def latch_samples(self) -> None:
        self._latched = self._build_words()

    def _build_words(self) -> dict[int, int]:
        settings, block = self._settings, self._block
        count, volts = self._samples.read_newest(block.samples)
        ordered = volts[::-1] if block.newest_first else volts
        raw = [(v - settings.offset) / settings.scale for v in ordered]
        numbers = [
            word for v in raw for word in pack_registers(v, self._kind, settings.word_order, settings.byte_order)
        ]
        size = block.samples * struct.calcsize(_FORMATS[self._kind]) // 2
        words = _place_words(settings.address, numbers + [0] * (size - len(numbers)))
        number = (count - 1 if block.counter_of == "newest" else count - len(volts)) % (1 << 32)
        number %= 1 << 8 * struct.calcsize(_FORMATS[block.counter_type])
        counter = pack_registers(number, block.counter_type, settings.word_order, settings.byte_order)
        words |= _place_words(block.counter_address, counter)
        if block.count_address is not None:
            words[block.count_address] = len(volts)
        return dict.fromkeys(range(min(words), max(words)), 0) | words  # gaps read as 0: one request reads all


class CombinedMap:
    """Several maps in one unit; a later map overrides the registers of an earlier one."""

    def __init__(self, *maps: RegisterMap) -> None:
        self._maps = maps
        self.trigger = next((one.trigger for one in maps if one.trigger is not None), None)

    def list_words(self) -> dict[int, int]:
        return {address: word for one in self._maps for address, word in one.list_words().items()}

    def latch_samples(self) -> None:
        for one in self._maps:
            one.latch_samples()


def create_voltage_map(settings: Voltage, own: RegisterMap, samples: SampleMemory) -> RegisterMap:
    """Return the registers of a voltage sensor with these settings; ``own`` are those of fdhil's own sensor."""
    if settings.source != "modbus" or settings.type is None:
        return own
    if settings.block is not None:
        return SampleBlockMap(settings, settings.block, settings.type, samples)
    return SingleValueMap(settings, settings.type, lambda: (samples.read_newest(1)[1] or [0.0])[0])


def create_thermometer_map(settings: Thermometer, samples: SampleMemory) -> RegisterMap:
    return SingleValueMap(settings, settings.type, lambda: samples.celsius)
