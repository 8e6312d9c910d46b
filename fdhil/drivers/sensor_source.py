"""Polls a separate sensor, and reconnects it."""

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from fdhil import tables
from fdhil.cancellation import run_attempt
from fdhil.config import MachineConfig
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.drivers.sensor_connection import SensorConnection
from fdhil.drivers.table.accelerometer import StreamedAccelerometer
from fdhil.drivers.table.modbus_encoder import ModbusEncoder
from fdhil.drivers.thermometer import SlidewayThermometer
from fdhil.errors import DeviceError
from fdhil.records import AxisSamples, MoveEvent, NcState, Notice, TableSamples, Temperature, TickTimes, VoltageSamples

Record = AxisSamples | VoltageSamples | TableSamples | TickTimes | MoveEvent | Temperature | NcState | Notice
Take = Callable[[Record], None]
"""Takes a source's records without blocking."""

POLL_S = 0.05
BACK_OFF_S = (0.1, 5.0)


class Sensor(Protocol):
    """A sensor of one axis: every source of ``tables.VOLTAGE_SOURCES`` that is separate from the drive."""

    axis: str
    name: str
    samples: int
    lost: int

    @property
    def link(self) -> SensorConnection:
        """Its connection."""

    async def poll_samples(self, ticks: TickClock) -> Sequence[Record]:
        """Poll once and return new records; DeviceError."""

    async def format_reading(self) -> str:
        """Read without side effects on a running daemon, and return the formatted value; DeviceError."""


def create_sensors(axis: str, config: MachineConfig) -> dict[str, Sensor]:
    """Create the separate sensors of an axis, by what they measure."""
    settings, found = config.axis[axis], {}
    if settings.voltage.is_separate:
        found["voltage"] = tables.load_entry(tables.VOLTAGE_SOURCES, settings.voltage.source)(axis, config)
    if settings.temperature is not None:
        found["temperature"] = SlidewayThermometer(axis, settings.temperature)
    if settings.table is not None and settings.table.source == "modbus":
        found["table"] = ModbusEncoder(axis, settings.table)
    if settings.accelerometer is not None:
        found["acceleration"] = StreamedAccelerometer(axis, settings.accelerometer, config.machine.sync_period_s)
    return found


class SensorSource:
    """One sensor, polled for ever."""

    def __init__(self, sensor: Sensor, ticks: TickClock) -> None:
        self.sensor = sensor
        self._ticks = ticks
        self._failures = 0
        self._reported: set[str] = set()

    async def run(self, take: Take) -> None:
        """Poll for ever; a fault is one notice, its end another."""
        pause = BACK_OFF_S[0]
        while True:
            begun = time.monotonic()
            try:
                for record in await run_attempt(self.sensor.name, self._poll_sensor()):
                    take(record)
            except DeviceError as error:
                self._report_failure(error, take)
                await asyncio.sleep(pause)
                pause = min(2 * pause, BACK_OFF_S[1])
                continue
            pause = BACK_OFF_S[0]
            for code in sorted(self._reported):
                take(Notice(code, "info", f"The {self.sensor.name} answers again.", self.sensor.axis))
            self._reported.clear()
            await asyncio.sleep(max(0.0, POLL_S - (time.monotonic() - begun)))

    async def _poll_sensor(self) -> Sequence[Record]:
        if not self.sensor.link.is_connected:
            await self.sensor.link.connect()
        return await self.sensor.poll_samples(self._ticks)

    def _report_failure(self, error: DeviceError, take: Take) -> None:
        self._failures += 1
        code = self.sensor.link.classify_fault(error)
        if code is not None and code not in self._reported:
            self._reported.add(code)
            take(Notice(code, "MAJOR", str(error), self.sensor.axis))

    def read_counters(self) -> dict[str, int]:
        """Return samples received and lost, failed polls, and recovered faults of the line."""
        own = {"samples": self.sensor.samples, "lost": self.sensor.lost, "failures": self._failures}
        link = self.sensor.link
        return own | (dict(link.fault_counts) if isinstance(link, ModbusUnit) else {})

    def close(self) -> None:
        self.sensor.link.close()
