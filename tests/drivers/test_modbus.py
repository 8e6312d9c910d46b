"""The voltage sensor on Modbus: blocks, clocks, and every fault that it can have."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.pdu.register_message import ReadInputRegistersResponse

from fdhil.config import MachineConfig
from fdhil.config.sensor_sections import ModbusDevice
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.modbus.counter_clock import CounterClock
from fdhil.drivers.modbus.modbus_line import ModbusRefused, ModbusRequest
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.drivers.modbus.sampled_voltage import ModbusVoltage, SensorBlock, parse_block
from fdhil.drivers.modbus.tcp_line import TcpLine
from fdhil.drivers.sensor_source import Record, SensorSource
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import Notice, Temperature, TickTimes, VoltageSamples
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.modbus_peer import VOLTS_PER_COUNT, SensorPeer, run_sensor_peer
from tests.drivers.serial_peer import build_frame
from tests.reserved_port import reserve_port


def build_config(port: int, **voltage: Any) -> MachineConfig:
    return build_machine_config(voltage={"source": "modbus", "port": port, "timeout_s": 60.0, **voltage})


async def test_consecutive_blocks_have_no_gap() -> None:
    async with run_sensor_peer() as peer:
        sensor = ModbusVoltage("X", build_config(peer.port))
        await sensor.link.connect()
        records: list[VoltageSamples | Temperature | Notice] = []
        for _ in range(8):
            await asyncio.sleep(0.02)
            records += await sensor.poll_samples(TickClock(0.001))
        sensor.link.close()
    blocks = [r for r in records if isinstance(r, VoltageSamples)]
    counter = np.concatenate([b.counter for b in blocks])
    assert np.all(np.diff(counter) == 1) or sensor.lost > 0
    volts = np.concatenate([b.voltage_v for b in blocks])
    np.testing.assert_allclose(volts, counter % 1000 * VOLTS_PER_COUNT)
    assert {r.celsius for r in records if isinstance(r, Temperature)} == {21.5}
    true_ns = peer.start * 1e9 + counter * 1e6
    t_ns = np.concatenate([b.t_ns for b in blocks])
    error_ns = np.concatenate([b.t_error_ns for b in blocks])
    assert np.all(np.abs(t_ns - true_ns)[-5:] <= error_ns[-5:] + 300_000)


async def test_samples_not_fetched_in_time_are_counted() -> None:
    async with run_sensor_peer() as peer:
        sensor = ModbusVoltage("X", build_config(peer.port))
        await sensor.link.connect()
        await sensor.poll_samples(TickClock(0.001))
        await asyncio.sleep(0.25)
        notices = [r for r in await sensor.poll_samples(TickClock(0.001)) if isinstance(r, Notice)]
        sensor.link.close()
    assert [n.code for n in notices] == ["SampleTiming"]
    assert sensor.lost >= 100


async def test_stuck_sensor_is_reported_once() -> None:
    async with run_sensor_peer() as peer:
        peer.frozen_at = 0
        sensor = ModbusVoltage("X", build_config(peer.port))
        await sensor.link.connect()
        records = [r for _ in range(60) for r in await sensor.poll_samples(TickClock(0.001))]
        sensor.link.close()
    assert [r.code for r in records if isinstance(r, Notice)] == ["StuckValue"]


@pytest.mark.parametrize(
    ("mode", "error", "says"),
    [
        ("silent", DeviceTimeout, "was not answered within 0.2 s"),
        ("exception", ProtocolError, "illegal register address"),
        ("busy", ProtocolError, "is refused (busy); poll it less often"),
        ("short", DeviceError, ""),
        ("nonsense", ProtocolError, "the answer is not Modbus TCP"),
        ("other function", ProtocolError, "function 1 was answered instead of 6"),
        ("nan", ProtocolError, "sample rate of nan Hz"),
        ("too many", ProtocolError, "101 samples"),
        ("hang up", ConnectError, "is gone; check its supply and cable, and its limit of clients"),
    ],
)
async def test_each_device_fault_gives_one_error(mode: str, error: type[DeviceError], says: str) -> None:
    async with run_sensor_peer() as peer:
        sensor = ModbusVoltage("X", build_config(peer.port, timeout_s=0.2 if mode in ("silent", "hang up") else 60.0))
        await sensor.link.connect()
        peer.mode = mode
        with pytest.raises(error, match="voltage sensor X") as caught:
            await sensor.poll_samples(TickClock(0.001))
        assert says in str(caught.value)
        sensor.link.close()


@pytest.mark.parametrize(
    ("code", "says"),
    [(2, "compare the register map"), (4, "the device itself"), (11, "check unit, and the line behind the gateway")],
)
def test_exception_of_a_unit_or_gateway_has_its_own_advice(code: int, says: str) -> None:
    assert says in str(ModbusRefused("voltage sensor X", 0, code))


@pytest.mark.parametrize("other", [0, 1, 255])
async def test_answer_from_another_unit_is_named(other: int) -> None:
    async with run_sensor_peer() as peer:
        peer.served, peer.mode, peer.other_unit = [7, 8], "other unit", other
        link = ModbusUnit("sensor", ModbusDevice(port=peer.port, unit=3, timeout_s=60.0))
        await link.connect()
        for asked in (1, 2):
            with pytest.raises(
                ProtocolError, match=f"unit {other} answered instead of unit 3; set unit = {other}"
            ) as caught:
                await link.read_registers(3, 0, 1)
            assert link.classify_fault(caught.value) == "ModbusUnit"
            assert link.fault_counts == {"ModbusUnit": asked}
        peer.other_unit = 3
        assert await link.read_registers(3, 0, 2) == [7, 8]
        link.close()
        link = ModbusUnit("sensor", ModbusDevice(port=peer.port, unit=0, timeout_s=60.0))
        await link.connect()
        assert await link.read_registers(3, 1, 1) == [8]  # 0 asks the device itself, whatever it calls itself
        link.close()


async def test_silent_tcp_device_advises_rtu_framing() -> None:
    async with run_sensor_peer() as peer:
        peer.mode = "silent"
        link = ModbusUnit("sensor", ModbusDevice(port=peer.port, timeout_s=0.1))
        await link.connect()
        with pytest.raises(DeviceTimeout, match="passes RTU frames needs framing = 'rtu'"):
            await link.read_registers(3, 0, 1)
        link.close()


async def test_rtu_over_serial_server_survives_reconnection() -> None:
    parts = bytearray()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while request := await reader.read(8):
            parts.extend(request)
            frame = build_frame(3, b"\x04\x04\x41\x48\x00\x00")
            for piece in (frame[:4], frame[4:]):  # as the server packs them
                writer.write(piece)
                await writer.drain()
                await asyncio.sleep(0.03)
            if len(parts) == 16:
                break
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    place = ModbusDevice(port=server.sockets[0].getsockname()[1], unit=3, framing="rtu", timeout_s=60.0)
    link = ModbusUnit("sensor", place)
    await link.connect()
    assert [await link.read_registers(4, 0, 2) for _ in range(2)] == [[0x4148, 0]] * 2
    assert bytes(parts) == build_frame(3, bytes.fromhex("0400000002")) * 2
    with pytest.raises(ConnectError, match=r"the serial server .* is gone"):
        await link.read_registers(4, 0, 2)
    assert not link.is_connected
    server.close()
    await server.wait_closed()
    with pytest.raises(ConnectError, match="cannot be reached"):
        await link.connect()


async def test_source_cancelled_as_the_answer_comes_ends() -> None:
    line = TcpLine("127.0.0.1", 502)
    request = ModbusRequest("voltage sensor X", 1, 4, 0, 1, 10.0)
    answer = asyncio.get_running_loop().create_future()
    asking = asyncio.create_task(line.await_answer(asyncio.wait_for(answer, 10.0), request))
    for _ in range(3):
        await asyncio.sleep(0)
    answer.set_result(ReadInputRegistersResponse(registers=[1]))
    asking.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asking


async def test_unreachable_device_is_reported() -> None:
    with reserve_port() as port, pytest.raises(ConnectError, match="cannot be reached"):
        await ModbusUnit("voltage sensor X", ModbusDevice(port=port)).connect()


@pytest.mark.fault("B1", "B2", "B8")
async def test_source_reports_loss_and_return_of_the_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.drivers.sensor_source.POLL_S", 0.01)
    out = asyncio.Queue[Record]()
    codes: list[tuple[str, str]] = []

    async def until(code: str, severity: str) -> None:
        async with asyncio.timeout(300):
            while (code, severity) not in codes:
                record = await out.get()
                if isinstance(record, Notice):
                    codes.append((record.code, record.severity))

    async with run_sensor_peer() as peer:
        source = SensorSource(ModbusVoltage("X", build_config(peer.port, timeout_s=0.2)), TickClock(0.001))
        task = asyncio.create_task(source.run(out.put_nowait))
        for mode, code in (("silent", "ModbusTimeout"), ("exception", "ModbusException"), ("nan", "ModbusShape")):
            peer.mode = mode
            await until(code, "MAJOR")
            peer.mode = "good"
            await until(code, "info")
        task.cancel()
        source.close()
        await asyncio.gather(task, return_exceptions=True)
    assert source.read_counters()["failures"] >= 3


def build_registers(peer: SensorPeer) -> list[int]:
    peer.frozen_at = 99
    peer.latch_samples()
    return peer.build_registers()


@pytest.mark.usefixtures("long_computation")
@settings(max_examples=200)
@given(st.integers(0, 115), st.integers(0, 0xFFFF))
def test_damaged_register_is_detected(at: int, value: int) -> None:
    words = build_registers(SensorPeer())
    words[at] = value
    try:
        block = parse_block("sensor", words)
    except ProtocolError:
        return
    assert np.all(np.isfinite(block.volts))
    assert block.volts.size <= 100


@pytest.mark.usefixtures("real_time")
@settings(max_examples=40, deadline=None)
@given(
    drift=st.floats(-100e-6, 100e-6),
    phase=st.floats(0, 1),
    delays=st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 2.0)), min_size=40, max_size=80),
)
def test_counter_clock_is_estimated_within_its_error(
    drift: float, phase: float, delays: list[tuple[float, float]]
) -> None:
    clock = CounterClock(1.0)
    step = 1.0 + drift
    for k, (before, after) in enumerate(delays):
        read_at = 50.3 * k + phase
        counter = int((read_at - 7.0) // step) - 1 + 1000
        clock.add_query(counter, read_at - before, read_at + after)
    line = clock.estimate_line()
    assert line is not None
    true_start = 7.0 + step * (line.origin - 1000)
    assert abs(line.locate_sample(line.origin) - true_start) <= line.error + 0.3


def test_counter_clock_outvotes_wrong_queries() -> None:
    clock = CounterClock(1.0)
    for k in range(60):
        late = 30.0 if k % 7 == 3 else 0.0
        clock.add_query(50 * k, 50.0 * k + 1.2 + late, 50.0 * k + 1.8 + late)
    line = clock.estimate_line()
    assert line is not None
    assert line.locate_sample(0) == pytest.approx(0.0, abs=0.5)


def test_restarted_sensor_is_placed_again() -> None:
    clock = CounterClock(1.0)
    clock.add_query(1000, 1000.5, 1001.5)
    clock.add_query(0, 2000.5, 2001.5)
    line = clock.estimate_line()
    assert line is not None
    assert line.origin == 0


def test_samples_are_placed_through_the_sync_count() -> None:
    sensor = ModbusVoltage("X", build_config(1))
    ticks = TickClock(0.001)
    # the machine is held up for 80 ms between tick 500 and 501; sensor and SYNC both wait
    t_ns = np.arange(1000) * 1_000_000 + np.where(np.arange(1000) > 500, 80_000_000, 0)
    ticks.add_arrivals(TickTimes(np.arange(1000), t_ns))
    last: VoltageSamples | None = None
    for k in range(50, 1000, 50):
        block = SensorBlock(k - 1, 1000.0, 20.0, False, k - 50, np.zeros(50), 0.0)
        asked = int(t_ns[k - 1]) + 999_000 if k > 501 else k * 1_000_000 + 100_000
        asked = int(np.interp(k + 0.3, np.arange(1000), t_ns))
        for record in sensor.accept_block(block, asked, asked + 200_000, ticks):
            if isinstance(record, VoltageSamples):
                last = record
    assert last is not None
    placed = np.interp(last.t_ns, t_ns, np.arange(1000))
    np.testing.assert_allclose(placed, last.counter, atol=0.6)


def test_repeated_samples_are_used_once() -> None:
    """A sensor without a latch returns the newest samples, whether or not they were read before."""
    sensor, ticks = ModbusVoltage("X", build_config(1)), TickClock(0.001)
    taken: list[int] = []
    for poll, newest in enumerate([39, 39, 59, 139, 9]):  # the count fell: the sensor was restarted
        block = SensorBlock(newest, 1000.0, np.nan, False, max(0, newest - 39), np.zeros(min(40, newest + 1)), 0.0)
        for record in sensor.accept_block(block, poll * 50_000_000, poll * 50_000_000 + 200_000, ticks):
            if isinstance(record, VoltageSamples):
                taken += record.counter.tolist()
    assert taken == [*range(60), *range(100, 140), *range(10)]
    assert (sensor.samples, sensor.lost) == (110, 40)


@pytest.mark.fault("B9")
@pytest.mark.parametrize("tear", [-65536, 65536])
@pytest.mark.parametrize("lasting", [False, True])
def test_torn_count_is_discarded_once_and_then_accepted(tear: int, lasting: bool) -> None:
    sensor, ticks = ModbusVoltage("X", build_config(1)), TickClock(0.001)
    taken: list[int] = []
    reported: list[str] = []
    for poll in range(6):
        newest = 200_039 + 40 * poll + (tear if poll == 3 or (lasting and poll > 3) else 0)
        block = SensorBlock(newest, 1000.0, np.nan, False, newest - 99, np.zeros(100), 0.0)
        for record in sensor.accept_block(block, poll * 40_000_000, poll * 40_000_000 + 200_000, ticks):
            if isinstance(record, VoltageSamples):
                taken += record.counter.tolist()
            elif isinstance(record, Notice):
                reported.append(record.code)
    assert reported[0] == "RegisterTear"
    assert reported.count("RegisterTear") == 1
    if not lasting:
        assert np.all(np.diff(taken) == 1)
        assert sensor.lost == 0
    assert taken[-1] == newest


@pytest.mark.usefixtures("real_time")
def test_late_sync_stamps_do_not_shift_samples() -> None:
    rng = np.random.default_rng(1)
    sensor = ModbusVoltage("X", build_config(1))
    ticks = TickClock(0.001)
    asked = np.arange(50, 5900, 50) * 1_000_000 - 12_000_000 + rng.integers(0, 900_000, 117)
    stamps = np.arange(6000) * 1_000_000
    # most often this computer is busy just when the sensor answers: SYNCs that come in these 6 ms are stamped later
    for busy_ns in asked[rng.random(asked.size) < 0.8]:
        late = (stamps > busy_ns) & (stamps < busy_ns + 6_000_000)
        stamps[late] = busy_ns + 6_000_000
    begins = []
    for k, asked_ns in zip(range(50, 5900, 50), asked, strict=True):
        ticks.add_arrivals(TickTimes(np.arange(k - 50, k), stamps[k - 50 : k]))
        answered_ns = int(asked_ns + rng.integers(2_000_000, 4_000_000))
        newest = (int(asked_ns) + answered_ns) // 2_000_000 - 1
        block = SensorBlock(newest, 1000.0, 20.0, False, newest - 49, np.zeros(50), 0.0)
        sensor.accept_block(block, int(asked_ns), answered_ns, ticks)
        assert sensor.counter_line is not None
        begins.append(sensor.counter_line.locate_sample(0))
    np.testing.assert_allclose(begins[20:], 0.0, atol=0.6)
