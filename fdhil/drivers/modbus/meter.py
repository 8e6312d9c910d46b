"""Reads one value, the newest, from the registers of a Modbus unit."""

import math

from fdhil.drivers.modbus.link import ModbusLink
from fdhil.drivers.modbus.values import LIKELY, SMALLEST, RegisterSensor, numbers, other_orders, registers_of
from fdhil.errors import ProtocolError


class ModbusMeter:
    """One value of a unit, read with one request so that it is not torn; valid values are below ``most``."""

    tells_by_itself = False

    def __init__(self, name: str, settings: RegisterSensor, most: float = LIKELY[1]) -> None:
        assert settings.type is not None
        self.name = name
        self.link = ModbusLink(name, settings)
        self._where, self._kind, self._most = settings, settings.type, most
        self.asked_ns = self.answered_ns = 0
        self._registers: list[int] = []

    async def value(self) -> float:
        where = self._where
        registers = await self.link.read(where.function, where.address, registers_of(self._kind))
        self._registers = registers
        self.asked_ns, self.answered_ns = self.link.asked_ns, self.link.answered_ns
        raw = float(numbers(registers, self._kind, where.word_order, where.byte_order)[0])
        if not math.isfinite(raw) or 0 < abs(raw) < SMALLEST:
            raise ProtocolError(self.name, self.doubt(f"{raw:g}"))
        return where.scale * raw + where.offset

    def doubt(self, shown: str) -> str:
        where = self._where
        text = f"register {where.address} gives {shown} as {self._kind}"
        text += other_orders(self._registers, self._kind, where, self._most)
        return f"{text}; compare address, function, type, word_order, byte_order and scale with its register map"
