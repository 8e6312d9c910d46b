"""The daemon's stream of samples: viewers receive records, and none can delay the daemon."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.config import Access
from fdhil.daemon.daemon_socket import ControlServer
from fdhil.daemon.live_stream import LIVE_SIGNALS, MAX_VIEWERS, MAX_WAITING, LiveStream, decode_base64
from fdhil.records import AxisSamples, Temperature, TickTimes, VoltageSamples, freeze_array, freeze_integers
from tests.bench import bench_axis
from tests.daemon.simulated_machine import SimulatedMachine, config_of, rapids
from tests.daemon.test_daemon_service import serving

Line = dict[str, Any]


def block(tick: Any, axis: str = "X", voltage: bool = True) -> AxisSamples:
    """Return samples whose signals are the tick, times 1, 2, 3, and 4 um of error, 5 um of offset."""
    tick = np.asarray(tick)
    one = tick.astype(float)
    return AxisSamples(
        axis,
        freeze_integers(tick),
        demand_mm=freeze_array(one * 4e-3),
        position_mm=freeze_array(0 * one),
        speed_rad_s=freeze_array(3 * one),
        current_a=freeze_array(2 * one),
        voltage_v=freeze_array(one) if voltage else None,
        offset_mm=freeze_array(one * 5e-3),
        statusword=freeze_integers(0 * tick),
    )


@asynccontextmanager
async def streaming(stream: LiveStream, folder: Path) -> AsyncIterator[Path]:
    async def handle(_request: Any, _peer: Any) -> Any:
        return stream.open_stream()

    async with ControlServer(handle, lambda: None, lambda: None, Access(), stream.serve_viewer).serve_socket(
        folder / "s"
    ):
        yield folder / "s"


async def ask_live(path: Path) -> tuple[Line, asyncio.StreamReader, asyncio.StreamWriter]:
    reader, writer = await asyncio.open_unix_connection(str(path), limit=2**22)
    writer.write(b'{"request": "live"}\n')
    return json.loads(await reader.readline()), reader, writer


async def line_of(reader: asyncio.StreamReader, kind: str) -> Line:
    while True:
        line: Line = json.loads(await asyncio.wait_for(reader.readline(), 60.0))
        if line["live"] == kind:
            return line


def values_of(line: Line) -> Any:
    return decode_base64(line["values"], "<f4").reshape(len(LIVE_SIGNALS), -1)


async def test_daemon_streams_its_samples(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_service.compile_kernels", lambda config, method: None)
    config = config_of(tmp_path)
    machine = SimulatedMachine()
    async with serving(config, machine) as path:
        answer, reader, writer = await ask_live(path)
        assert (answer["ok"], answer["axes"], answer["sync_period_s"]) == (True, ["X"], 0.001)
        assert tuple(answer["signals"]) == LIVE_SIGNALS
        await line_of(reader, "alive")
        records = rapids(config, count=1)
        machine.give(*records)
        sent = [record for record in records if isinstance(record, AxisSamples)]
        result = [await line_of(reader, "samples") for _ in sent]
        writer.close()
    assert [line["tick"] for line in result] == [int(record.tick[0]) for record in sent]
    current = np.concatenate([values_of(line)[LIVE_SIGNALS.index("current_a")] for line in result])
    np.testing.assert_allclose(current, np.concatenate([record.current_a for record in sent]), atol=1e-4)


async def test_stream_has_signals_units_gaps_and_separate_sensors(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    stream = LiveStream(config)
    stream.publish_record(Temperature("X", 0, 21.5, "slideway"))
    async with streaming(stream, tmp_path) as path:
        _, reader, writer = await ask_live(path)
        assert (await line_of(reader, "temperature"))["celsius"] == 21.5  # what was last read is told at once
        for empty in (block([]), TickTimes(freeze_integers([]), freeze_integers([]))):
            stream.publish_record(empty)  # no sample of a block is whole
        stream.publish_record(block([100, 101, 103]))
        stream.publish_record(block([104], voltage=False))
        stream.publish_record(
            VoltageSamples("v", "X", *(freeze_integers([5, 6]),) * 3, freeze_array([1.0, 2.0]), 1000.0)
        )
        stream.publish_record(
            TickTimes(freeze_integers([100]), freeze_integers([0]))
        )  # no sensor of its own: nobody needs it
        whole, single = await line_of(reader, "samples"), await line_of(reader, "samples")
        voltage = await line_of(reader, "voltage")
        writer.close()
    assert decode_base64(whole["ticks"], "<i4").tolist() == [0, 1, 3]
    np.testing.assert_allclose(values_of(whole)[:, 1], [101, 202, 303, 404, 505, 0, 0.404], rtol=1e-6)
    assert "ticks" not in single
    assert np.isnan(values_of(single)[0, 0])
    assert decode_base64(voltage["t_ns"], "<i8").tolist() == [5, 6]
    assert decode_base64(voltage["values"], "<f4").tolist() == [1.0, 2.0]


async def test_tick_times_are_streamed_with_a_separate_sensor(tmp_path: Path) -> None:
    axis = {**bench_axis(), "voltage": {"source": "modbus"}}
    stream = LiveStream(config_of(tmp_path, axis={"X": axis}))
    async with streaming(stream, tmp_path) as path:
        _, reader, writer = await ask_live(path)
        await line_of(reader, "alive")
        stream.publish_record(TickTimes(freeze_integers([]), freeze_integers([])))
        stream.publish_record(TickTimes(freeze_integers([7, 8, 9]), freeze_integers([70, 80, 90])))
        assert await line_of(reader, "times") == {"live": "times", "tick": [7, 9], "t_ns": [70, 90]}
        writer.close()


@pytest.mark.usefixtures("long_computation")
async def test_slow_viewer_loses_counted_lines_and_others_lose_none(tmp_path: Path) -> None:
    stream = LiveStream(config_of(tmp_path))
    async with streaming(stream, tmp_path) as path:
        _, slow, slow_writer = await ask_live(path)
        slow_writer.transport.pause_reading()  # type: ignore[attr-defined]
        _, quick, quick_writer = await ask_live(path)
        await line_of(quick, "alive")
        ticks = range(0, 4 * MAX_WAITING * 1000, 1000)
        for tick in ticks:
            stream.publish_record(block(np.arange(tick, tick + 1000)))
            assert (await line_of(quick, "samples"))["tick"] == tick
        slow_writer.transport.resume_reading()  # type: ignore[attr-defined]
        got = 0
        while True:
            line = json.loads(await asyncio.wait_for(slow.readline(), 60.0))
            got += line["live"] == "samples"
            if line["live"] == "skipped":
                break
        assert got + line["lines"] == len(ticks)
        assert got < MAX_WAITING + 100
        slow_writer.close()
        quick_writer.close()


async def test_number_of_viewers_is_limited(tmp_path: Path) -> None:
    stream = LiveStream(config_of(tmp_path))
    async with streaming(stream, tmp_path) as path:
        viewers = [await ask_live(path) for _ in range(MAX_VIEWERS)]
        for _, reader, _ in viewers:
            await line_of(reader, "alive")
        refused, _, writer = await ask_live(path)
        assert (refused["ok"], refused["code"]) == (False, "Busy")
        writer.close()
        viewers[0][2].close()
        answer = refused
        while not answer["ok"]:
            stream.publish_record(block([0]))
            await asyncio.sleep(0.01)
            answer, _, writer = await ask_live(path)
            writer.close()
        for _, _, each in viewers[1:]:
            each.close()


def test_nothing_is_encoded_without_viewers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "fdhil.daemon.live_stream.encode_line", lambda result: pytest.fail("a line was made for nobody")
    )
    LiveStream(config_of(tmp_path)).publish_record(block([1, 2, 3]))


async def test_simultaneous_viewers_cannot_exceed_the_limit(tmp_path: Path) -> None:
    stream = LiveStream(config_of(tmp_path))
    async with streaming(stream, tmp_path) as path, asyncio.timeout(60.0):
        opened = [await asyncio.open_unix_connection(str(path)) for _ in range(2 * MAX_VIEWERS)]
        for _, writer in opened:
            writer.write(b'{"request": "live"}\n')
        granted = 0
        for reader, _ in opened:
            if json.loads(await reader.readline())["ok"] and (await reader.readline()):
                granted += 1
        for _, writer in opened:
            writer.close()
    assert granted == MAX_VIEWERS
