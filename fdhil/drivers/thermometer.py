"""Polls a slide-way's thermometer, behind Modbus or on a serial line."""

import asyncio

from fdhil.config import Thermometer
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.link import Link
from fdhil.drivers.meter import Meter
from fdhil.drivers.modbus.link import PLAUSIBLE_C
from fdhil.drivers.modbus.meter import ModbusMeter
from fdhil.drivers.serial.instrument import TextMeter
from fdhil.errors import ProtocolError
from fdhil.records import Temperature


class SlidewayThermometer:
    """The thermometer of one axis; ``samples`` counts readings, none can be ``lost``."""

    lost = 0

    def __init__(self, axis: str, settings: Thermometer) -> None:
        self.axis = axis
        self.name = f"thermometer {axis}"
        self.samples = 0
        self._period_s = settings.period_s
        self._meter: Meter
        if settings.source == "serial":
            self._meter = TextMeter(self.name, settings)
        else:
            self._meter = ModbusMeter(self.name, settings, PLAUSIBLE_C[1])

    @property
    def link(self) -> Link:
        return self._meter.link

    async def poll(self, ticks: TickClock) -> list[Temperature]:
        """Wait for the period and read once; ProtocolError for an impossible temperature, and errors of the link."""
        if not self._meter.tells_by_itself:
            await asyncio.sleep(self._period_s)
        celsius = await self._celsius()
        self.samples += 1
        return [Temperature(self.axis, ticks.newest_tick, celsius, "slideway")]

    async def reading(self) -> str:
        return f"{await self._celsius():.2f} degC"

    async def _celsius(self) -> float:
        celsius = await self._meter.value()
        if not PLAUSIBLE_C[0] < celsius < PLAUSIBLE_C[1]:  # also refuses NaN
            raise ProtocolError(self.name, self._meter.doubt(f"{celsius:g} degC"))
        return celsius
