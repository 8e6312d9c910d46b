"""What every listed voltage source must do; being listed is being tested."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.cia402.drive import VoltageObject
from fdhil.drivers.cia402.profile_file import load_profile
from fdhil.drivers.machine import MachineSource
from fdhil.drivers.modbus.voltage import ModbusVoltage
from fdhil.drivers.sensor_source import sensors_of
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import VoltageSamples
from tests.drivers.modbus_peer import sensor_peer
from tests.drivers.wire import machine

SEPARATE = [name for name in tables.VOLTAGE_SOURCES if name != tables.DRIVE_VOLTAGE]


def config_of(name: str, port: int = 1) -> MachineConfig:
    return machine(voltage={"source": name, "port": port, "timeout_s": 0.2})


@pytest.mark.parametrize("name", tables.VOLTAGE_SOURCES)
def test_the_voltage_comes_from_one_place_alone(name: str) -> None:
    """``drive`` is an object in a TPDO; every other is a sensor of its own, which the machine reaches and polls."""
    config = config_of(name)
    profile = load_profile(config.axis["X"].drive)
    source = tables.load(tables.VOLTAGE_SOURCES, name)("X", config)
    separate = name in SEPARATE
    assert config.axis["X"].voltage.separate == separate
    assert list(sensors_of("X", config)) == ["voltage"] * separate
    assert any(key.endswith(".X.samples") for key in MachineSource(config).counters()) == separate
    assert VoltageObject("X", config).key == (None if separate else profile.voltage)
    if not separate:
        assert (source.key, source.v_per_count) == (profile.voltage, profile.voltage_v_per_count)


@pytest.mark.parametrize("name", SEPARATE)
async def test_a_sensor_is_polled_and_read(name: str) -> None:
    """The peer serves what the sensor's class names as an example; to the map of ``modbus`` it samples as time goes."""
    factory = tables.load(tables.VOLTAGE_SOURCES, name)
    assert factory is ModbusVoltage or factory.example_registers
    async with sensor_peer() as peer:
        peer.served = factory.example_registers
        sensor = sensors_of("X", config_of(name, peer.port))["voltage"]
        await sensor.link.connect()
        before = sensor.samples
        shown = await sensor.reading()
        volts, _, rate = shown.partition(" V at ")
        assert np.isfinite([float(volts), float(rate.removesuffix(" Hz"))]).all()
        assert sensor.samples == before  # a reading takes nothing from a daemon that polls
        records = [record for _ in range(3) for record in await sensor.poll(TickClock(0.001))]
        blocks = [record for record in records if isinstance(record, VoltageSamples)]
        assert blocks
        counter = np.concatenate([block.counter for block in blocks])
        if peer.served and isinstance(sensor, ModbusVoltage):
            assert counter[-1] == (await sensor.block()).newest
        sensor.link.close()
    assert all(np.isfinite(block.voltage_v).all() for block in blocks)
    assert (np.diff(counter) > 0).all()  # no sample comes twice
    assert {(block.axis, block.sensor) for block in blocks} == {("X", sensor.name)}
    assert sensor.samples == sum(block.voltage_v.size for block in blocks)
    assert sensor.lost == 0
    assert not sensor.link.connected


@pytest.mark.parametrize("name", SEPARATE)
async def test_a_sensor_that_is_not_there_is_told_with_its_place(name: str) -> None:
    async with sensor_peer() as peer:
        port = peer.port
    sensor = sensors_of("X", config_of(name, port))["voltage"]
    assert sensor.axis == "X"
    assert str(port) in sensor.link.place
    with pytest.raises(ConnectError, match=sensor.name):
        await sensor.link.connect()


@pytest.mark.parametrize("name", SEPARATE)
@pytest.mark.parametrize("error", [ConnectError, DeviceTimeout, ProtocolError, DeviceError])
def test_every_error_has_its_class(name: str, error: type[DeviceError]) -> None:
    assert sensors_of("X", config_of(name))["voltage"].link.fault_code(error("voltage sensor X", "a fault; advice"))
