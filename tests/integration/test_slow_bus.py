"""Four axes on one bus: cycles of 2 to 10 ms, every sample recorded, every rapid of every axis found."""

from __future__ import annotations

import asyncio
import queue
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.drivers import open_machine
from fdhil.pipeline import AxisPipeline
from fdhil.records import AxisSamples, Float, Trajectory, WindowOutcome, freeze_array
from fdhil.sim.simulated_machine import SimulatedMachine
from fdhil.sim.simulator_service import SimulatorService
from tests.bench import bench_document
from tests.integration.conftest import PATIENCE_S, Bench, digested
from tests.integration.test_loop import settled

ROOT = Path(__file__).parents[2]
AXES = "XYZA"
RAPIDS = 2
REST_S = 0.6
SETTLED_S = 0.6


def rapid_mm(period_s: float, length_mm: float = 300.0, speed: float = 500.0, acceleration: float = 4000.0) -> Float:
    ramp_s, cruise_s = speed / acceleration, length_mm / speed - speed / acceleration
    t = np.arange(0.0, 2 * ramp_s + cruise_s + period_s, period_s)
    up, down = np.clip(t, 0, ramp_s), np.clip(t - ramp_s - cruise_s, 0, ramp_s)
    cruising = np.clip(t - ramp_s, 0, cruise_s)
    return np.asarray(acceleration * up**2 / 2 + speed * cruising + speed * down - acceleration * down**2 / 2)


def move_back_and_forth(_: Path, config: MachineConfig) -> Trajectory:
    period_s = config.machine.sync_period_s
    way, rest = rapid_mm(period_s), round(REST_S / period_s)
    places = np.concatenate([np.zeros(rest), way, np.full(rest, 300.0), 300.0 - way, np.zeros(rest)])
    moving = np.concatenate([np.zeros(rest), way * 0 + 1, np.zeros(rest), way * 0 + 1, np.zeros(rest)]) > 0
    return Trajectory(
        period_s,
        freeze_array(np.arange(places.size) * period_s),
        {axis: freeze_array(places) for axis in config.axis},
        moving,
        np.zeros(places.size, dtype=np.int64),
    )


async def recorded(bench: Bench) -> tuple[list[Any], dict[str, int]]:
    records: list[Any] = []
    rows = round(SETTLED_S / bench.config.machine.sync_period_s)
    async with open_machine(bench.config) as source:
        bench.command('{"command": "nc", "on": true}')
        await asyncio.to_thread(bench.event, "nc")
        bench.command('{"command": "play", "file": "there and back"}')
        running = asyncio.create_task(source.run(records.append))
        async with asyncio.timeout(PATIENCE_S):
            await asyncio.to_thread(bench.event, "finished")
            while not all(settled(records, axis, RAPIDS, rows) for axis in bench.config.axis):  # noqa: ASYNC110 - no event
                await asyncio.sleep(0.02)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        return records, source.get_counters()


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("period_s", [0.002, 0.004, 0.01])
def test_four_axes_are_recorded_sample_by_sample(period_s: float, tmp_path: Path) -> None:
    document = bench_document(AXES)
    document["machine"]["sync_period_s"] = period_s
    document["bus"] = {"can0": {"interface": "virtual", "channel": f"slow-{period_s}"}}
    document["sim"] = {"pace": "lockstep", "modbus": False}
    config = machine_config.parse_config(document, folder=tmp_path)
    events: queue.Queue[dict[str, Any]] = queue.Queue()
    service = SimulatorService(config, events.put, move_back_and_forth)
    thread = threading.Thread(target=service.run, name="twin")
    thread.start()
    bench = Bench(config, service, events)
    try:
        bench.ready = bench.event("ready")
        records, counters = asyncio.run(recorded(bench))
    finally:
        service.stop()
        thread.join()
    assert counters["lost"] == 0, counters
    for axis in AXES:
        tick = np.concatenate([r.tick for r in records if isinstance(r, AxisSamples) and r.axis == axis])
        assert np.all(np.diff(tick) == 1)
        outcomes = digested(AxisPipeline(axis, config, with_skill=False), records)
        windows = [outcome.window for outcome in outcomes if isinstance(outcome, WindowOutcome)]
        assert [(window.direction, window.dt_s) for window in windows] == [(1, period_s), (-1, period_s)]
        assert max(window.speed_rad_s.max() for window in windows) == pytest.approx(157.1, rel=0.03)


def test_shipped_four_axis_config_fits_its_bus_but_not_at_1_ms() -> None:
    config = machine_config.load_config(ROOT / "configs" / "four-axes.toml")
    load = SimulatedMachine(config).describe_drives(dict.fromkeys(config.axis, Path()))["bus_load_worst"]["can0"]
    assert 0.3 < load < 0.6
    assert load * config.machine.sync_period_s / 0.001 > 1.5
