"""The simulated voltage sensor, read by pymodbus like any client."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusIOException

from fdhil.errors import ConnectError
from fdhil.sim.wire.modbus_sensor import BLOCK, VoltageSensor
from fdhil.sim.wire.modbus_tcp_servers import SensorServers
from tests.sim.bench_simulator import SteppedSimulator, build_corner_rows, build_simulator_config


def create_sensor(noise_v: float = 0.0) -> VoltageSensor:
    return VoltageSensor(1000.0, 300.0, noise_v, np.random.default_rng(1))


@dataclass
class SensorBench:
    """A served sensor and a client."""

    sensor: VoltageSensor
    client: ModbusTcpClient
    port: int

    def read_floats(self, address: int, count: int) -> list[float]:
        registers = self.client.read_input_registers(address, count=2 * count).registers
        return list(struct.unpack(f">{count}f", struct.pack(f">{2 * count}H", *registers)))

    def read_number(self, address: int) -> int:
        high, low = self.client.read_holding_registers(address, count=2).registers
        return int(high << 16 | low)


@pytest.fixture
def bench() -> Iterator[SensorBench]:
    sensor = create_sensor()
    servers = SensorServers({"X": sensor}, {"X": ("127.0.0.1", 0)})
    servers.start()
    try:
        with ModbusTcpClient("127.0.0.1", port=servers.ports["X"], timeout=60, retries=0) as client:
            yield SensorBench(sensor, client, servers.ports["X"])
    finally:
        servers.stop()


def test_newest_voltage_is_at_address_0(bench: SensorBench) -> None:
    for k in range(150):
        bench.sensor.feed_mean_voltage(0.5 * k)
    bench.sensor.celsius = 21.25
    assert bench.read_floats(0, 1) == [74.5]
    assert bench.read_number(2) == 149
    assert bench.read_floats(4, 1) == [1000.0]
    assert bench.read_floats(6, 1) == [pytest.approx(bench.sensor.volts_per_count)]
    assert bench.read_floats(8, 1) == [21.25]


@pytest.mark.parametrize("unit", [0, 1, 17, 247])
def test_any_unit_reads_same_input_and_holding_registers(bench: SensorBench, unit: int) -> None:
    bench.sensor.feed_mean_voltage(-12.5)
    both = [
        read(0, count=10, device_id=unit).registers
        for read in (bench.client.read_input_registers, bench.client.read_holding_registers)
    ]
    assert both[0] == both[1]
    assert struct.unpack(">f", struct.pack(">2H", *both[0][:2])) == (-12.5,)


@pytest.mark.parametrize(("address", "count"), [(116, 1), (115, 2), (0, 117), (1000, 1), (65535, 1)])
def test_unknown_address_returns_exception_2(bench: SensorBench, address: int, count: int) -> None:
    for read in (bench.client.read_input_registers, bench.client.read_holding_registers):
        answer = read(address, count=count)
        assert answer.isError()
        assert answer.exception_code == 2


def test_only_the_trigger_can_be_written(bench: SensorBench) -> None:
    assert bench.client.write_register(11, 1).exception_code == 2
    assert bench.client.write_register(200, 1).exception_code == 2
    assert bench.client.write_registers(10, [1, 1]).exception_code == 2
    assert bench.client.write_register(10, 2).exception_code == 3
    assert not bench.client.write_register(10, 1).isError()
    assert not bench.client.write_registers(10, [1]).isError()
    assert bench.client.write_register(10, 1, device_id=5).registers == [1]
    assert bench.client.read_holding_registers(10, count=1).registers == [0]


def test_latch_returns_samples_not_latched_before(bench: SensorBench) -> None:
    assert bench.client.read_holding_registers(11, count=1).registers == [0]
    for k in range(30):
        bench.sensor.feed_mean_voltage(float(k))
    bench.client.write_register(10, 1)
    block = bench.client.read_holding_registers(11, count=105).registers
    assert block[:5] == [1, 0, 0, 30, 0]
    assert _read_block_volts(bench, block[5:35]) == pytest.approx(range(30), abs=0.01)
    assert block[35:] == [0] * 70
    for k in range(130):
        bench.sensor.feed_mean_voltage(-float(k))
    assert bench.client.read_holding_registers(11, count=105).registers == block, "the block stays until the next latch"
    bench.client.write_register(10, 1)
    block = bench.client.read_holding_registers(11, count=105).registers
    assert block[:5] == [2, 0, 60, 100, 0], "30 samples did not fit"
    assert _read_block_volts(bench, block[5:]) == pytest.approx([-float(k) for k in range(30, 130)], abs=0.01)
    bench.client.write_register(10, 1)
    assert bench.client.read_holding_registers(11, count=5).registers == [1, 0, 160, 0, 0]


def _read_block_volts(bench: SensorBench, words: Sequence[int]) -> list[float]:
    return [count * bench.sensor.volts_per_count for count in struct.unpack(f">{len(words)}h", _exchange_bytes(words))]


def _exchange_bytes(words: Sequence[int]) -> bytes:
    return struct.pack(f">{len(words)}H", *words)


@given(st.lists(st.integers(0, 250), min_size=1, max_size=8))
def test_latched_blocks_join_without_overlap(batches: list[int]) -> None:
    sensor = create_sensor()
    seen: list[int] = []
    fed = lost = 0
    for batch in batches:
        for _ in range(batch):
            sensor.feed_mean_voltage(fed * 0.1)
            fed += 1
        sensor.latch_samples()
        words = sensor.read_registers()
        first, number = words[12] << 16 | words[13], words[14]
        assert (words[11] == 2) == (batch > BLOCK)
        lost += max(0, batch - BLOCK)
        seen += range(first, first + number)
    assert len(set(seen)) == len(seen) == fed - lost
    assert all(0 <= c < fed for c in seen)


def test_sensor_faults_change_answers(bench: SensorBench) -> None:
    signal = bench.sensor.faults.signal
    bench.sensor.feed_mean_voltage(10.0)
    signal.stuck = True
    bench.sensor.feed_mean_voltage(20.0)
    bench.sensor.feed_mean_voltage(30.0)
    assert bench.read_floats(0, 1) == [20.0]
    assert bench.read_number(2) == 2, "a stuck sensor goes on counting"
    signal.stuck = False
    signal.gain, signal.offset = 2.0, 1.0
    bench.sensor.feed_mean_voltage(3.0)
    assert bench.read_floats(0, 1) == [7.0]
    signal.gain, signal.offset, signal.delay_cycles = 1.0, 0.0, 2
    for volt in (1.0, 2.0, 3.0, 4.0):
        bench.sensor.feed_mean_voltage(volt)
    assert bench.read_floats(0, 1) == [2.0]
    signal.delay_cycles = 0
    bench.sensor.feed_mean_voltage(5.0)
    bench.sensor.feed_mean_voltage(6.0)
    assert bench.read_floats(0, 1) == [6.0]
    bench.sensor.faults.exception = 4
    assert bench.client.read_input_registers(0, count=2).exception_code == 4


def test_a_silent_sensor_answers_nothing(bench: SensorBench) -> None:
    bench.sensor.faults.silent = True
    hasty = ModbusTcpClient("127.0.0.1", port=bench.port, timeout=0.1, retries=0)
    with hasty, pytest.raises(ModbusIOException):
        hasty.read_input_registers(0, count=2)
    bench.sensor.faults.silent = False
    assert not bench.client.read_input_registers(0, count=2).isError()


def test_port_in_use_is_reported_in_one_sentence(bench: SensorBench) -> None:
    second = SensorServers({"Y": create_sensor()}, {"Y": ("127.0.0.1", bench.port)})
    with pytest.raises(ConnectError, match=rf"voltage sensor Y: TCP port {bench.port} .* axis\.Y\.voltage\.port"):
        second.start()


def test_machine_feeds_one_mean_per_sync() -> None:
    """At a SYNC, sensor and drive report the mean over the ended period."""
    twin = SteppedSimulator(build_simulator_config(drive={"sign": -1}))
    twin.switch_on()
    twin.play_rows(build_corner_rows())
    unit = twin.machine.units["X"]
    fed, reported = [], []

    def record_mean() -> None:
        words = unit.sensor.read_registers()
        fed.append(struct.unpack(">f", _exchange_bytes(words[:2]))[0])
        reported.append(-0.02 * unit.drive.dictionary.get_number(0x2101))

    twin.each_cycle = record_mean
    twin.run_until("finished")
    assert np.ptp(fed) > 20
    assert np.array(reported) == pytest.approx(np.array(fed), abs=0.0101)


def test_noise_is_white_and_repeats_with_the_seed() -> None:
    def read_samples() -> list[float]:
        sensor = create_sensor(noise_v=0.5)
        values = []
        for _ in range(2000):
            sensor.feed_mean_voltage(0.0)
            values.append(struct.unpack(">f", _exchange_bytes(sensor.read_registers()[:2]))[0])
        return values

    first = read_samples()
    assert first == read_samples()
    assert np.std(first) == pytest.approx(0.5, rel=0.1)
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 0.1


def test_slow_sensor_sample_is_mean_over_its_cycles() -> None:
    slow = VoltageSensor(200.0, 300.0, 0.0, np.random.default_rng(1), 5)
    for volts in (1.0, 2.0, 3.0, 4.0, 5.0, 9.0):
        slow.feed_mean_voltage(volts)
    slow.latch_samples()
    registers = slow.read_registers()
    assert registers[14] == 1
    assert registers[16] * slow.volts_per_count == pytest.approx(3.0, abs=slow.volts_per_count)
