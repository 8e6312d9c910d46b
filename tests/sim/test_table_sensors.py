"""The simulated table sensors: an encoder node on the bus, a streaming accelerometer, a Modbus module."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.config import Accelerometer, MachineConfig, TableEncoder
from fdhil.errors import ConnectError
from fdhil.sim.table_sensors import OFF_RATE, TILT_M_S2, EncoderNode, TableAccelerometer
from fdhil.sim.wire.stream_port import StreamPort
from tests.bench import bench_document
from tests.sim.bench_simulator import SteppedSimulator, smooth_rows

COB_ID = 0x2A0


def create_node(**keys: Any) -> EncoderNode:
    return EncoderNode(TableEncoder(**{"cob_id": COB_ID, "scale": 1e-4} | keys), 0.0, np.random.default_rng(1))


def test_encoder_sends_position_after_sync_at_configured_byte() -> None:
    assert create_node(byte=2, offset=1.0).send_position(1.5) == [(COB_ID, b"\0\0" + struct.pack("<i", 5000))]
    assert create_node(byte=2).frame_bytes == 6
    assert create_node(type="uint16").send_position(-1e-4) == [(COB_ID, b"\xff\xff")]  # the counter wraps around


def test_encoder_executes_nmt_and_sends_heartbeat() -> None:
    encoder = create_node()
    assert encoder.power_on() == [(0x720, b"\0")]
    assert encoder.receive_frame(0, bytes([0x80, 0x21])) == []
    assert encoder.send_position(0.0)
    encoder.receive_frame(0, bytes([0x80, 0x20]))
    assert encoder.send_position(0.0) == []
    assert encoder.run_timers(5.0) == [(0x720, b"\x7f")]
    assert encoder.run_timers(5.5) == []
    encoder.receive_frame(0, bytes([0x01, 0]))
    assert encoder.send_position(0.0)
    assert encoder.receive_frame(0, bytes([0x81, 0])) == [(0x720, b"\0")]


def sample_lines(speeds_m_s: np.ndarray[Any, Any], **keys: Any) -> tuple[list[int], np.ndarray[Any, Any]]:
    """Return counts and accelerations (m/s2) of the lines for these table speeds at the SYNCs."""
    settings = Accelerometer(**{"device": "/dev/none", "scale": 1e-3, "rate_hz": 800.0} | keys)
    sensor = TableAccelerometer(settings, 1e-3, 0.0, np.random.default_rng(1))
    text = b""
    for speed in speeds_m_s.tolist():
        sensor.integrate_speed(speed)
        text += sensor.take_lines()
    rows = [line.split(",") for line in text.decode().splitlines()]
    return [int(row[0]) for row in rows], np.array([float(row[1]) for row in rows]) * settings.scale - TILT_M_S2


def test_accelerometer_samples_with_own_oscillator() -> None:
    counts, values = sample_lines(4.0 * 1e-3 * np.arange(2001))  # 4 m/s2
    assert counts == list(range(1, len(counts) + 1))
    assert len(counts) == pytest.approx(1600 * OFF_RATE, abs=2)
    assert np.abs(values[2:] - 4.0).max() < 2e-3


def test_fast_and_reversed_accelerometers_are_read() -> None:
    counts, values = sample_lines(-2.0 * 1e-3 * np.arange(501), rate_hz=3200.0, scale=-1e-3)
    assert len(counts) == pytest.approx(1600 * OFF_RATE, abs=4)
    assert np.abs(values[8:] + 2.0 + 0.0).max() < 2e-3


def create_machine(tmp_path: Path) -> MachineConfig:
    document = bench_document("X")
    document["axis"]["X"] |= {
        "table": {"cob_id": COB_ID, "scale": 1e-5},
        "accelerometer": {"device": str(tmp_path / "sensor"), "scale": 1e-3},
    }
    quiet = {"voltage_v": 0.0, "current_a": 0.0, "speed_rad_s": 0.0, "table_um": 0.0, "table_m_s2": 0.0}
    reality = {"resonance_hz": 60.0, "position_encoder": "motor"}
    document["sim"] = {"noise": quiet, "modbus": False, "axis": {"X": {"reality": reality}}}
    return machine_config.parse_config(document)


def test_table_sensors_measure_table_not_motor(tmp_path: Path) -> None:
    hand = SteppedSimulator(create_machine(tmp_path))
    hand.switch_on()
    begun = len(hand.wire)
    hand.play_rows(smooth_rows((np.minimum(np.arange(900) * 0.2, 60.0))[:, None], (30, 15)), axes="X")
    hand.run_until("finished")
    sent = [struct.unpack("<i", data)[0] * 1e-5 for can_id, data in hand.wire[begun:] if can_id == COB_ID]
    drive = hand.machine.units["X"].drive
    assert sent[-1] == pytest.approx(drive.table_mm, abs=2e-5)
    lines = hand.machine.tables.accelerometers["X"].take_lines().decode().splitlines()
    pushed = np.array([float(line.split(",")[1]) for line in lines]) * 1e-3 - TILT_M_S2
    reported = np.gradient(np.gradient(np.array(sent), 1e-3), 1e-3) * 1e-3
    assert np.abs(pushed).max() == pytest.approx(np.abs(reported).max(), rel=0.15)
    assert np.abs(pushed).max() > 2.0


def test_accelerometer_streams_without_sync(tmp_path: Path) -> None:
    hand = SteppedSimulator(create_machine(tmp_path))
    sensor = hand.machine.tables.accelerometers["X"]
    for k in range(251):
        hand.machine.run_timers(0.004 * k)
    lines = sensor.take_lines().decode().splitlines()
    assert len(lines) == pytest.approx(800, abs=60)


def test_stream_device_is_removed_with_simulator(tmp_path: Path) -> None:
    device = tmp_path / "sensor"
    port = StreamPort("accelerometer X", str(device))
    reader = os.open(device, os.O_RDONLY | os.O_NOCTTY)
    port.send_lines(b"1,2\n3,4\n")
    received = b""
    while len(received) < 8:  # a terminal hands over what has come, in as many parts as it likes
        received += os.read(reader, 100)
    assert received == b"1,2\n3,4\n"
    port.send_lines(b"x" * 60 + b"\n")
    os.close(reader)
    for _ in range(200):  # without a reader, excess data is lost
        port.send_lines(b"0123456789\n" * 20)
    port.close()
    assert not device.is_symlink()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConnectError, match="already exists"):
        StreamPort("accelerometer X", str(tmp_path / "file"))
