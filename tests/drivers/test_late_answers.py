"""Modbus RTU answers that arrive after their time-out are never taken as answers to later requests."""

from __future__ import annotations

import asyncio
import struct
from collections import deque
from collections.abc import Coroutine
from unittest.mock import patch

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fdhil.config.sensor_sections import ModbusDevice
from fdhil.drivers.modbus import rtu_line
from fdhil.drivers.modbus.modbus_line import ModbusAnswer, ModbusRequest
from fdhil.drivers.modbus.outstanding_answers import OutstandingAnswers
from fdhil.drivers.modbus.rtu_line import RtuLine
from fdhil.drivers.serial.byte_stream import Chunk
from fdhil.errors import DeviceError, DeviceTimeout, ProtocolError
from tests.drivers.serial_peer import build_frame, run_patiently, run_rtu_peer, wait_until
from tests.drivers.test_rtu_frames import build_answer, connect_unit

TIMEOUT_S = 0.3
REGISTERS = [100, 200, 300, 400, 500]


@pytest.mark.fault("B7")
@run_patiently
async def test_answer_later_than_twice_the_timeout_is_dropped() -> None:
    async with run_rtu_peer(u1=REGISTERS) as peer:
        link = connect_unit(peer, timeout_s=0.4)
        await link.connect()
        peer.spoil = [lambda frame: [], lambda frame: [build_answer(1, 100), frame]]
        with pytest.raises(DeviceTimeout):
            await link.read_input_registers(0, 1)
        assert [await link.read_input_registers(k, 1) for k in range(1, 5)] == [[200], [300], [400], [500]]
        assert link.line.fault_counts["ModbusStale"] == 0  # both came at once: the probe's answer was found behind it
        assert [struct.unpack(">HH", request[2:6]) for request in peer.requests][:3] == [(0, 1), (1, 2), (1, 1)]
        link.close()


@pytest.mark.fault("B7")
@run_patiently
async def test_refused_probe_resynchronises_the_unit() -> None:
    async with run_rtu_peer(u1=[7]) as peer:
        link = connect_unit(peer, timeout_s=0.4)
        await link.connect()
        peer.spoil = [lambda frame: []]
        with pytest.raises(DeviceTimeout):
            await link.read_input_registers(0, 1)
        assert await link.read_input_registers(0, 1) == [7]
        assert await link.read_input_registers(0, 1) == [7]
        assert len(peer.requests) == 4
        link.close()


@pytest.mark.fault("B7")
@run_patiently
async def test_answer_to_a_cancelled_request_is_not_used_for_the_next() -> None:
    async with run_rtu_peer(u1=REGISTERS) as peer:
        link = connect_unit(peer, timeout_s=0.4)
        await link.connect()
        peer.spoil = [lambda frame: []]
        asking = asyncio.create_task(link.read_input_registers(0, 1))
        await wait_until(lambda: peer.requests)
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        asking = asyncio.create_task(link.read_input_registers(1, 1))
        await asyncio.sleep(0.05)
        peer.send_bytes(build_answer(1, 100))
        assert await asking == [200]
        link.close()


@pytest.mark.fault("B6")
@run_patiently
async def test_answer_from_another_unit_is_named() -> None:
    async with run_rtu_peer(u3=[7]) as peer:
        link = connect_unit(peer, unit=3, timeout_s=0.4)
        await link.connect()
        peer.spoil = [lambda frame: [build_frame(9, frame[1:-2])]] * 9
        with pytest.raises(ProtocolError, match=r"unit 9 answered instead of unit 3; set unit = 9") as caught:
            await link.read_input_registers(0, 1)
        assert link.classify_fault(caught.value) == "ModbusUnit"
        assert link.line.fault_counts["ModbusUnit"] == 1
        link.close()


class SlowUnit:
    """Replaces a port with one unit, in simulated time: it answers in order, with any delay."""

    is_open, character_s = True, 1e-4

    def __init__(self, delays: list[float | None]) -> None:
        self.now_ns = self.last_ns = self._free_ns = 0
        self._delays = deque(delays)
        self._coming: deque[Chunk] = deque()

    def monotonic_ns(self) -> int:
        return self.now_ns

    def compute_wire_ns(self, _count: int) -> int:
        return 0

    def send(self, _name: str, data: bytes) -> int:
        unit, function, address, count = struct.unpack(">BBHH", data[:6])
        delay_s = self._delays.popleft() if self._delays else 0.01
        if delay_s is not None:
            self._free_ns = max(self._free_ns, self.now_ns) + round(delay_s * 1e9)
            values = struct.pack(f">{count}H", *range(address, address + count))
            frame = build_frame(unit, bytes([function, 2 * count]) + values)
            self._coming.append(Chunk(frame, self._free_ns))
        return self.now_ns

    async def receive_chunk(self, _name: str, until_ns: int) -> Chunk | None:
        if self._coming and self._coming[0].t_ns <= until_ns:
            self.now_ns = max(self.now_ns, self._coming[0].t_ns)
            return self._coming.popleft()
        self.now_ns = max(self.now_ns, until_ns)
        return None

    def discard_input(self) -> int:
        came = sum(chunk.t_ns <= self.now_ns for chunk in self._coming)
        for _ in range(came):
            self._coming.popleft()
        return came


def answer_immediately(asking: Coroutine[None, None, ModbusAnswer]) -> ModbusAnswer:
    with pytest.raises(StopIteration) as ended:
        asking.send(None)
    assert isinstance(ended.value.value, ModbusAnswer)
    return ended.value.value


def send_requests(delays: list[float | None], requests: list[tuple[int, int]]) -> list[tuple[int, ...] | None]:
    """Return the result of each request (address, count) for these answer times; None for an error."""
    unit, line = SlowUnit(delays), RtuLine(ModbusDevice(device="/dev/none"))
    line._port, line.silence_s = unit, 0.0  # type: ignore[assignment] # stands for it
    got: list[tuple[int, ...] | None] = []
    with patch.object(rtu_line, "time", unit):
        for address, count in requests:
            try:
                got.append(
                    answer_immediately(
                        line.send_request(ModbusRequest("sensor", 1, 3, address, count, TIMEOUT_S))
                    ).registers
                )
            except DeviceError:
                got.append(None)
    return got


@pytest.mark.parametrize("first_s", [0.35, 0.45, 0.55, 0.59, 0.61, 0.65, 0.8, 0.89, 0.91, 1.0, 1.3, 2.0, 5.0])
def test_late_answer_does_not_shift_later_answers(first_s: float) -> None:
    wanted = [(100 * k, 1) for k in range(1, 21)]
    got = send_requests([first_s, *[0.075] * 40], wanted)
    assert all(found in ((address,), None) for found, (address, _) in zip(got, wanted, strict=True))
    assert got[-5:] == [(address,) for address, _ in wanted[-5:]]


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.one_of(st.none(), st.floats(0.001, 0.8)), max_size=11),
    st.lists(st.tuples(st.sampled_from([100, 200, 300, 400]), st.sampled_from([1, 1, 2, 4])), min_size=2, max_size=12),
)
@example([0.65, 0.075], [(100, 1), (200, 1), (300, 1)])
@example([None, 0.65, None, 0.65], [(100, 1), (200, 2), (300, 1), (400, 2)])
def test_no_request_gets_the_answer_to_another(delays: list[float | None], wanted: list[tuple[int, int]]) -> None:
    quick = [(900 + k, 1) for k in range(140)]
    got = send_requests(delays, wanted + quick)
    for found, (address, count) in zip(got, wanted + quick, strict=True):
        assert found in (tuple(range(address, address + count)), None)
    assert got[-1] == (1039,)  # a unit that is quick again is heard again


def test_probe_reads_within_the_requested_registers() -> None:
    owed, read = OutstandingAnswers(), ModbusRequest("sensor", 1, 4, 10, 2, TIMEOUT_S)
    found = []
    for _ in range(5):
        probe = owed.find_probe(read)
        if probe is not None:
            owed.add_request(probe, 0)
            found.append(probe.value)
    assert found == [1, 3, 4, 5]
    bits = OutstandingAnswers().find_probe(ModbusRequest("NC", 1, 1, 0, 3, TIMEOUT_S))
    write = OutstandingAnswers().find_probe(ModbusRequest("sensor", 1, 6, 10, 1, TIMEOUT_S))
    assert bits is not None
    assert write is not None
    assert (bits.function, bits.value) == (1, 11)
    assert (write.function, write.value) == (3, 1)
    last = OutstandingAnswers().find_probe(ModbusRequest("sensor", 1, 4, 65535, 1, TIMEOUT_S))
    assert last is None
