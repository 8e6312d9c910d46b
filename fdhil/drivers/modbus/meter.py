"""A value in the registers of a Modbus unit: its newest, whenever it is asked."""

from __future__ import annotations

import math
from typing import Protocol

from fdhil.config.sensors import ModbusPlace, ValueType
from fdhil.drivers.modbus.link import ModbusLink
from fdhil.drivers.modbus.values import WordOrder, numbers, registers_of
from fdhil.errors import ProtocolError

SMALLEST = 1e-30  # a float below is one whose words or type are others
LIKELY = (1e-6, 1e6)  # what instruments show, in their own unit


class ValuePlace(Protocol):
    """Where a value is and what it means: the keys of :class:`fdhil.config.sensors.ModbusValue` and ``scale``."""

    @property
    def function(self) -> int: ...
    @property
    def address(self) -> int: ...
    @property
    def word_order(self) -> WordOrder: ...
    @property
    def scale(self) -> float: ...
    @property
    def offset(self) -> float: ...


class ModbusMeter:
    """One value of a unit, of type ``kind``, read with one request so that it is not torn."""

    tells_by_itself = False

    def __init__(self, name: str, place: ModbusPlace, where: ValuePlace, kind: ValueType) -> None:
        self.name = name
        self.link = ModbusLink(name, place)
        self._where, self._kind = where, kind
        self.asked_ns = self.answered_ns = 0
        self._registers: list[int] = []

    async def value(self) -> float:
        """Return the value, scaled; DeviceError of the link, ProtocolError for what is no number."""
        where = self._where
        registers = await self.link.read(where.function, where.address, registers_of(self._kind))
        self._registers = registers
        self.asked_ns, self.answered_ns = self.link.asked_ns, self.link.answered_ns
        raw = float(numbers(registers, self._kind, where.word_order)[0])
        if not math.isfinite(raw) or 0 < abs(raw) < SMALLEST:
            raise ProtocolError(self.name, self.doubt(f"{raw:g}"))
        return where.scale * raw + where.offset

    def doubt(self, shown: str) -> str:
        """Return what is to be told of a value that cannot be."""
        where = self._where
        text = f"register {where.address} gives {shown} as {self._kind}{self._otherwise()}"
        return f"{text}; compare address, function, type, word_order and scale with its register map"

    def _otherwise(self) -> str:
        """Return what the same registers would be with their words the other way round, where that is a number."""
        other: WordOrder = "little" if self._where.word_order == "big" else "big"
        if registers_of(self._kind) == 1 or not self._registers:
            return ""
        raw = float(numbers(self._registers, self._kind, other)[0])
        likely = math.isfinite(raw) and (raw == 0 or LIKELY[0] < abs(raw) < LIKELY[1])
        return (
            f" (with word_order = {other!r} it would be {self._where.scale * raw + self._where.offset:g})"
            if likely
            else ""
        )
