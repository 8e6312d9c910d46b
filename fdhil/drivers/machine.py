"""The whole machine as one source of records: buses, sensors and event sources of a configuration.

At the start everything must be there, else one ConnectError names all that is not. Later nothing ends the source: a
bus or a sensor that goes away is a notice and a gap, and is tried again with growing pauses.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Protocol

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.can.bus import CanBus
from fdhil.drivers.can.frame_history import FrameHistory, candump
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.drivers.cia402.drive import InputSamples
from fdhil.drivers.modbus.link import BUSY, ModbusRefused
from fdhil.drivers.modbus.temperature import ModbusTemperature
from fdhil.drivers.modbus.voltage import ModbusVoltage
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import AxisSamples, MoveEvent, Notice, Temperature, TickTimes, VoltageSamples

Record = AxisSamples | VoltageSamples | TickTimes | MoveEvent | Temperature | Notice

DRAIN_S = 0.05
POLL_S = 0.05
SILENCE_S = 2.0
LISTEN_S = 2.0
BACK_OFF_S = (0.1, 5.0)
QUEUE_RECORDS = 4096


class EventSource(Protocol):
    """What a source of G0 events is: blocks in, events out."""

    def feed(self, record: AxisSamples | InputSamples) -> list[MoveEvent]:
        """Take a block; return the moves it shows."""


class Outlet:
    """The records on their way out; when nobody takes them the oldest go, and are counted."""

    def __init__(self) -> None:
        self._queue: asyncio.Queue[Record | BaseException] = asyncio.Queue(QUEUE_RECORDS)
        self.dropped = 0

    def put(self, record: Record | BaseException) -> None:
        if self._queue.full():
            self._queue.get_nowait()
            self.dropped += 1
        self._queue.put_nowait(record)

    def watch(self, task: asyncio.Task[None]) -> None:
        """Pass on the exception that ended a source."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self.put(error)

    async def get(self) -> Record:
        record = await self._queue.get()
        if isinstance(record, BaseException):
            raise record
        return record


class BusSource:
    """One bus: drains the ring, decodes, and opens it again when it ended."""

    def __init__(self, name: str, config: MachineConfig) -> None:
        self.name = name
        self._config = config
        self._bus: CanBus | None = None
        self.decoder = BusDecoder(name, config)
        self.ticks = TickClock(config.machine.sync_period_s)
        event_source: Callable[[str, MachineConfig], EventSource] = tables.load(tables.EVENT_SOURCES, config.g0.source)
        self._events = [event_source(axis, config) for axis in self.decoder.axes]
        self.history = FrameHistory()
        self._silent = False
        self._frames_before = 0
        self._overflow_told = 0

    def open(self) -> None:
        """Open the bus; ConnectError when it cannot be reached."""
        self._bus = CanBus(self.name, self._config.bus[self.name])

    @property
    def heard(self) -> bool:
        """Whether any frame was received."""
        return self._bus is not None and self._bus.counters()["frames"] > 0

    def step(self, now_ns: int) -> list[Record]:
        """Drain and decode once."""
        if self._bus is None:
            return []
        frames = self._bus.drain()
        self.history.add(frames)
        out: list[Record] = []
        for record in self.decoder.feed(frames, now_ns):
            if isinstance(record, TickTimes):
                self.ticks.add(record)
            if isinstance(record, AxisSamples | InputSamples):
                for source in self._events:
                    out += source.feed(record)
            if not isinstance(record, InputSamples):
                out.append(record)
        return [*out, *self._overflow(), *self._silence(now_ns)]

    def _overflow(self) -> list[Notice]:
        assert self._bus is not None
        lost = self._bus.counters()["lost"]
        if lost <= self._overflow_told:
            return []
        new, self._overflow_told = lost - self._overflow_told, lost
        text = f"{new} frames of bus {self.name} were not read in time; the computer is overloaded."
        return [Notice("RxOverflow", "minor", text)]

    def _silence(self, now_ns: int) -> list[Notice]:
        assert self._bus is not None
        silent = now_ns - self._bus.last_frame_ns > SILENCE_S * 1e9
        was, self._silent = self._silent, silent
        if silent and not was:
            text = f"Nothing is heard on bus {self.name}; check the drives' supply, the wiring and the bit rate."
            return [Notice("BusSilent", "MAJOR", text)]
        return [Notice("BusSilent", "info", f"Bus {self.name} is heard again.")] if was and not silent else []

    async def run(self, out: Outlet) -> None:
        """Run for ever; a bus that ended is opened again with growing pauses."""
        pause = BACK_OFF_S[0]
        while True:
            await asyncio.sleep(DRAIN_S)
            for record in self.step(time.monotonic_ns()):
                out.put(record)
            if self._bus is None or self._bus.ended is None:
                pause = BACK_OFF_S[0]
                continue
            reason = self._bus.ended
            out.put(Notice("BusDown", "MAJOR", f"Bus {self.name}: {reason}; it is tried again until it is back."))
            pause = await self._reopen(pause)
            out.put(Notice("BusDown", "info", f"Bus {self.name} is back."))

    async def _reopen(self, pause: float) -> float:
        """Wait until the bus can be opened; the SYNC count begins anew."""
        self._close_bus()
        while self._bus is None:
            await asyncio.sleep(pause)
            pause = min(2 * pause, BACK_OFF_S[1])
            try:
                await asyncio.to_thread(self.open)
            except ConnectError:
                continue
        self.decoder = BusDecoder(self.name, self._config)
        self._overflow_told = 0
        return pause

    def _close_bus(self) -> None:
        if self._bus is not None:
            counters = self._bus.counters()
            self._frames_before += counters["frames"]
            self._bus.close()
            self._bus = None

    def counters(self) -> dict[str, int]:
        """Frames received and lost on this bus."""
        own = self._bus.counters() if self._bus else {"frames": 0, "ring_overflow": 0, "kernel_drops": 0, "lost": 0}
        decoded = self.decoder.counters()
        own["frames"] += self._frames_before
        own["lost"] += decoded["pdo_lost"] + decoded["sync_missed"]
        return own | decoded

    def close(self) -> None:
        """Close the bus."""
        self._close_bus()


class SensorSource:
    """One Modbus sensor or thermometer: polled, and connected again when it went away."""

    def __init__(self, sensor: ModbusVoltage | ModbusTemperature, ticks: TickClock) -> None:
        self.sensor = sensor
        self._ticks = ticks
        self._failures = 0
        self._told: set[str] = set()

    async def run(self, out: Outlet) -> None:
        """Poll for ever; a fault is a notice once, its end another."""
        pause = BACK_OFF_S[0]
        while True:
            begun = time.monotonic()
            try:
                if not self.sensor.link.connected:
                    await self.sensor.link.connect()
                for record in await self.sensor.poll(self._ticks):
                    out.put(record)
            except DeviceError as error:
                self._fault(error, out)
                await asyncio.sleep(pause)
                pause = min(2 * pause, BACK_OFF_S[1])
                continue
            pause = BACK_OFF_S[0]
            for code in sorted(self._told):
                out.put(Notice(code, "info", f"The {self.sensor.name} answers again.", self.sensor.axis))
            self._told.clear()
            await asyncio.sleep(max(0.0, POLL_S - (time.monotonic() - begun)))

    def _fault(self, error: DeviceError, out: Outlet) -> None:
        self._failures += 1
        if isinstance(error, ModbusRefused) and error.code == BUSY:
            return
        code = "ModbusException" if isinstance(error, ModbusRefused) else "ModbusShape"
        if isinstance(error, DeviceTimeout):
            code = "ModbusTimeout"
        elif isinstance(error, ConnectError):
            code = "ModbusPortGone"
        elif not isinstance(error, ProtocolError):
            code = "ModbusShape"
        if code not in self._told:
            self._told.add(code)
            out.put(Notice(code, "MAJOR", str(error), self.sensor.axis))

    def counters(self) -> dict[str, int]:
        """Samples received and lost, and failed polls."""
        return {"samples": self.sensor.samples, "lost": self.sensor.lost, "failures": self._failures}

    def close(self) -> None:
        """End the connection."""
        self.sensor.link.close()


class MachineSource:
    """All sources of a machine; ``records`` yields what they say, ``counters`` what they counted."""

    def __init__(self, config: MachineConfig) -> None:
        used = dict.fromkeys(axis.drive.bus for axis in config.axis.values())
        self._buses = {name: BusSource(name, config) for name in used}
        self._sensors = {
            axis: SensorSource(
                tables.load(tables.VOLTAGE_SOURCES, settings.voltage.source)(axis, config),
                self._buses[settings.drive.bus].ticks,
            )
            for axis, settings in config.axis.items()
            if settings.voltage.source != "drive"  # the drive's own comes with its TPDOs
        }
        self._sensors |= {
            f"{axis}.temperature": SensorSource(
                ModbusTemperature(axis, settings.temperature), self._buses[settings.drive.bus].ticks
            )
            for axis, settings in config.axis.items()
            if settings.temperature is not None
        }
        self._out = Outlet()
        self._tasks: list[asyncio.Task[None]] = []

    async def open(self) -> None:
        """Reach every device; ConnectError with all that cannot be reached."""
        results = await asyncio.gather(
            *(asyncio.to_thread(bus.open) for bus in self._buses.values()),
            *(sensor.sensor.link.connect() for sensor in self._sensors.values()),
            return_exceptions=True,
        )
        faults = [result for result in results if isinstance(result, DeviceError)]
        for result in results:
            if isinstance(result, BaseException) and not isinstance(result, DeviceError):
                raise result
        faults += await self._listen() if not faults else []
        if faults:
            raise ConnectError("machine", "; ".join(str(fault) for fault in faults)) if len(faults) > 1 else faults[0]
        sources: list[BusSource | SensorSource] = [*self._buses.values(), *self._sensors.values()]
        for source in sources:
            task = asyncio.create_task(source.run(self._out))
            task.add_done_callback(self._out.watch)
            self._tasks.append(task)

    async def _listen(self) -> list[DeviceError]:
        """Give each bus two seconds to be heard: heartbeats come even while nothing moves."""
        for _ in range(round(LISTEN_S / DRAIN_S)):
            if all(bus.heard for bus in self._buses.values()):
                break
            await asyncio.sleep(DRAIN_S)
        return [
            ConnectError(f"bus {name}", "there is no drive on the bus; check the drives' supply, wiring and bit rate")
            for name, bus in self._buses.items()
            if not bus.heard
        ]

    async def records(self) -> AsyncIterator[Record]:
        """Yield records for ever; an exception in a source ends the iteration with it."""
        while True:
            yield await self._out.get()

    def counters(self) -> dict[str, int]:
        """Frames received and lost over all, and per bus and sensor with its name in front."""
        buses = {name: bus.counters() for name, bus in self._buses.items()}
        flat = {
            "frames": sum(c["frames"] for c in buses.values()),
            "lost": sum(c["lost"] for c in buses.values()),
            "records_dropped": self._out.dropped,
        }
        for name, counted in buses.items():
            flat |= {f"{name}.{key}": value for key, value in counted.items()}
        for axis, sensor in self._sensors.items():
            flat |= {f"modbus.{axis}.{key}": value for key, value in sensor.counters().items()}
        return flat

    def black_box(self) -> dict[str, str]:
        """Return the frames of the last 10 s of each bus, as the lines of a candump log."""
        return {name: candump(name, bus.history.frames()) for name, bus in self._buses.items()}

    async def close(self) -> None:
        """Stop all sources and release buses and sensors."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks = []
        for sensor in self._sensors.values():
            sensor.close()
        await asyncio.gather(*(asyncio.to_thread(bus.close) for bus in self._buses.values()))


@asynccontextmanager
async def open_machine(config: MachineConfig) -> AsyncIterator[MachineSource]:
    """Open all that the configuration names; ConnectError (exit code 3) when something is not there."""
    source = MachineSource(config)
    try:
        await source.open()
        yield source
    finally:
        await source.close()
