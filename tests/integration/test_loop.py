"""From the bus to a corrected path, on every transport: acquisition, identification, commissioning."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.drivers import open_machine
from fdhil.pipeline import AxisPipeline
from fdhil.records import AxisSamples, MoveEvent, MoveKind, ParameterSet, WindowOutcome
from tests.integration.conftest import PATIENCE_S, Bench, digested

pytestmark = pytest.mark.usefixtures("long_computation")

ROUND = "G0 X300 Y300\nG4 P0.3\nG0 X0 Y0\nG4 P0.3\n"
TRUE = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0}
SETTLED_ROWS = 500  # after the last rapid: it becomes a window when its axis has stood for a while


def settled(records: list[Any], axis: str, rapids: int, rows: int = SETTLED_ROWS) -> bool:
    rests = [r.tick for r in records if isinstance(r, MoveEvent) and r.axis == axis and r.kind is MoveKind.REST]
    blocks = (r for r in reversed(records) if isinstance(r, AxisSamples) and r.axis == axis and r.tick.size)
    newest = next((int(block.tick[-1]) for block in blocks), 0)
    return len(rests) == rapids and newest >= rests[-1] + rows


async def recorded(bench: Bench, program: Path) -> tuple[list[Any], dict[str, int]]:
    for _ in range(3 if bench.config.sim.pace == "realtime" else 1):
        records, counters = await _recorded(bench, program)
        if not any(n for name, n in counters.items() if name.rpartition(".")[2] == "lost"):
            break
    return records, counters


async def _recorded(bench: Bench, program: Path) -> tuple[list[Any], dict[str, int]]:
    records: list[Any] = []
    rapids = program.read_text().count("G0 ")
    async with open_machine(bench.config) as source:
        bench.command('{"command": "nc", "on": true}')
        await asyncio.to_thread(bench.event, "nc")
        running = asyncio.create_task(source.run(records.append))

        async def until(condition: Callable[[], bool]) -> None:
            """Wait while the source runs and has lost nothing: after that, moves are not counted on."""
            while not (running.done() or source.get_counters()["lost"] or condition()):  # noqa: ASYNC110 - no event
                await asyncio.sleep(0.02)

        async with asyncio.timeout(4 * PATIENCE_S):
            # a sensor that is first asked when a rapid has begun has no voltage of its beginning
            await until(lambda: all(n for name, n in source.get_counters().items() if name.endswith(".samples")))
            bench.command(json.dumps({"command": "play", "file": str(program)}))
            await asyncio.to_thread(bench.event, "finished")
            await until(lambda: all(settled(records, axis, rapids) for axis in bench.config.axis))
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running
        return records, source.get_counters()


def shuttle(folder: Path, rounds: int = 2) -> Path:
    path = folder / "shuttle.ngc"
    path.write_text("G21 G90 G94\n" + ROUND * rounds + "M2\n")
    return path


def test_no_sample_is_lost_and_the_drives_are_identified(bench: Bench, tmp_path: Path) -> None:
    records, counters = asyncio.run(recorded(bench, shuttle(tmp_path)))
    assert counters["lost"] == 0, counters
    demand_and_position_are_aligned([r for r in records if isinstance(r, AxisSamples) and r.axis == "X"])
    for axis in bench.config.axis:
        blocks = [r for r in records if isinstance(r, AxisSamples) and r.axis == axis]
        tick = np.concatenate([block.tick for block in blocks])
        assert tick.size > 4000
        assert np.all(np.diff(tick) == 1)
        pipeline = AxisPipeline(axis, bench.config)
        outcomes = digested(pipeline, records)
        windows = [o for o in outcomes if isinstance(o, WindowOutcome)]
        assert [o.verdict.accepted for o in windows] == [True] * 4, [o.verdict for o in windows]
        newest = [o for o in outcomes if isinstance(o, ParameterSet)][-1].parameters.as_dict()
        for name, true in TRUE.items():
            assert newest[name] == pytest.approx(true, rel=0.01 if name not in ("ft", "Cd") else 0.05), name


def demand_and_position_are_aligned(blocks: list[AxisSamples]) -> None:
    demand, position, speed = (
        np.concatenate([getattr(b, name) for b in blocks]) for name in ("demand_mm", "position_mm", "speed_rad_s")
    )
    cruise = np.abs(speed) > 150
    late_mm = np.abs(demand - position)[cruise]
    assert np.median(late_mm) < 0.1
    # the integral of speed is the position, tick by tick
    travel = np.cumsum((speed[1:] + speed[:-1]) / 2) * 0.001 * 20 / (2 * np.pi)
    assert np.max(np.abs(travel - (position[1:] - position[0]))) < 0.2


@pytest.mark.usefixtures("short_settling_time")
def test_axis_is_commissioned(bench: Bench, transport: str) -> None:
    record = commission_axis(bench.config, "X")
    assert record.watchdog == "proven"
    # a virtual machine with one processor may be too slow to see the ramp begin: then it must not be told either way
    assert record.offset_in_feedforward in ((True, None) if transport == "socketcan" else (True,))
    assert record.sign_test_um == pytest.approx(10, abs=1)


def test_emergency_is_reported(bench: Bench) -> None:
    async def notices() -> set[str]:
        codes = set()
        async with open_machine(bench.config) as source:
            bench.command('{"command": "nc", "on": true}')
            await asyncio.to_thread(bench.event, "nc")
            other = bench.join()
            try:
                import can

                data = struct.pack("<HB5x", 0x8611, 0x21)
                other.send(can.Message(arbitration_id=0x081, data=data, is_extended_id=False))
                out = asyncio.Queue[Any]()
                running = asyncio.create_task(source.run(out.put_nowait))
                async with asyncio.timeout(PATIENCE_S):
                    while "DriveEmergency" not in codes:
                        codes.add(getattr(await out.get(), "code", ""))
                running.cancel()
                await asyncio.gather(running, return_exceptions=True)
            finally:
                other.shutdown()
        return codes

    assert "DriveEmergency" in asyncio.run(notices())
