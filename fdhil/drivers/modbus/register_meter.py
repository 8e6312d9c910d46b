"""Reads one value, the newest, from the registers of a Modbus unit."""

import math

from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.drivers.modbus.register_values import (
    LIKELY,
    SMALLEST,
    RegisterSensor,
    count_registers,
    decode_numbers,
    describe_other_orders,
)
from fdhil.errors import ProtocolError


class RegisterMeter:
    """One value of a unit, read with one request so that it is not torn; valid values are below ``most``."""

    is_free_running = False

    def __init__(self, name: str, settings: RegisterSensor, most: float = LIKELY[1]) -> None:
        assert settings.type is not None
        self.name = name
        self.link = ModbusUnit(name, settings)
        self._where, self._kind, self._most = settings, settings.type, most
        self.asked_ns = self.answered_ns = 0
        self._registers: list[int] = []

    async def read_value(self) -> float:
        where = self._where
        registers = await self.link.read_registers(where.function, where.address, count_registers(self._kind))
        self._registers = registers
        self.asked_ns, self.answered_ns = self.link.asked_ns, self.link.answered_ns
        raw = float(decode_numbers(registers, self._kind, where.word_order, where.byte_order)[0])
        if not math.isfinite(raw) or 0 < abs(raw) < SMALLEST:
            raise ProtocolError(self.name, self.describe_implausible(f"{raw:g}"))
        return where.scale * raw + where.offset

    def describe_implausible(self, shown: str) -> str:
        where = self._where
        text = f"register {where.address} gives {shown} as {self._kind}"
        text += describe_other_orders(self._registers, self._kind, where, self._most)
        return f"{text}; compare address, function, type, word_order, byte_order and scale with its register map"
