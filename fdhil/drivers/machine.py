"""Opens the whole machine as one source of records: buses, sensors and event sources of a configuration.

At the start every bus and sensor must be there, else one ConnectError names all that are not. A bus on which nothing
is heard is told, and listened to all the same: with the NC off, drives that send no heartbeat are silent, and so is an
interface of the NC's own. Later nothing
ends the source: a bus or a sensor that goes away is a notice and a gap, and is tried again with growing pauses. Nothing
is queued here: what came waits in the bus' ring and in the sensor, both of which count what they had no room for, and a
fault of a source's own leaves ``run`` as the exception that it is.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.bus_source import BusSource
from fdhil.drivers.can.bus import CanBus, OpenBus
from fdhil.drivers.can.frame_history import candump
from fdhil.drivers.nc.listener import NcListener
from fdhil.drivers.sensor_source import Record, SensorSource, Take, sensors_of
from fdhil.errors import ConnectError, DeviceError
from fdhil.records import NcState, Notice

__all__ = ["MachineSource", "Record", "open_machine"]


class MachineSource:
    """All sources of a machine; ``run`` hands over what they say, ``counters`` tells what they counted."""

    def __init__(self, config: MachineConfig, open_bus: OpenBus = CanBus) -> None:
        used = dict.fromkeys(axis.drive.bus for axis in config.axis.values())
        self._buses = {name: BusSource(name, config, open_bus) for name in used}
        self._sensors = {
            axis if what == "voltage" else f"{axis}.{what}": SensorSource(sensor, self._buses[settings.drive.bus].ticks)
            for axis, settings in config.axis.items()
            for what, sensor in sensors_of(axis, config).items()
        }

        self._nc = NcListener(config) if config.g0.source in tables.NC_SOURCES else None

    async def open(self) -> None:
        """Reach every device; ConnectError with all that cannot be reached."""
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
        """Hand every record over for ever; an exception in one source ends all of them, and goes on to the caller."""
        try:
            async with asyncio.TaskGroup() as sources:
                for bus in self._buses.values():
                    sources.create_task(bus.run(take))
                for sensor in self._sensors.values():
                    sources.create_task(sensor.run(take))
                if self._nc is not None:
                    sources.create_task(self._nc.run(lambda told: self._hear_nc(told, take)))
        except ExceptionGroup as group:
            raise group.exceptions[0] from group

    def _hear_nc(self, told: NcState | Notice, take: Take) -> None:
        """Hand over what the NC says, then the moves that are known by it."""
        take(told)
        if isinstance(told, NcState):
            for bus in self._buses.values():
                for event in bus.hear_nc(told):
                    take(event)

    def counters(self) -> dict[str, int]:
        """Frames received and lost over all, and per bus and sensor with its name in front."""
        buses = {name: bus.counters() for name, bus in self._buses.items()}
        flat = {"frames": sum(c["frames"] for c in buses.values()), "lost": sum(c["lost"] for c in buses.values())}
        for name, counted in buses.items():
            flat |= {f"{name}.{key}": value for key, value in counted.items()}
        for name, source in self._sensors.items():
            flat |= {f"{source.sensor.link.wire}.{name}.{key}": value for key, value in source.counters().items()}
        if self._nc is not None:
            flat |= {f"nc.{key}": value for key, value in self._nc.counters().items()}
        return flat

    def black_box(self) -> dict[str, str]:
        """Return the frames of the last 10 s of each bus, as the lines of a candump log."""
        return {name: candump(name, bus.history.frames()) for name, bus in self._buses.items()}

    async def close(self) -> None:
        """Release buses and sensors."""
        for sensor in self._sensors.values():
            sensor.close()
        await asyncio.gather(*(asyncio.to_thread(bus.close) for bus in self._buses.values()))


@asynccontextmanager
async def open_machine(config: MachineConfig, open_bus: OpenBus = CanBus) -> AsyncIterator[MachineSource]:
    """Open all that the configuration names; ConnectError (exit code 3) when something is not there."""
    source = MachineSource(config, open_bus)
    try:
        await source.open()
        yield source
    finally:
        await source.close()
