"""The contract of every listed voltage source; listing a source makes these tests run on it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.cia402.drive_profile_file import load_profile
from fdhil.drivers.cia402.pdo_decoder import VoltageObject
from fdhil.drivers.machine_source import MachineSource
from fdhil.drivers.modbus.sampled_voltage import ModbusVoltage
from fdhil.drivers.sensor_source import create_sensors
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import VoltageSamples
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.modbus_peer import SensorPeer, run_sensor_peer
from tests.drivers.serial_peer import SerialPeer
from tests.reserved_port import reserve_port

TEXT = {"serial"}
SEPARATE = [name for name in tables.VOLTAGE_SOURCES if name != tables.DRIVE_VOLTAGE]


def build_config(name: str, port: int = 1, device: str = "/dev/fdhil-none") -> MachineConfig:
    where = {"device": device, "parity": "none"} if name in TEXT else {"port": port}
    return build_machine_config(voltage={"source": name, "timeout_s": 60.0, **where})


@asynccontextmanager
async def create_peer(name: str) -> AsyncIterator[tuple[SensorPeer | None, MachineConfig]]:
    """Serve a sensor for the source: its class's example, the default registers, or lines of text."""
    if name in TEXT:
        line = TextInstrumentPeer()
        try:
            yield None, build_config(name, device=line.device)
        finally:
            line.unplug()
        return
    async with run_sensor_peer() as peer:
        peer.served = getattr(tables.load_entry(tables.VOLTAGE_SOURCES, name), "example_registers", ())
        yield peer, build_config(name, peer.port)


class TextInstrumentPeer(SerialPeer):
    """Sends a line every 20 ms."""

    def __init__(self) -> None:
        super().__init__()
        self._task = asyncio.create_task(self._send_lines())

    async def _send_lines(self) -> None:
        due_s = time.monotonic()
        while True:  # by its own clock: late ones come together
            self.send_bytes(b"U = +12.5 V\r\n")
            due_s += 0.02
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))

    def unplug(self) -> None:
        """Also stop sending."""
        self._task.cancel()
        super().unplug()


@pytest.mark.parametrize("name", tables.VOLTAGE_SOURCES)
def test_voltage_has_exactly_one_source(name: str) -> None:
    """``drive`` is an object in a TPDO; every other source is a sensor of its own that the machine polls."""
    config = build_config(name)
    profile = load_profile(config.axis["X"].drive)
    source = tables.load_entry(tables.VOLTAGE_SOURCES, name)("X", config)
    separate = name in SEPARATE
    assert config.axis["X"].voltage.is_separate == separate
    assert list(create_sensors("X", config)) == ["voltage"] * separate
    assert any(key.endswith(".X.samples") for key in MachineSource(config).get_counters()) == separate
    assert VoltageObject("X", config).key == (None if separate else profile.voltage)
    if not separate:
        assert (source.key, source.v_per_count) == (profile.voltage, profile.voltage_v_per_count)


@pytest.mark.parametrize("name", SEPARATE)
async def test_a_sensor_is_polled_and_read(name: str) -> None:
    """Its values are finite, in order and counted; a reading for display takes no sample from the daemon."""
    async with create_peer(name) as (peer, config):
        sensor = create_sensors("X", config)["voltage"]
        await sensor.link.connect()
        before = sensor.samples
        shown = await sensor.format_reading()
        volts, _, rate = shown.partition(" V at ")
        assert np.isfinite([float(volts), float(rate.removesuffix(" Hz"))]).all()
        assert sensor.samples == before  # a reading takes nothing from a daemon that polls
        records = [record for _ in range(3) for record in await sensor.poll_samples(TickClock(0.001))]
        blocks = [record for record in records if isinstance(record, VoltageSamples)]
        assert blocks
        counter = np.concatenate([block.counter for block in blocks])
        if peer is not None and peer.served and isinstance(sensor, ModbusVoltage):
            assert counter[-1] == (await sensor.read_block()).newest
        sensor.link.close()
    assert all(np.isfinite(block.voltage_v).all() for block in blocks)
    assert (np.diff(counter) > 0).all()  # no sample comes twice
    assert {(block.axis, block.sensor) for block in blocks} == {("X", sensor.name)}
    assert sensor.samples == sum(block.voltage_v.size for block in blocks)
    assert sensor.lost == (np.diff(counter) - 1).sum()  # what a host that is held up misses is a hole in the count
    assert not sensor.link.is_connected


@pytest.mark.parametrize("name", SEPARATE)
async def test_missing_sensor_is_reported_with_its_address(name: str) -> None:
    with reserve_port() as port:
        config = build_config(name, port)
        where = config.axis["X"].voltage
        sensor = create_sensors("X", config)["voltage"]
        assert sensor.axis == "X"
        assert (where.device or str(where.port)) in sensor.link.place
        with pytest.raises(ConnectError, match=sensor.name):
            await sensor.link.connect()


@pytest.mark.parametrize("name", SEPARATE)
@pytest.mark.parametrize("error", [ConnectError, DeviceTimeout, ProtocolError, DeviceError])
def test_every_error_has_its_notice_code(name: str, error: type[DeviceError]) -> None:
    assert create_sensors("X", build_config(name))["voltage"].link.classify_fault(
        error("voltage sensor X", "a fault; advice")
    )
