"""Against libmodbus in C, over TCP and a serial line: fdhil reads its units, its master reads the simulated ones."""

from __future__ import annotations

import asyncio
import os
import subprocess
import tty
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.config import MachineConfig
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.modbus.modbus_unit import ModbusUnit
from fdhil.drivers.sensor_source import create_sensors
from fdhil.errors import DeviceTimeout, ProtocolError
from fdhil.records import VoltageSamples
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.test_meters import run_sensor_bench

pytestmark = pytest.mark.debian
PATIENT = {"timeout_s": 60.0}  # another process answers
SOURCE = Path(__file__).with_name("libmodbus_peer.c")
READ_AS: tuple[dict[str, Any], ...] = (
    {"type": "float32"},
    {"address": 2, "word_order": "little", "function": 3},
    {"address": 4, "type": "int16", "scale": 0.01},
    {"address": 5, "type": "int32", "word_order": "little", "scale": 1e-4},
)


@pytest.fixture(scope="module")
def libmodbus_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile the peer."""
    made = tmp_path_factory.mktemp("libmodbus") / "peer"
    command = ["gcc", "-Wall", "-Werror", "-I/usr/include/modbus", str(SOURCE), "-o", str(made), "-lmodbus"]
    subprocess.run(command, check=True)
    return made


@contextmanager
def start_peer(program: Path, *arguments: str) -> Iterator[str]:
    """Run the peer and yield the line that it prints once it serves."""
    with subprocess.Popen([program, *arguments], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.kill()


class Cable:
    """A line with several programs: all others receive what one sends, as on RS-485."""

    def __init__(self, ends: int) -> None:
        self._pairs = [os.openpty() for _ in range(ends)]
        for _, far in self._pairs:
            tty.setraw(far)
        self.devices = [os.ttyname(far) for _, far in self._pairs]
        for near, _ in self._pairs:
            asyncio.get_running_loop().add_reader(near, self._pass_on, near)

    def _pass_on(self, near: int) -> None:
        data = os.read(near, 4096)
        for other, _ in self._pairs:
            if other != near:
                os.write(other, data)

    def cut(self) -> None:
        for near, far in self._pairs:
            asyncio.get_running_loop().remove_reader(near)
            os.close(near)
            os.close(far)


@asynccontextmanager
async def run_units_on_a_line(program: Path, **volts: float) -> AsyncIterator[str]:
    """Connect a unit for each of ``u1 = volts`` to one line and yield the device at its other end."""
    cable = Cable(1 + len(volts))
    with ExitStack() as units:
        for device, (name, value) in zip(cable.devices[1:], volts.items(), strict=True):
            assert units.enter_context(start_peer(program, "rtu-unit", device, name[1:], str(value))) == "ready"
        yield cable.devices[0]
    cable.cut()


async def read_registers(config: MachineConfig) -> list[float]:
    sensor = create_sensors("X", config)["voltage"]
    await sensor.link.connect()
    volts: list[float] = []
    for _ in range(20):  # what a busy host asks too slowly has no place in time
        records = await sensor.poll_samples(TickClock(0.001))
        volts = [float(v) for r in records if isinstance(r, VoltageSamples) for v in r.voltage_v]
        if volts:
            break
    sensor.link.close()
    return volts


@pytest.mark.parametrize("read_as", READ_AS, ids=lambda keys: keys.get("type", "little"))
async def test_libmodbus_units_are_read_over_tcp(libmodbus_program: Path, read_as: dict[str, Any]) -> None:
    with start_peer(libmodbus_program, "tcp-unit") as port:
        volts = await read_registers(
            build_machine_config(voltage={"source": "modbus", "port": int(port), **PATIENT, **read_as})
        )
    assert volts
    np.testing.assert_allclose(volts, -12.34, atol=0.011)


@pytest.mark.parametrize("read_as", READ_AS, ids=lambda keys: keys.get("type", "little"))
async def test_libmodbus_units_are_read_on_a_serial_line(libmodbus_program: Path, read_as: dict[str, Any]) -> None:
    async with run_units_on_a_line(libmodbus_program, u7=-12.34) as device:
        line = {"source": "modbus", "device": device, "parity": "none", "baud_rate": 115200, "unit": 7}
        volts = await read_registers(build_machine_config(voltage={**line, **PATIENT, **read_as}))
    assert volts
    np.testing.assert_allclose(volts, -12.34, atol=0.011)


async def test_two_libmodbus_units_share_a_line(libmodbus_program: Path) -> None:
    async with run_units_on_a_line(libmodbus_program, u1=10.0, u2=-20.0) as device:
        line = {"source": "modbus", "type": "float32", "device": device, "parity": "none", "baud_rate": 115200}
        asked_twice = {"timeout_s": 10.0}  # libmodbus takes what follows an unanswered request for its answer
        units = ({"unit": 1, **asked_twice}, {"unit": 2, **asked_twice}, {"unit": 3})  # nobody is unit 3
        settings = [build_machine_config(voltage={**line, **unit}).axis["X"].voltage for unit in units]
        links = [ModbusUnit(f"unit {place.unit}", place) for place in settings]
        for link in links:
            await link.connect()
        for _ in range(3):
            both = await asyncio.gather(*(link.read_input_registers(0, 2) for link in links[:2]))
            assert both == [[0x4120, 0], [0xC1A0, 0]]
        with pytest.raises(ProtocolError, match="illegal register address"):
            await links[0].read_input_registers(100, 2)
        with pytest.raises(DeviceTimeout):
            await links[2].read_input_registers(0, 2)
        await links[1].write_register(7, 99)
        assert await links[1].read_registers(3, 7, 1) == [99]
        for link in links:
            link.close()


async def test_libmodbus_master_reads_the_simulated_sensors(libmodbus_program: Path, tmp_path: Path) -> None:
    value = {"source": "modbus", "type": "float32"}
    on_a_line = {**value, "device": str(tmp_path / "meter"), "unit": 9, "baud_rate": 115200}
    async with run_sensor_bench(value, on_a_line) as served:
        port = str(served.wires.ready["X"]["port"])
        for arguments in (("tcp-master", "127.0.0.1", port, "0"), ("rtu-master", str(tmp_path / "meter"), "9", "0")):
            master = await asyncio.create_subprocess_exec(libmodbus_program, *arguments, stdout=subprocess.PIPE)
            message, _ = await master.communicate()
            assert message == b"-12.3400\n"
