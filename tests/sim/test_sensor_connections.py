"""The simulated sensors on serial lines, read by pymodbus, and their description by the simulator."""

from __future__ import annotations

import os
import queue
import threading
from pathlib import Path
from typing import Any

import pytest
from pymodbus.client import ModbusSerialClient

from fdhil.cli.sim_command import _format_ready_event
from fdhil.config import parse_config
from fdhil.errors import ConnectError
from fdhil.sim.simulator_service import SimulatorService
from fdhil.sim.wire.register_maps import pack_registers
from fdhil.sim.wire.serial_lines import RtuUnits, SerialLines
from tests.bench import bench_document


def build_document(folder: Path) -> dict[str, Any]:
    """Return a configuration with X and Y as units of one line, with a thermometer each; no NC."""
    made = bench_document()
    made["bus"] = {"can0": {"interface": "virtual", "channel": "wires"}}
    line = {"device": str(folder / "line"), "baud_rate": 115200, "parity": "none"}
    for unit, axis in enumerate("XY", 1):
        made["axis"][axis]["voltage"] = {**line, "source": "modbus", "unit": unit, "type": "int16", "scale": 0.01}
    made["axis"]["X"]["temperature"] = {**line, "unit": 1, "address": 2, "type": "int16", "scale": 0.1}
    return made


def test_units_on_one_line_are_served_and_described(tmp_path: Path) -> None:
    events: queue.Queue[dict[str, Any]] = queue.Queue()
    service = SimulatorService(
        parse_config(build_document(tmp_path), folder=tmp_path), events.put, lambda *_: pytest.fail("no file")
    )
    running = threading.Thread(target=service.run)
    running.start()
    try:
        ready = events.get(timeout=120)
        where = str(tmp_path / "line")
        assert ready["modbus"] == {"X": {"device": where, "unit": 1}, "Y": {"device": where, "unit": 2}}
        assert f"  voltage sensor Y: serial line {where}" in _format_ready_event(ready)
        with ModbusSerialClient(where, baudrate=115200, timeout=60, retries=0) as master:
            both = [master.read_input_registers(0, count=1, device_id=unit).registers for unit in (1, 2)]
            assert all(abs(value - (value >> 15 << 16)) < 1000 for (value,) in both)
            assert master.read_holding_registers(2, count=1, device_id=1).registers == [200]  # 20 degC
            assert master.read_input_registers(1, count=1, device_id=1).exception_code == 2
            assert master.write_register(0, 1, device_id=1).exception_code == 2
    finally:
        service.stop()
        running.join()
    assert not os.path.lexists(tmp_path / "line")


def test_existing_device_is_not_replaced(tmp_path: Path) -> None:
    there = tmp_path / "ttyUSB0"
    there.write_text("a real one")
    with pytest.raises(ConnectError, match="choose an unused name"):
        SerialLines({str(there): RtuUnits()}).start()
    assert there.read_text() == "a real one"


def test_device_of_killed_simulator_is_recreated(tmp_path: Path) -> None:
    there = tmp_path / "line"
    there.symlink_to("/dev/pts/fdhil-none")
    lines = SerialLines({str(there): RtuUnits()})
    lines.start()
    assert there.exists()
    lines.stop()


@pytest.mark.parametrize(
    ("value", "kind", "order", "words"),
    [
        (-1.0, "int16", "big", [0xFFFF]),
        (40000.0, "int16", "big", [0x7FFF]),
        (-5.0, "uint16", "big", [0]),
        (65538.0, "int32", "little", [2, 1]),
        (50.0, "float32", "big", [0x4248, 0]),
        (50.0, "float64", "little", [0, 0, 0, 0x4049]),
    ],
)
def test_numbers_are_packed_into_registers(value: float, kind: str, order: str, words: list[int]) -> None:
    assert pack_registers(value, kind, order) == words
