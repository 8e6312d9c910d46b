"""Sensors at the table: a value of a TPDO, a stream of lines on the SYNC count, a Modbus device that is read."""

from __future__ import annotations

import asyncio
import os
import struct
import tty
from pathlib import Path

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.config import Accelerometer, TableEncoder
from fdhil.drivers.can.sync_grid import TickedFrames
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.serial.text_lines import TextLine
from fdhil.drivers.table.accelerometer import StreamedAccelerometer
from fdhil.drivers.table.arrival_clock import ArrivalClock
from fdhil.drivers.table.modbus_encoder import ModbusEncoder
from fdhil.drivers.table.tpdo_encoder import SILENT_TICKS, TpdoEncoder
from fdhil.errors import ConnectError, DeviceTimeout, ProtocolError
from fdhil.records import Notice, TableSamples, TickTimes, freeze_integers
from fdhil.sim.wire.modbus_sensor import VoltageSensor
from fdhil.sim.wire.sensor_connections import SensorConnections
from tests.bench import bench_document
from tests.drivers.modbus_peer import run_sensor_peer

MS = 1_000_000


def build_ticked_frames(frames: list[tuple[int, int, bytes]], last_tick: int = 0) -> TickedFrames:
    """Return frames (tick, id, data) as the grid hands them over."""
    data = [int.from_bytes(one.ljust(8, b"\0"), "little") for _, _, one in frames]
    return TickedFrames(
        np.array([can_id for _, can_id, _ in frames], np.uint32),
        np.array([len(one) for _, _, one in frames], np.uint8),
        np.array(data, np.uint64),
        np.array([tick for tick, _, _ in frames], np.int64),
        TickTimes(freeze_integers([]), freeze_integers([])),
        max([last_tick, *(tick for tick, _, _ in frames)]),
    )


def build_tick_clock(ticks: int = 4000) -> TickClock:
    """Return a SYNC count whose tick k came at k ms."""
    found = TickClock(1e-3)
    found.add_arrivals(TickTimes(freeze_integers(np.arange(ticks)), freeze_integers(np.arange(ticks) * MS)))
    return found


def test_position_in_a_tpdo_has_the_tick_of_its_sync() -> None:
    encoder = TpdoEncoder("X", TableEncoder(cob_id=0x2A0, byte=2, scale=-1e-4, offset=10.0))
    frames = [(k, 0x2A0, b"\xff\xff" + struct.pack("<i", -1000 - k)) for k in range(5)]
    frames.insert(2, (1, 0x181, bytes(8)))
    (samples,) = encoder.decode_frames(build_ticked_frames(frames))
    assert isinstance(samples, TableSamples)
    assert (samples.axis, samples.signal, samples.tick_error) == ("X", "table_mm", 0.0)
    assert samples.tick.tolist() == [0, 1, 2, 3, 4]
    assert samples.values.tolist() == pytest.approx([10.1 + 1e-4 * k for k in range(5)])


def test_ambiguous_and_short_frames_are_not_used() -> None:
    encoder = TpdoEncoder("X", TableEncoder(cob_id=0x2A0, type="int16"))
    frames = [(0, 0x2A0, b"\1\0"), (1, 0x2A0, b"\2\0"), (1, 0x2A0, b"\3\0"), (2, 0x2A0, b"\4")]
    (samples,) = encoder.decode_frames(build_ticked_frames(frames))
    assert isinstance(samples, TableSamples)
    assert samples.tick.tolist() == [0]
    assert encoder.short == 1


def test_silent_encoder_and_its_return_are_reported_once() -> None:
    encoder = TpdoEncoder("X", TableEncoder(cob_id=0x2A0))
    assert encoder.decode_frames(build_ticked_frames([], 10)) == []
    (notice,) = encoder.decode_frames(build_ticked_frames([], 11 + SILENT_TICKS))
    assert isinstance(notice, Notice)
    assert notice.code == "TableSilent"
    assert "0x2a0" in notice.text
    assert encoder.decode_frames(build_ticked_frames([], 500 + SILENT_TICKS)) == []
    back = encoder.decode_frames(build_ticked_frames([(600 + SILENT_TICKS, 0x2A0, bytes(4))]))
    assert [type(one) for one in back] == [TableSamples, Notice]


@pytest.mark.parametrize("off_rate", [1.0, 1.03, 0.98])
def test_arrivals_are_placed_by_the_earliest_at_the_true_rate(off_rate: float) -> None:
    rng = np.random.default_rng(1)
    arrivals = ArrivalClock(800.0, 1e-3)
    step = 1.25 / off_rate
    for count in range(0, 4000, 16):  # 16 lines at a time, each up to 8 ms late
        arrivals.add_arrival(count, 100.0 + step * count + rng.uniform(0.0, 8.0) ** 2 / 8.0)
    line = arrivals.estimate_line()
    assert line is not None
    assert line.step == pytest.approx(step, rel=2e-4)
    for count in (1000, 3000):
        assert abs(line.locate_sample(count) - 100.0 - step * count) < 1.0 + line.error


def test_nominal_rate_is_used_first_and_after_a_restart() -> None:
    arrivals = ArrivalClock(800.0, 1e-3)
    assert arrivals.estimate_line() is None
    arrivals.add_arrival(100, 50.0)
    line = arrivals.estimate_line()
    assert line is not None
    assert (line.step, line.locate_sample(100)) == (1.25, 50.0)
    arrivals.add_arrival(3, 90.0)
    again = arrivals.estimate_line()
    assert again is not None
    assert again.locate_sample(3) == 90.0


def create_accelerometer(**keys: float) -> StreamedAccelerometer:
    return StreamedAccelerometer("Y", Accelerometer(device="/dev/none", **{"scale": 0.01} | keys), 1e-3)


def build_lines(counts: list[int], text: str = "{},{},7,8") -> list[TextLine]:
    return [TextLine(text.format(c, 100 + c), round(1.25 * c * MS)) for c in counts]


def test_lines_become_accelerations_on_the_sync_count() -> None:
    sensor = create_accelerometer(late_s=0.002)
    found = [
        r
        for k in range(0, 1600, 40)
        for r in sensor.accept_lines(build_lines(list(range(k, k + 40))), build_tick_clock())
    ]
    samples = [r for r in found if isinstance(r, TableSamples)]
    tick, values = np.concatenate([r.tick for r in samples]), np.concatenate([r.values for r in samples])
    assert values.tolist() == pytest.approx([0.01 * (100 + c) for c in range(1600)])
    assert np.abs(tick - (1.25 * np.arange(1600) - 2.0)).max() < 1.0
    assert samples[-1].rate_per_tick == pytest.approx(0.8, rel=1e-3)
    assert (sensor.samples, sensor.lost) == (1600, 0)


def test_lost_lines_are_reported_and_counts_can_wrap() -> None:
    sensor = create_accelerometer()
    reported = sensor.accept_lines(build_lines([10, 11, 14]), build_tick_clock())
    assert [r.code for r in reported if isinstance(r, Notice)] == ["SampleTiming"]
    assert sensor.lost == 2
    wrapping = create_accelerometer()
    wrapping.accept_lines(
        [TextLine("65534,1", 0), TextLine("65535,1", MS), TextLine("0,1", 2 * MS)], build_tick_clock()
    )
    assert (wrapping.lost, wrapping.samples) == (0, 3)
    restarted = create_accelerometer()
    restarted.accept_lines([TextLine("70000,1", 0), TextLine("1,1", MS)], build_tick_clock())
    assert restarted.lost == 0


def test_without_a_count_every_line_is_the_next_sample() -> None:
    sensor = StreamedAccelerometer("Y", Accelerometer(device="/dev/none", count_column=0, column=1, scale=1.0), 1e-3)
    records = sensor.accept_lines([TextLine("1.5 m/s2", 0), TextLine("-2.5 m/s2", MS)], build_tick_clock())
    assert [r.values.tolist() for r in records if isinstance(r, TableSamples)] == [[1.5, -2.5]]


def test_incomplete_first_line_is_skipped_and_other_text_is_reported() -> None:
    sensor = create_accelerometer()
    sensor.accept_lines([TextLine("23", 0), *build_lines([24, 25])], build_tick_clock())
    assert sensor.samples == 2
    with pytest.raises(ProtocolError, match="has 0 numbers, but column 2 is configured; compare column"):
        create_accelerometer().accept_lines([TextLine("booting", 0), TextLine("hello world", MS)], build_tick_clock())


async def test_accelerometer_is_read_from_a_serial_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.drivers.table.accelerometer.SILENCE_NS", 60_000_000_000)
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    device = tmp_path / "accelerometer"
    device.symlink_to(os.ttyname(theirs))
    sensor = StreamedAccelerometer("Y", Accelerometer(device=str(device), scale=0.1), 1e-3)
    await sensor.link.connect()
    os.write(ours, b"1,-20,0,0\n2,-30,0,0\n")
    assert await sensor.format_reading() == "-3.00 m/s2"
    sensor.link.close()
    for fd in (ours, theirs):
        os.close(fd)


async def test_silent_and_missing_device_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.drivers.table.accelerometer.SILENCE_NS", 1)
    sensor = create_accelerometer()
    with pytest.raises(ConnectError, match="serial device /dev/none does not exist"):
        await sensor.link.connect()
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    quiet = StreamedAccelerometer("Y", Accelerometer(device=os.ttyname(theirs)), 1e-3)
    await quiet.link.connect()
    await asyncio.sleep(0.001)
    with pytest.raises(DeviceTimeout, match="check that the sensor streams") as caught:
        await quiet.poll_samples(build_tick_clock())
    assert quiet.link.classify_fault(caught.value) == "TableSilent"
    quiet.link.close()
    for fd in (ours, theirs):
        os.close(fd)


async def test_modbus_encoder_is_placed_between_request_and_answer() -> None:
    async with run_sensor_peer() as peer:  # 21.5 as a float32 from register 8 on
        value = {"address": 8, "type": "float32", "scale": 2.0, "offset": 1.0}
        asked = {"source": "modbus", "port": peer.port, "period_s": 0.001, "timeout_s": 60.0}
        encoder = ModbusEncoder("X", TableEncoder.model_validate(value | asked))
        await encoder.link.connect()
        assert await encoder.poll_samples(TickClock(1e-3)) == []  # without SYNC there is no place on its count
        ticks = TickClock(1e-3)
        begun = encoder.link.asked_ns
        ticks.add_arrivals(TickTimes(freeze_integers(np.arange(4000)), freeze_integers(begun + np.arange(4000) * MS)))
        (sample,) = await encoder.poll_samples(ticks)
        assert await encoder.format_reading() == "44.0000 mm"
        encoder.link.close()
    assert sample.values.tolist() == [44.0]
    assert 0.0 < sample.tick[0] < 4000.0
    assert sample.tick_error > 0.0


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({}, "cob_id: is missing"),
        ({"cob_id": 0x2A0, "byte": 5}, "byte: int32 from byte 5 on exceeds"),
        ({"cob_id": 0x2A0, "type": "float32"}, "type: a TPDO carries"),
        ({"cob_id": 0x2A0, "scale": 0.0}, "scale: must not be 0"),
    ],
)
def test_impossible_table_encoder_is_refused(keys: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        TableEncoder(**keys)


async def test_the_simulated_module_on_a_serial_line_is_read(tmp_path: Path) -> None:
    document = bench_document("X")
    keys = {
        "source": "modbus",
        "device": str(tmp_path / "line"),
        "type": "int32",
        "word_order": "little",
        "scale": 1e-4,
        "timeout_s": 60.0,
    }
    document["axis"]["X"]["table"] = keys | {"function": 3, "address": 30}
    config = machine_config.parse_config(document)
    sensor = VoltageSensor(1000.0, 300.0, 0.0, np.random.default_rng(1))
    wires = SensorConnections(config, {"X": sensor}, {"X": lambda: -123.4567})
    wires.start()
    settings = config.axis["X"].table
    assert settings is not None
    encoder = ModbusEncoder("X", settings)
    try:
        await encoder.link.connect()
        assert await encoder.format_reading() == "-123.4567 mm"
    finally:
        encoder.link.close()
        wires.stop()
