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
from tests.sim.bench_twin import TwinInHand, smooth

COB_ID = 0x2A0


def node(**keys: Any) -> EncoderNode:
    return EncoderNode(TableEncoder(**{"cob_id": COB_ID, "scale": 1e-4} | keys), 0.0, np.random.default_rng(1))


def test_the_encoder_sends_its_place_after_a_sync_where_the_configuration_has_it() -> None:
    assert node(byte=2, offset=1.0).at_sync(1.5) == [(COB_ID, b"\0\0" + struct.pack("<i", 5000))]
    assert node(byte=2).frame_bytes == 6
    assert node(type="uint16").at_sync(-1e-4) == [(COB_ID, b"\xff\xff")]  # the counter wraps around


def test_the_encoder_obeys_nmt_and_beats() -> None:
    encoder = node()
    assert encoder.power_on() == [(0x720, b"\0")]
    assert encoder.receive(0, bytes([0x80, 0x21])) == []
    assert encoder.at_sync(0.0)
    encoder.receive(0, bytes([0x80, 0x20]))
    assert encoder.at_sync(0.0) == []
    assert encoder.wall_clock(5.0) == [(0x720, b"\x7f")]
    assert encoder.wall_clock(5.5) == []
    encoder.receive(0, bytes([0x01, 0]))
    assert encoder.at_sync(0.0)
    assert encoder.receive(0, bytes([0x81, 0])) == [(0x720, b"\0")]


def sampled(speeds_m_s: np.ndarray[Any, Any], **keys: Any) -> tuple[list[int], np.ndarray[Any, Any]]:
    """Return counts and accelerations (m/s2) of the lines for these table speeds at the SYNCs."""
    settings = Accelerometer(**{"device": "/dev/none", "scale": 1e-3, "rate_hz": 800.0} | keys)
    sensor = TableAccelerometer(settings, 1e-3, 0.0, np.random.default_rng(1))
    text = b""
    for speed in speeds_m_s.tolist():
        sensor.at_sync(speed)
        text += sensor.take()
    rows = [line.split(",") for line in text.decode().splitlines()]
    return [int(row[0]) for row in rows], np.array([float(row[1]) for row in rows]) * settings.scale - TILT_M_S2


def test_the_accelerometer_samples_by_its_own_oscillator() -> None:
    counts, values = sampled(4.0 * 1e-3 * np.arange(2001))  # 4 m/s2
    assert counts == list(range(1, len(counts) + 1))
    assert len(counts) == pytest.approx(1600 * OFF_RATE, abs=2)
    assert np.abs(values[2:] - 4.0).max() < 2e-3


def test_a_quick_one_and_one_that_looks_the_other_way() -> None:
    counts, values = sampled(-2.0 * 1e-3 * np.arange(501), rate_hz=3200.0, scale=-1e-3)
    assert len(counts) == pytest.approx(1600 * OFF_RATE, abs=4)
    assert np.abs(values[8:] + 2.0 + 0.0).max() < 2e-3


def twin(tmp_path: Path) -> MachineConfig:
    document = bench_document("X")
    document["axis"]["X"] |= {
        "table": {"cob_id": COB_ID, "scale": 1e-5},
        "accelerometer": {"device": str(tmp_path / "sensor"), "scale": 1e-3},
    }
    quiet = {"voltage_v": 0.0, "current_a": 0.0, "speed_rad_s": 0.0, "table_um": 0.0, "table_m_s2": 0.0}
    reality = {"resonance_hz": 60.0, "position_encoder": "motor"}
    document["sim"] = {"noise": quiet, "modbus": False, "axis": {"X": {"reality": reality}}}
    return machine_config.parse_config(document)


def test_both_see_the_table_and_not_the_motor(tmp_path: Path) -> None:
    hand = TwinInHand(twin(tmp_path))
    hand.switch_on()
    begun = len(hand.wire)
    hand.play(smooth((np.minimum(np.arange(900) * 0.2, 60.0))[:, None], (30, 15)), axes="X")
    hand.run_until("finished")
    sent = [struct.unpack("<i", data)[0] * 1e-5 for can_id, data in hand.wire[begun:] if can_id == COB_ID]
    drive = hand.machine.units["X"].drive
    assert sent[-1] == pytest.approx(drive.table_mm, abs=2e-5)
    lines = hand.machine.tables.accelerometers["X"].take().decode().splitlines()
    pushed = np.array([float(line.split(",")[1]) for line in lines]) * 1e-3 - TILT_M_S2
    told = np.gradient(np.gradient(np.array(sent), 1e-3), 1e-3) * 1e-3
    assert np.abs(pushed).max() == pytest.approx(np.abs(told).max(), rel=0.15)
    assert np.abs(pushed).max() > 2.0


def test_it_streams_on_where_no_sync_comes(tmp_path: Path) -> None:
    hand = TwinInHand(twin(tmp_path))
    sensor = hand.machine.tables.accelerometers["X"]
    for k in range(251):
        hand.machine.wall_clock(0.004 * k)
    lines = sensor.take().decode().splitlines()
    assert len(lines) == pytest.approx(800, abs=60)


def test_a_stream_is_a_device_that_goes_with_the_simulator(tmp_path: Path) -> None:
    device = tmp_path / "sensor"
    port = StreamPort("accelerometer X", str(device))
    reader = os.open(device, os.O_RDONLY | os.O_NOCTTY)
    port.send(b"1,2\n3,4\n")
    heard = b""
    while len(heard) < 8:  # a terminal hands over what has come, in as many parts as it likes
        heard += os.read(reader, 100)
    assert heard == b"1,2\n3,4\n"
    port.send(b"x" * 60 + b"\n")
    os.close(reader)
    for _ in range(200):  # without a reader, excess data is lost
        port.send(b"0123456789\n" * 20)
    port.close()
    assert not device.is_symlink()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConnectError, match="already exists"):
        StreamPort("accelerometer X", str(tmp_path / "file"))
