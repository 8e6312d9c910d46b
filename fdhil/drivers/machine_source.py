"""Opens all buses, sensors and event sources of a configuration as one source of records.

At the start every bus and sensor must be reachable, else one ConnectError names all that are not. A silent bus is
reported and still received from: with the NC off, drives without a heartbeat are silent, and so may be the NC's own
interface. Later nothing ends the source: a lost bus or sensor is a notice and a gap, and is reconnected with growing
pauses. Nothing is queued here: data wait in the bus' ring and in the sensor, which count what they discard. An
exception inside a source leaves ``run`` unchanged.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.bus_source import BusSource
from fdhil.drivers.can.bus_listener import BusOpener, ListeningBus
from fdhil.drivers.can.frame_history import format_candump
from fdhil.drivers.nc.nc_listener import NcListener
from fdhil.drivers.sensor_source import Record, SensorSource, Take, create_sensors
from fdhil.errors import ConnectError, DeviceError
from fdhil.records import NcState, Notice

__all__ = ["MachineSource", "Record", "open_machine"]


class MachineSource:
    """All sources of a machine; ``run`` hands over their records, ``read_counters`` returns their counts."""

    def __init__(self, config: MachineConfig, open_bus: BusOpener = ListeningBus) -> None:
        used = dict.fromkeys(axis.drive.bus for axis in config.axis.values())
        self._buses = {name: BusSource(name, config, open_bus) for name in used}
        self._sensors = {
            axis if what == "voltage" else f"{axis}.{what}": SensorSource(sensor, self._buses[settings.drive.bus].ticks)
            for axis, settings in config.axis.items()
            for what, sensor in create_sensors(axis, config).items()
        }

        self._nc = NcListener(config) if config.g0.source in tables.NC_SOURCES else None

    async def open(self) -> None:
        """Connect every device; ConnectError with all that cannot be reached."""
        results = await asyncio.gather(
            *(asyncio.to_thread(bus.open) for bus in self._buses.values()),
            *(source.sensor.link.connect() for source in self._sensors.values()),
            return_exceptions=True,
        )
        faults = [result for result in results if isinstance(result, DeviceError)]
        for result in results:
            if isinstance(result, BaseException) and not isinstance(result, DeviceError):
                raise result
        if faults:
            raise ConnectError("machine", "; ".join(str(fault) for fault in faults)) if len(faults) > 1 else faults[0]

    async def run(self, take: Take) -> None:
        """Hand every record over for ever; an exception in one source ends all of them and is raised to the caller."""
        try:
            async with asyncio.TaskGroup() as sources:
                for bus in self._buses.values():
                    sources.create_task(bus.run(take))
                for sensor in self._sensors.values():
                    sources.create_task(sensor.run(take))
                if self._nc is not None:
                    sources.create_task(self._nc.run(lambda record: self._receive_nc_record(record, take)))
        except ExceptionGroup as group:
            raise group.exceptions[0] from group

    def _receive_nc_record(self, record: NcState | Notice, take: Take) -> None:
        take(record)
        if isinstance(record, NcState):
            for bus in self._buses.values():
                for event in bus.receive_nc_state(record):
                    take(event)

    def get_counters(self) -> dict[str, int]:
        """Return the frames received and lost in total, and per bus and sensor with its name in front."""
        buses = {name: bus.read_counters() for name, bus in self._buses.items()}
        flat = {"frames": sum(c["frames"] for c in buses.values()), "lost": sum(c["lost"] for c in buses.values())}
        for name, counted in buses.items():
            flat |= {f"{name}.{key}": value for key, value in counted.items()}
        for name, source in self._sensors.items():
            flat |= {f"{source.sensor.link.wire}.{name}.{key}": value for key, value in source.read_counters().items()}
        if self._nc is not None:
            flat |= {f"nc.{key}": value for key, value in self._nc.read_counters().items()}
        return flat

    def dump_recent_frames(self) -> dict[str, str]:
        """Return the frames of the last 10 s of each bus, as the lines of a candump log."""
        return {name: format_candump(name, bus.history.get_frames()) for name, bus in self._buses.items()}

    async def close(self) -> None:
        for sensor in self._sensors.values():
            sensor.close()
        await asyncio.gather(*(asyncio.to_thread(bus.close) for bus in self._buses.values()))


@asynccontextmanager
async def open_machine(config: MachineConfig, open_bus: BusOpener = ListeningBus) -> AsyncIterator[MachineSource]:
    """Open everything that the configuration names; ConnectError (exit code 3) when a device cannot be reached."""
    source = MachineSource(config, open_bus)
    try:
        await source.open()
        yield source
    finally:
        await source.close()
