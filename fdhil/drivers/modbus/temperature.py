"""Reads a slide-way thermometer behind Modbus TCP now and then: one float32 in two input registers."""

from __future__ import annotations

import asyncio

from fdhil.config import Thermometer
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.modbus.link import PLAUSIBLE_C, ModbusLink
from fdhil.drivers.modbus.values import float32
from fdhil.errors import ProtocolError
from fdhil.records import Temperature


class ModbusTemperature:
    """The thermometer of one axis; ``link`` is its connection, ``samples`` counts readings, none can be ``lost``."""

    lost = 0

    def __init__(self, axis: str, settings: Thermometer) -> None:
        self.axis = axis
        self.name = f"thermometer {axis}"
        self.link = ModbusLink(self.name, settings)
        self.samples = 0
        self._address = settings.address
        self._period_s = settings.period_s

    async def poll(self, ticks: TickClock) -> list[Temperature]:
        """Rest for the period and read once; errors of the link pass through, ProtocolError for no temperature."""
        await asyncio.sleep(self._period_s)
        celsius = await self._celsius()
        self.samples += 1
        return [Temperature(self.axis, ticks.newest_tick, celsius, "slideway")]

    async def reading(self) -> str:
        """Read once, for people."""
        return f"{await self._celsius():.2f} degC"

    async def _celsius(self) -> float:
        celsius = float32(await self.link.read_input(self._address, 2))
        if not PLAUSIBLE_C[0] < celsius < PLAUSIBLE_C[1]:  # nor is it NaN
            text = f"register {self._address} gives {celsius:g} degC; compare the register map with the config"
            raise ProtocolError(self.name, text)
        return celsius
