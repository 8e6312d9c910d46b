"""Sensors defined by a few lines of configuration, read from simulated ones served from the same configuration."""

from __future__ import annotations

import asyncio
import math
import re
import time
import tomllib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.config import MachineConfig, Voltage, parse_config
from fdhil.config.config_loader import find_unlikely_values
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.drivers.sensor_source import Record, Sensor, SensorSource, create_sensors
from fdhil.errors import ConfigError, DeviceTimeout, ProtocolError
from fdhil.records import Notice, Temperature, VoltageSamples
from fdhil.sim.wire.modbus_sensor import VoltageSensor
from fdhil.sim.wire.sensor_connections import SensorConnections
from tests.bench import bench_axis
from tests.drivers.modbus_peer import run_sensor_peer
from tests.reserved_port import reserve_port

PATIENCE_S = 60.0  # with a busy computer
TYPES = {"int16": 0.01, "uint16": 0.01, "int32": 1e-4, "uint32": 1e-4, "float32": 1.0, "float64": 1.0}


class SensorBench:
    """The simulated sensors of a machine, and the drivers created from its configuration."""

    def __init__(self, document: dict[str, Any]) -> None:
        self.document = document
        made = parse_config(document)
        self.memory = {axis: _build_memory(made, axis) for axis in made.axis}
        self.wires = SensorConnections(made, self.memory)

    def config(self) -> MachineConfig:
        """Return the configuration with the ports used."""
        for axis, place in self.wires.ready.items():
            self.document["axis"][axis]["voltage"] |= place
        return parse_config(self.document)

    def sensors(self, axis: str = "X") -> dict[str, Sensor]:
        return create_sensors(axis, self.config())


def _build_memory(made: MachineConfig, axis: str) -> VoltageSensor:
    limit_v = made.axis[axis].regulators.voltage_limit_v
    sensor = VoltageSensor(1000.0, limit_v, 0.0, np.random.default_rng(1))
    sensor.feed_mean_voltage(-12.34)
    sensor.celsius = 21.5
    return sensor


@asynccontextmanager
async def run_sensor_bench(
    *voltages: dict[str, Any], temperature: dict[str, Any] | None = None
) -> AsyncIterator[SensorBench]:
    axes = {}
    for name, voltage in zip("XYZ", voltages, strict=False):
        axes[name] = bench_axis(corrected=False, voltage={"timeout_s": PATIENCE_S} | voltage)
        if temperature is not None:
            axes[name]["temperature"] = {"timeout_s": PATIENCE_S} | temperature
    served = SensorBench({"machine": {"name": "bench"}, "axis": axes})
    served.wires.start()
    try:
        yield served
    finally:
        served.wires.stop()


async def collect_voltages(sensor: Sensor, polls: int = 1) -> np.ndarray:
    await sensor.link.connect()
    found: list[VoltageSamples] = []
    async with asyncio.timeout(300):
        while len(found) < polls:  # on a busy computer all values of a poll may come too late
            found += [r for r in await sensor.poll_samples(TickClock(0.001)) if isinstance(r, VoltageSamples)]
    sensor.link.close()
    return np.concatenate([r.voltage_v for r in found])


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("order", ["big", "little"])
@pytest.mark.parametrize("on_a_line", [False, True])
async def test_value_of_every_type_is_read(kind: str, order: str, on_a_line: bool, tmp_path: Path) -> None:
    voltage = {"source": "modbus", "type": kind, "word_order": order, "scale": TYPES[kind], "period_s": 0.01}
    voltage |= {"offset": -300.0, "address": 7, "function": 3, "unit": 9}
    voltage |= {"device": str(tmp_path / "meter"), "baud_rate": 115200} if on_a_line else {}
    async with run_sensor_bench(voltage) as served:
        sensor = served.sensors()["voltage"]
        volts = await collect_voltages(sensor)
        assert volts.size
        np.testing.assert_allclose(volts, -12.34, atol=TYPES[kind] if kind[0] != "f" else 1e-4)


@pytest.mark.parametrize("kind", ["int16", "int32", "float32", "float64"])
@pytest.mark.parametrize("over_rtu", [False, True])
async def test_swapped_bytes_and_rtu_framing_are_supported(kind: str, over_rtu: bool) -> None:
    voltage = {"source": "modbus", "type": kind, "byte_order": "little", "scale": TYPES[kind], "period_s": 0.01}
    voltage |= {"framing": "rtu", "unit": 3} if over_rtu else {"word_order": "little"}
    async with run_sensor_bench(voltage) as served:
        sensor = served.sensors()["voltage"]
        assert type(sensor.link).__name__ == "ModbusUnit"
        np.testing.assert_allclose(await collect_voltages(sensor), -12.34, atol=TYPES[kind] if kind[0] != "f" else 1e-4)


@pytest.mark.parametrize(
    ("words", "keys"),
    [
        ([0x4841, 0], "byte_order = 'little'"),
        ([0, 0x4148], "word_order = 'little'"),
        ([0, 0x4841], "word_order = 'little' and byte_order = 'little'"),
    ],
)
async def test_plausible_value_in_another_byte_order_is_named(words: list[int], keys: str) -> None:
    async with run_sensor_peer() as peer:
        peer.served = words
        place = {"source": "modbus", "port": peer.port, "type": "float32", "timeout_s": PATIENCE_S}
        made = parse_config({"machine": {"name": "bench"}, "axis": {"X": bench_axis(corrected=False, voltage=place)}})
        sensor = create_sensors("X", made)["voltage"]
        await sensor.link.connect()
        with pytest.raises(ProtocolError, match=rf"register 0 gives .* \(with {keys} it would be 12\.5\); compare"):
            await sensor.poll_samples(TickClock(0.001))
        sensor.link.close()


def test_reserved_unit_number_is_used_with_a_remark() -> None:
    for place, remarks in (({"device": "/dev/ttyUSB0"}, 1), ({"port": 502, "framing": "rtu"}, 1), ({"port": 502}, 0)):
        voltage = {"source": "modbus", "type": "uint16", "unit": 248, "period_s": 0.5, **place}
        made = parse_config({"machine": {"name": "bench"}, "axis": {"X": bench_axis(corrected=False, voltage=voltage)}})
        reported = [
            text for text in find_unlikely_values(made) if "axis.X.voltage.unit = 248 is outside 1 to 247" in text
        ]
        assert len(reported) == remarks


async def test_float_at_register_0_needs_only_its_type(tmp_path: Path) -> None:
    for place in ({}, {"device": str(tmp_path / "meter")}):
        async with run_sensor_bench({"source": "modbus", "type": "float32", **place}) as served:
            sensor = served.sensors()["voltage"]
            await sensor.link.connect()
            assert await sensor.format_reading() == "-12.34 V at 50 Hz"
            sensor.link.close()


async def test_two_meters_and_a_thermometer_share_a_line(tmp_path: Path) -> None:
    line = {"source": "modbus", "device": str(tmp_path / "line"), "baud_rate": 115200, "type": "int16", "scale": 0.01}
    warmth = {"device": line["device"], "baud_rate": 115200, "unit": 3, "type": "int16", "scale": 0.1, "period_s": 0.02}
    async with run_sensor_bench({**line, "unit": 1}, {**line, "unit": 2}, temperature=warmth) as served:
        served.memory["Y"].feed_mean_voltage(45.6)
        found: list[Record] = []

        def take(record: Record) -> None:
            found.append(record)
            if isinstance(record, VoltageSamples | Temperature):
                received[getattr(record, "sensor", "thermometer " + record.axis)].set()

        sensors = [*served.sensors("X").values(), *served.sensors("Y").values()]
        received = {sensor.name: asyncio.Event() for sensor in sensors}
        sources = [SensorSource(sensor, TickClock(0.001)) for sensor in sensors]
        async with asyncio.timeout(300):
            tasks = [asyncio.create_task(source.run(take)) for source in sources]
            for sensor in sensors:
                await received[sensor.name].wait()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for source in sources:
            source.close()
    reported = {(r.axis, round(float(v), 6)) for r in found if isinstance(r, VoltageSamples) for v in r.voltage_v}
    assert reported == {("X", -12.34), ("Y", 45.6)}
    assert {round(r.celsius, 6) for r in found if isinstance(r, Temperature)} == {21.5}


async def test_values_are_on_a_grid_within_their_time_bounds() -> None:
    settings = {"source": "modbus", "type": "float64", "period_s": 0.01, "renewed_s": 0.004, "delay_s": 0.02}
    async with run_sensor_bench(settings) as served:
        sensor = served.sensors()["voltage"]
        await sensor.link.connect()
        before_ns = time.monotonic_ns()
        blocks: list[VoltageSamples] = []
        async with asyncio.timeout(300):
            while len(blocks) < 3:
                blocks += [r for r in await sensor.poll_samples(TickClock(0.001)) if isinstance(r, VoltageSamples)]
        after_ns = time.monotonic_ns()
        sensor.link.close()
    counter = np.concatenate([b.counter for b in blocks])
    due_ns = np.concatenate([b.t_ns for b in blocks]) + 0.022e9
    error_ns = np.concatenate([b.t_error_ns for b in blocks])
    assert {b.sample_rate_hz for b in blocks} == {100.0}
    assert (np.diff(counter) >= 1).all()
    assert counter[-1] - counter[0] + 1 <= counter.size + sensor.lost
    assert sensor.samples == counter.size
    assert (error_ns >= 0.002e9).all()
    assert before_ns - 2e6 <= due_ns[0] <= due_ns[-1] <= after_ns
    assert (np.abs(due_ns - counter * 1e7) < 0.5e7).all()  # each near its own instant


@pytest.mark.parametrize("query", ["READ?\n", ""])
async def test_free_running_text_instrument_is_read(query: str, tmp_path: Path) -> None:
    voltage = {"source": "serial", "device": str(tmp_path / "dmm"), "baud_rate": 115200, "parity": "none"}
    async with run_sensor_bench({**voltage, "query": query, "period_s": 0.01, "scale": 2.0}) as served:
        sensor = served.sensors()["voltage"]
        volts = await collect_voltages(sensor, 2)
        assert volts.size
        np.testing.assert_allclose(volts, -12.34, atol=2e-4)
        served.memory["X"].faults.silent = True
        served.document["axis"]["X"]["voltage"]["timeout_s"] = 0.5
        sensor = served.sensors()["voltage"]
        with pytest.raises(DeviceTimeout, match="check the instrument, the baud rate"):
            await collect_voltages(sensor, 3)
        sensor.link.close()


async def test_free_running_text_thermometer_is_read(tmp_path: Path) -> None:
    warmth = {
        "source": "serial",
        "device": str(tmp_path / "t"),
        "query": "T?\n",
        "period_s": 0.01,
        "pattern": r"\+([\d.]+)",
    }
    async with run_sensor_bench({"source": "drive"}, temperature=warmth) as served:
        sensor = served.sensors()["temperature"]
        await sensor.link.connect()
        assert [r.celsius for r in await sensor.poll_samples(TickClock(0.001)) if isinstance(r, Temperature)] == [21.5]
        assert await sensor.format_reading() == "21.50 degC"
        sensor.link.close()


BLOCK = {"samples": 20, "counter_address": 40}


@pytest.mark.fault("B9")
@pytest.mark.parametrize(
    "block",
    [
        {},
        {"counter_of": "oldest", "newest_first": True},
        {"count_address": 42, "counter_type": "uint16"},
        {"trigger_address": 43},
    ],
)
async def test_block_of_numbered_samples_is_read(block: dict[str, Any]) -> None:
    voltage = {"source": "modbus", "scale": 0.01, "block": BLOCK | block}
    async with run_sensor_bench(voltage) as served:
        for _ in range(65530):
            served.memory["X"].feed_mean_voltage(0.0)
        sensor = served.sensors()["voltage"]
        await sensor.link.connect()
        found: list[VoltageSamples] = []
        for step in range(4):
            for k in range(12):
                served.memory["X"].feed_mean_voltage(0.1 * (12 * step + k))
            found += [r for r in await sensor.poll_samples(TickClock(0.001)) if isinstance(r, VoltageSamples)]
        sensor.link.close()
    counter = np.concatenate([b.counter for b in found])
    np.testing.assert_array_equal(np.diff(counter), 1)
    assert sensor.lost == 0
    np.testing.assert_allclose(np.concatenate([b.voltage_v for b in found])[-48:], 0.1 * np.arange(48), atol=0.006)


@pytest.mark.parametrize(
    ("read_as", "says"),
    [
        (
            {"type": "float32", "word_order": "little"},
            r"\(with word_order = 'big' it would be -12\.34\); compare address",
        ),
        ({"type": "int32"}, "register 0 gives"),
        ({"type": "float32", "address": 1}, r"register 1 is refused \(illegal register address\)"),
    ],
)
async def test_wrong_type_or_word_order_is_reported_and_not_used(read_as: dict[str, Any], says: str) -> None:
    async with run_sensor_bench({"source": "modbus", "type": "float32"}) as served:
        config = served.config()
        voltage = config.axis["X"].voltage.model_copy(update=read_as)
        config.axis["X"].__dict__["voltage"] = voltage
        sensor = create_sensors("X", config)["voltage"]
        await sensor.link.connect()
        with pytest.raises(ProtocolError, match=says):
            await sensor.poll_samples(TickClock(0.001))
        sensor.link.close()


@pytest.mark.usefixtures("real_time")
async def test_sensor_polled_too_often_is_reported_once() -> None:
    async with run_sensor_bench({"source": "modbus", "type": "float32", "period_s": 0.002}) as served:
        served.memory["X"].faults.slow_s = 0.005
        sensor = served.sensors()["voltage"]
        await sensor.link.connect()
        notices: list[Notice] = []
        async with asyncio.timeout(300):
            while len(notices) < 1:
                notices += [r for r in await sensor.poll_samples(TickClock(0.001)) if isinstance(r, Notice)]
        notices += [r for _ in range(3) for r in await sensor.poll_samples(TickClock(0.001)) if isinstance(r, Notice)]
        sensor.link.close()
    assert [n.code for n in notices] == ["SampleTiming"]
    assert "set axis.X.voltage.period_s above 0.002" in notices[0].text
    assert sensor.lost > 0


async def test_invalid_numbers_are_refused() -> None:
    async with run_sensor_bench({"source": "modbus", "type": "float64"}) as served:
        sensor = served.sensors()["voltage"]
        await sensor.link.connect()
        for wrong in (math.nan, math.inf, -math.inf, 1e30):
            served.memory["X"].feed_mean_voltage(wrong)
            with pytest.raises(ProtocolError, match="register 0 gives"):
                await sensor.poll_samples(TickClock(0.001))
        sensor.link.close()


@pytest.mark.fault("B5")
async def test_replugged_adapter_is_used_again(tmp_path: Path) -> None:
    """Without a restart; the pause between attempts grows, and each change has one notice."""
    settings = {"source": "modbus", "type": "float32", "device": str(tmp_path / "meter")}
    found: asyncio.Queue[Record] = asyncio.Queue()

    async def until(code: str, severity: str) -> None:
        async with asyncio.timeout(300):
            while not (isinstance(r := await found.get(), Notice) and (r.code, r.severity) == (code, severity)):
                pass

    async with run_sensor_bench(settings) as served:
        source = SensorSource(served.sensors()["voltage"], TickClock(0.001))
        running = asyncio.create_task(source.run(found.put_nowait))
        async with asyncio.timeout(300):
            while not isinstance(await found.get(), VoltageSamples):
                pass
        served.wires.stop()
        await until("ModbusPortGone", "MAJOR")
        served.wires = SensorConnections(served.config(), served.memory)
        served.wires.start()
        await until("ModbusPortGone", "info")
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        source.close()
    assert source.read_counters()["failures"] >= 1


def assert_refused(**axes: dict[str, Any]) -> str:
    document = {name: bench_axis(corrected=False, voltage=voltage) for name, voltage in axes.items()}
    with pytest.raises(ConfigError) as caught:
        parse_config({"machine": {"name": "bench"}, "axis": document})
    return str(caught.value)


LINE = {"source": "modbus", "device": "/dev/ttyUSB0", "type": "float32"}


@pytest.mark.parametrize(
    ("axes", "says"),
    [
        ({"X": {"source": "serial"}}, "name the sensor's serial device"),
        ({"X": {**LINE, "unit": 0}}, "from 1 to 247"),
        ({"X": {**LINE, "baud_rate": 9601}}, "must be one of 1200"),
        ({"X": {**LINE, "scale": 0.0}}, "must not be 0"),
        ({"X": {**LINE, "pattern": "([0-9]+"}}, "not a regular expression"),
        ({"X": {**LINE, "pattern": "[0-9]+"}}, "must have one group"),
        ({"X": {**LINE, "type": "float16"}}, "float32"),
        ({"X": {**LINE, "block": {"counter_address": 300}}}, "the most that one request reads"),
        ({"X": LINE, "Y": {**LINE, "unit": 2, "parity": "none"}}, "axis.X.voltage sets the same device"),
        ({"X": LINE, "Y": {**LINE, "source": "serial"}}, "cannot share its device"),
        ({"X": {**LINE, "baud_rate": 9600}}, "of the time of /dev/ttyUSB0 at 9600 baud"),
    ],
)
def test_impossible_sensor_setting_is_refused_with_its_key(axes: dict[str, dict[str, Any]], says: str) -> None:
    assert says in assert_refused(**axes)


@pytest.mark.parametrize(
    ("given", "kind", "sampling"),
    [
        ({"source": "modbus"}, None, "interval_mean"),
        ({"source": "modbus", "address": 0}, "float32", "instant"),
        ({"source": "modbus", "type": "int16", "sampling": "interval_mean"}, "int16", "interval_mean"),
        ({"source": "modbus", "block": {}}, "int16", "interval_mean"),
        ({"source": "serial", "device": "/dev/ttyUSB0"}, None, "instant"),
        ({"source": "drive"}, None, "interval_mean"),
    ],
)
def test_missing_sensor_keys_are_derived(given: dict[str, Any], kind: str | None, sampling: str) -> None:
    voltage = Voltage.model_validate(given)
    assert (voltage.type, voltage.sampling) == (kind, sampling)


def collect_pieces() -> list[str]:
    page = Path(__file__).parents[2] / "docs" / "reference" / "instruments.md"
    return re.findall(r"^```toml\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("text", collect_pieces())
def test_text_instrument_fulfils_the_sensor_contract(text: str) -> None:
    axis = bench_axis(corrected=False) | tomllib.loads(text)["axis"]["X"]
    found = create_sensors("X", parse_config({"machine": {"name": "bench"}, "axis": {"X": axis}}))
    assert len(found) == 1


async def test_units_behind_one_gateway_share_its_connection() -> None:
    value = {"source": "modbus", "type": "float32"}
    with reserve_port() as port:
        async with run_sensor_bench(*({**value, "port": port, "unit": unit} for unit in (1, 2))) as served:
            served.memory["Y"].feed_mean_voltage(45.6)
            config = served.config()
            x, y = (create_sensors(axis, config)["voltage"] for axis in "XY")
            assert isinstance(x.link, ModbusUnit)
            assert isinstance(y.link, ModbusUnit)
            assert x.link.line is y.link.line
            for sensor in (x, y):
                await sensor.link.connect()
            assert [await x.format_reading(), await y.format_reading()] == ["-12.34 V at 50 Hz", "45.60 V at 50 Hz"]
            served.memory["X"].faults.silent = True
            x.link._timeout_s = 0.5
            with pytest.raises(DeviceTimeout):
                await x.format_reading()
            await y.link.connect()  # the connection was given up, for an answer that may still come
            assert await y.format_reading() == "45.60 V at 50 Hz"
            for sensor in (x, y):
                sensor.link.close()
