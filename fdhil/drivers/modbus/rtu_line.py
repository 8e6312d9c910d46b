"""A serial line with Modbus RTU units: one request at a time, silent intervals, late and foreign answers detected.

An answer names its unit and function but not its request. So unrequested bytes are discarded before each request, and
after a request that was not answered in time the line is monitored for as long again. An answer that is later still is
recognised by its shape: while one is outstanding, no request of the same shape is sent before the unit has answered a
probe of another shape (:mod:`fdhil.drivers.modbus.outstanding_answers`). Noise, or a fragment, is not an answer:
the real one may still come, and must not be taken for the next request's.
"""

import asyncio
import contextlib
import struct
import time
from collections import Counter
from collections.abc import MutableSet
from weakref import WeakSet

from fdhil.config import ModbusDevice
from fdhil.drivers.modbus.modbus_line import DamagedAnswer, ModbusAnswer, ModbusRefused, ModbusRequest, make_timeout
from fdhil.drivers.modbus.outstanding_answers import OutstandingAnswers
from fdhil.drivers.modbus.rtu_frames import (
    ERROR,
    WRITE_REGISTER,
    build_frame,
    classify_fault,
    count_answer_bytes,
    find_answer,
    is_damaged,
    unpack_values,
)
from fdhil.drivers.serial.byte_stream import ByteStream
from fdhil.drivers.serial.serial_port import SerialPort
from fdhil.drivers.serial.server_port import ServerPort

RETRIES = 2
SILENT_CHARACTERS = 3.5
SILENT_ABOVE_19200_S = 1.75e-3  # constant by "MODBUS over serial line" 2.5.1.1
FASTEST_BY_CHARACTERS = 19200
NETWORK_S = 0.2  # gap between bytes of a serial server
ADAPTER_S = 0.02  # gap between bytes of one frame: a USB adapter delivers every 16 ms
_REQUEST_BYTES = 8
MOST_BYTES = 512  # two longest frames: kept of invalid bytes


class RtuLine:
    """The units on one serial device, or behind a serial server that passes their frames over TCP."""

    def __init__(self, place: ModbusDevice) -> None:
        over_tcp = not place.device
        self._port: ByteStream = ServerPort(place.host, place.port) if over_tcp else SerialPort(place)
        self.place = f"Modbus RTU {place.device or f'{place.host}:{place.port}'}"
        self._advice = "check the device and its line" + ("; framing = 'tcp' is for Modbus TCP" if over_tcp else "")
        self._apart_s = NETWORK_S if over_tcp else None
        self.users: MutableSet[object] = WeakSet()
        self.fault_counts: Counter[str] = Counter()
        self._turn = asyncio.Lock()
        fast = place.baud_rate > FASTEST_BY_CHARACTERS
        self.silence_s = SILENT_ABOVE_19200_S if fast else SILENT_CHARACTERS * self._port.character_s
        self._busy_until_ns = 0
        self._outstanding = OutstandingAnswers()
        self._late_until_ns = 0

    @property
    def is_connected(self) -> bool:
        return self._port.is_open

    async def connect(self, name: str, timeout_s: float) -> None:
        async with self._turn:
            if not self._port.is_open:
                await self._port.connect(name, timeout_s)

    async def send_request(self, request: ModbusRequest) -> ModbusAnswer:
        """Send the request and return the answer; it is repeated after a damaged answer, not after a missing one."""
        async with self._turn:
            for left in range(RETRIES, -1, -1):
                try:
                    return await self._exchange_frames(request)
                except DamagedAnswer as error:
                    if error.kind == "ModbusUnit":  # already counted, and waited for
                        raise
                    self.fault_counts[error.kind] += 1
                    if not left:
                        raise
        raise AssertionError("unreachable")

    async def _exchange_frames(self, request: ModbusRequest) -> ModbusAnswer:
        await self._drain_late_answers(request.name)
        if self._outstanding.is_ambiguous(request):
            await self._probe_unit(request)
        return await self._send_and_receive(request)

    async def _probe_unit(self, request: ModbusRequest) -> None:
        """Have the unit answer a probe of unmistakable shape; DeviceTimeout while it does not."""
        probe = self._outstanding.find_probe(request)
        if probe is not None:
            with contextlib.suppress(ModbusRefused):
                await self._send_and_receive(probe)
            return
        self._late_until_ns = time.monotonic_ns() + round(request.timeout_s * 1e9)
        await self._drain_late_answers(request.name)
        if self._outstanding.is_ambiguous(request):
            raise make_timeout(request, self._advice)

    async def _send_and_receive(self, request: ModbusRequest) -> ModbusAnswer:
        await self._wait_for_silence()
        body = struct.pack(">BHH", request.function, request.address, request.value)
        frame = build_frame(request.unit, body)
        sent_ns = self._port.send(request.name, frame)
        self._busy_until_ns = asked_ns = sent_ns + self._port.compute_wire_ns(_REQUEST_BYTES)
        self._outstanding.add_request(request, sent_ns)  # the caller may be cancelled before the answer
        self._late_until_ns = asked_ns + round(2 * request.timeout_s * 1e9)
        echo = b"" if request.function == WRITE_REGISTER else frame
        answer, answered_ns = await self._receive_answer(request, asked_ns, echo)
        refused = answer[0] == request.function | ERROR
        self._outstanding.settle_unit(request.unit, certain=not refused)
        if refused:
            raise ModbusRefused(request.name, request.address, answer[1])
        registers = unpack_values(answer[2:], request.function, request.count) if request.count else ()
        return ModbusAnswer(registers, min(asked_ns, answered_ns), answered_ns)

    async def _drain_late_answers(self, name: str) -> None:
        stale, data = bool(self._port.discard_input()), b""
        self._outstanding.drop_expired(time.monotonic_ns())
        while self._outstanding and time.monotonic_ns() < self._late_until_ns:
            chunk = await self._port.receive_chunk(name, self._late_until_ns)
            data = (data + (chunk.data if chunk is not None else b""))[-MOST_BYTES:]
            if self._outstanding.settle_answer(data):
                stale, data = True, b""
        self.fault_counts["ModbusStale"] += stale or bool(data)

    async def _wait_for_silence(self) -> None:
        while True:
            last_ns = max(self._busy_until_ns, self._port.last_ns)
            left_ns = last_ns + round(self.silence_s * 1e9) - time.monotonic_ns()
            if left_ns <= 0:
                break
            await asyncio.sleep(left_ns / 1e9)
        self._port.discard_input()

    async def _receive_answer(self, request: ModbusRequest, asked_ns: int, echo: bytes) -> tuple[bytes, int]:
        """Return the answer and the arrival of its first character; DamagedAnswer, DeviceTimeout.

        ``echo``: the request as an adapter may receive it back, which is skipped.
        """
        port, unit, function, count = self._port, request.unit, request.function, request.count
        data, first_ns = b"", 0
        noise: DamagedAnswer | None = None
        foreign: DamagedAnswer | None = None
        wanted = count_answer_bytes(function, count)
        deadline_ns = asked_ns + round(request.timeout_s * 1e9) + port.compute_wire_ns(wanted)
        pause_ns = round((self.silence_s + (self._apart_s or ADAPTER_S)) * 1e9)
        while True:
            until_ns = min(deadline_ns, time.monotonic_ns() + pause_ns) if data else deadline_ns
            chunk = await port.receive_chunk(request.name, until_ns)
            if chunk is not None:
                first_ns = first_ns or chunk.t_ns - port.compute_wire_ns(len(chunk.data))
                data = (data + chunk.data).removeprefix(echo)
                # earlier bytes were already searched: the line may babble for long
                found = find_answer(data[-(len(chunk.data) + wanted) :], unit, function, count)
                if found is not None:
                    return found, first_ns
                data = data[-MOST_BYTES:]
                continue
            if data:
                damaged = DamagedAnswer(request.name, *classify_fault(data, unit, function, count))
                if self._outstanding.settle_answer(data):
                    self.fault_counts["ModbusStale"] += 1  # our answer is still to come
                elif damaged.kind == "ModbusUnit":
                    self.fault_counts[damaged.kind] += 1  # another master may have asked: ours may still come
                    foreign = damaged
                elif is_damaged(data, unit, function, count):
                    self._outstanding.settle_unit(unit, certain=False)
                    raise damaged
                else:
                    noise = damaged
                data, first_ns = b"", 0
            if time.monotonic_ns() >= deadline_ns:
                raise noise or foreign or make_timeout(request, self._advice)

    def close(self) -> None:
        self._port.close()
