"""The thermometer: a float32 in two registers, from a sensor that can fail in every way."""

from __future__ import annotations

import pytest

from fdhil.config import Thermometer
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.thermometer import SlidewayThermometer
from fdhil.errors import DeviceTimeout, ProtocolError
from fdhil.records import Temperature
from tests.drivers.modbus_peer import run_sensor_peer


def create_thermometer(port: int, address: int = 8, timeout_s: float = 60.0) -> SlidewayThermometer:
    return SlidewayThermometer("X", Thermometer(port=port, address=address, period_s=0.01, timeout_s=timeout_s))


async def test_thermometer_reads_degrees() -> None:
    async with run_sensor_peer() as peer:
        sensor = create_thermometer(peer.port)
        await sensor.link.connect()
        records = await sensor.poll_samples(TickClock(0.001))
        sensor.link.close()
    assert [(r.axis, r.celsius, r.place) for r in records] == [("X", 21.5, "slideway")]
    assert isinstance(records[0], Temperature)
    assert sensor.samples == 1


async def test_implausible_temperature_is_reported() -> None:
    async with run_sensor_peer() as peer:
        sensor = create_thermometer(peer.port, address=4)  # the sample rate: 1000
        await sensor.link.connect()
        with pytest.raises(ProtocolError, match=r"register 4 gives 1000 degC .*; compare .* with its register map"):
            await sensor.poll_samples(TickClock(0.001))
        sensor.link.close()


async def test_silent_thermometer_times_out() -> None:
    async with run_sensor_peer() as peer:
        sensor = create_thermometer(peer.port, timeout_s=0.2)
        await sensor.link.connect()
        peer.mode = "silent"
        with pytest.raises(DeviceTimeout):
            await sensor.poll_samples(TickClock(0.001))
        sensor.link.close()
