"""Serves the separate voltage sensor of an axis by Modbus TCP, with a small sample memory that can be latched.

Its own registers, 16 bit, 32 bit values in two with the high word first, the same as input (fc 4) and holding ones (3):

    0-1     newest voltage, float32             10      trigger: 1 latches the newest samples, at most 100, that were
    2-3     counter of the newest sample                not latched before (fc 6, 16)
    4-5     sample rate in Hz, float32          11      0 idle, 1 latched, 2 latched and samples were lost
    6-7     volts per count of the block        12-13   counter of the block's first sample
    8-9     slide-way temperature in degC       14      number of samples in the block; 15 is 0
                                                16-115  samples, int16

Sample c is the mean over [c Ts, (c + 1) Ts) of the sensor's own time, which is the simulated one. Any unit identifier
is answered, as TCP sensors do. The servers run in a thread of their own.
"""

from __future__ import annotations

import asyncio
import logging
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from fdhil.errors import ConnectError
from fdhil.sim.wire.registers import RegisterMap
from fdhil.sim.wire.sensor_faults import SensorFaults

REGISTERS = 116
BLOCK = 100
TRIGGER, STATUS, FIRST_SAMPLE = 10, 11, 16
_READS, _WRITES = (3, 4), (6, 16)
_UNIT_BYTE = 6  # of a Modbus TCP packet
_NOISE_BLOCK = 1024


class VoltageSensor:
    """Registers and sample memory of one sensor; :meth:`feed` and the reading thread may run at the same time."""

    def __init__(
        self, rate_hz: float, limit_v: float, noise_v: float, rng: np.random.Generator, cycles: int = 1
    ) -> None:
        """Make a sensor of which a sample is the mean over ``cycles`` means that it is fed."""
        self.faults = SensorFaults()
        self._cycles, self._sum_v, self._summed = cycles, 0.0, 0
        self.celsius = 20.0
        self.rate_hz = rate_hz
        self.volts_per_count = max(0.01, round(1.05 * limit_v / 32767, 4))
        self._noise_v, self._rng = noise_v, rng
        self._noise: list[float] = []
        self._lock = threading.Lock()
        self._recent: deque[float] = deque(maxlen=BLOCK)
        self._count = 0  # samples so far
        self._latched = 0  # samples that were latched or lost
        self._block = [0] * (REGISTERS - STATUS)

    def feed(self, mean_v: float) -> None:
        """Take the mean terminal voltage of one cycle; the last of a sample's cycles makes the sample."""
        self._sum_v, self._summed = self._sum_v + mean_v, self._summed + 1
        if self._summed < self._cycles:
            return
        mean_v, self._sum_v, self._summed = self._sum_v / self._cycles, 0.0, 0
        if not self._noise:
            self._noise = (self._rng.standard_normal(_NOISE_BLOCK) * self._noise_v).tolist()
        value = self.faults.signal.apply(mean_v + self._noise.pop(), self._rng)
        with self._lock:
            self._recent.append(value)
            self._count += 1

    def latch(self) -> None:
        """Put the newest samples that were not latched before into the block, at most 100."""
        with self._lock:
            fresh = self._count - self._latched
            number = min(fresh, len(self._recent))
            samples = list(self._recent)[len(self._recent) - number :]
            self._latched = self._count
            first = self._count - number
        counts = [max(-32768, min(32767, round(v / self.volts_per_count))) & 0xFFFF for v in samples]
        status = 2 if fresh > number else 1
        header = [status, *_words(struct.pack(">I", first & 0xFFFFFFFF)), number, 0]
        self._block = header + counts + [0] * (BLOCK - number)

    def registers(self) -> list[int]:
        """Return all registers as they read now."""
        with self._lock:
            newest, count = (self._recent[-1] if self._recent else 0.0), max(self._count - 1, 0)
        head = struct.pack(">fIfff", newest, count & 0xFFFFFFFF, self.rate_hz, self.volts_per_count, self.celsius)
        return [*_words(head), 0, *self._block]

    trigger: int | None = TRIGGER

    def words(self) -> dict[int, int]:
        """Return all registers by address."""
        return dict(enumerate(self.registers()))

    def newest(self, number: int) -> tuple[int, list[float]]:
        """Return how many samples there were so far, and at most ``number`` of the newest, the oldest first."""
        with self._lock:
            return self._count, list(self._recent)[-number:]


def _words(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data))


class _TcpUnit:
    """A register map as a device of pymodbus."""

    def __init__(self, registers: RegisterMap, faults: SensorFaults) -> None:
        self._registers, self._faults = registers, faults

    async def access(
        self,
        function_code: int,
        start_address: int,
        address: int,
        count: int,
        current: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Serve one request: pymodbus calls it before it reads ``current`` or writes ``values`` into it."""
        if self._faults.slow_s:
            await asyncio.sleep(self._faults.slow_s)
        if self._faults.exception:
            return ExcCodes(self._faults.exception)
        if not values and function_code in _WRITES:
            return None  # a write is read back for its answer
        if function_code not in (_WRITES if values else _READS):
            return ExcCodes.ILLEGAL_FUNCTION
        if values:
            if list(values) != [1]:
                return ExcCodes.ILLEGAL_VALUE
            self._registers.latch()
        for place, word in self._registers.words().items():
            if 0 <= place - start_address < len(current):
                current[place - start_address] = word
        return None

    def device(self, unit: int) -> SimDevice:
        """Return the device for pymodbus: only the trigger may be written, other addresses do not exist."""
        parts, trigger = [], self._registers.trigger
        for first, count in _stretches(sorted(self._registers.words()), trigger):
            own = first == trigger
            parts.append(SimData(first, values=[0] * count, datatype=DataType.REGISTERS, readonly=not own))
        return SimDevice(id=unit, simdata=parts, action=self.access)


def _stretches(addresses: list[int], alone: int | None) -> list[tuple[int, int]]:
    """Return begin and length of each run of addresses; ``alone`` is one of its own."""
    runs: list[tuple[int, int]] = []
    for at in addresses:
        begin, length = runs[-1] if runs else (at, 0)
        if runs and at == begin + length and alone not in (at, at - 1):
            runs[-1] = begin, length + 1
        else:
            runs.append((at, 1))
    return runs


class SensorServers:
    """The Modbus TCP servers of a machine, in one thread; ``ports`` by axis once :meth:`start` has returned."""

    def __init__(
        self,
        sensors: Mapping[str, VoltageSensor],
        addresses: Mapping[str, tuple[str, int]],
        maps: Mapping[str, RegisterMap] | None = None,
        units: Mapping[str, int] | None = None,
    ) -> None:
        """Serve the sensors that have an address, each with the registers of ``maps`` in place of its own.

        Those with one address are behind a gateway: each answers to its own number of ``units`` only.
        """
        self._sensors, self._addresses, self._units = sensors, addresses, units or {}
        self._maps: Mapping[str, RegisterMap] = sensors if maps is None else maps
        self._servers: list[ModbusTcpServer] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="sim-modbus", daemon=True)
        self.ports: dict[str, int] = {}

    def start(self) -> None:
        """Open every port; ConnectError when one cannot be had."""
        # pymodbus logs every exception that it answers as an error with a dump of frames
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._open(), self._loop).result()
        except ConnectError:
            self.stop()
            raise

    def stop(self) -> None:
        """Close every port and end the thread."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()

    async def _open(self) -> None:
        for axes in self._gateways():
            port = await self._serve(axes)
            self.ports |= dict.fromkeys(axes, port)

    def _gateways(self) -> list[list[str]]:
        """Return the axes by the server that they share; a port that is yet to be chosen is nobody else's."""
        shared: dict[tuple[str, int | str], list[str]] = {}
        for axis, (host, port) in self._addresses.items():
            shared.setdefault((host, port or axis), []).append(axis)
        return list(shared.values())

    async def _serve(self, axes: list[str]) -> int:
        """Serve the units of one address and return its port; ConnectError."""
        host, port = self._addresses[axes[0]]
        faults = {self._units.get(axis, 0) if len(axes) > 1 else 0: self._sensors[axis].faults for axis in axes}
        parts = zip(axes, faults.items(), strict=True)
        devices = [_TcpUnit(self._maps[axis], one).device(unit) for axis, (unit, one) in parts]
        server = ModbusTcpServer(devices, address=(host, port), trace_packet=_muffled(faults))
        try:
            await server.serve_forever(background=True)
        except RuntimeError:
            raise ConnectError(
                f"voltage sensor {axes[0]}",
                f"TCP port {port} of {host} cannot be had: end the program that holds it, or set "
                f"axis.{axes[0]}.voltage.port to another one (0 lets the simulator choose one)",
            ) from None
        self._servers.append(server)
        listener = server.transport
        assert isinstance(listener, asyncio.Server)
        return int(listener.sockets[0].getsockname()[1])

    async def _close(self) -> None:
        for server in self._servers:
            server.serving.cancel()
            server.close()
        others = asyncio.all_tasks(self._loop) - {asyncio.current_task(self._loop)}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)


def _muffled(faults: Mapping[int, SensorFaults]) -> Callable[[bool, bytes], bytes]:
    """Return the hook through which every packet goes: a silent sensor sends nothing. 0 is whatever unit."""

    def hook(sending: bool, packet: bytes) -> bytes:
        told = faults.get(0) or faults.get(packet[_UNIT_BYTE]) if len(packet) > _UNIT_BYTE else None
        return b"" if sending and told is not None and told.silent else packet

    return hook
