"""Polls a slide-way's thermometer, behind Modbus or on a serial line."""

import asyncio

from fdhil.config import Thermometer
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.meter_voltage import Meter
from fdhil.drivers.modbus.modbus_unit import PLAUSIBLE_C
from fdhil.drivers.modbus.register_meter import RegisterMeter
from fdhil.drivers.sensor_connection import SensorConnection
from fdhil.drivers.serial.text_instrument import TextMeter
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
            self._meter = RegisterMeter(self.name, settings, PLAUSIBLE_C[1])

    @property
    def link(self) -> SensorConnection:
        return self._meter.link

    async def poll_samples(self, ticks: TickClock) -> list[Temperature]:
        """Wait for the period and read once; ProtocolError for an impossible temperature, and errors of the link."""
        if not self._meter.is_free_running:
            await asyncio.sleep(self._period_s)
        celsius = await self._read_celsius()
        self.samples += 1
        return [Temperature(self.axis, ticks.newest_tick, celsius, "slideway")]

    async def format_reading(self) -> str:
        return f"{await self._read_celsius():.2f} degC"

    async def _read_celsius(self) -> float:
        celsius = await self._meter.read_value()
        if not PLAUSIBLE_C[0] < celsius < PLAUSIBLE_C[1]:  # also refuses NaN
            raise ProtocolError(self.name, self._meter.describe_implausible(f"{celsius:g} degC"))
        return celsius
