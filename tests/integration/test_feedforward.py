"""The on-line feed-forward on the simulated machine: without a program, from the targets on the bus."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.arming.guard_client import GuardClient
from fdhil.arming.operator_token import read_token
from fdhil.cli.demo.processes import ChildProcess
from fdhil.commissioning.commissioning_record import save_record
from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.correction.flatness_feedforward import derive_feedforward_law
from fdhil.guard.interlocks import FEEDFORWARD_FACTS
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Float
from tests.bench import bench_document
from tests.integration.conftest import PATIENCE_S, Bench
from tests.integration.test_guard import toml
from tests.paths import build_bench_demand

pytestmark = pytest.mark.usefixtures("processes")

LIMITS = {"max_torque_nm": 100.0, "max_speed_rad_s": 30.0}


@pytest.fixture
def transport() -> str:
    return "hub"


CASES = {"X": (1.0, 3.0), "Y": (0.5, 50.0)}
"""An axis of the bench and one that lags: its own speed feed-forward, and by how much the error has to shrink."""


@pytest.fixture
def sections() -> dict[str, Any]:
    document = bench_document()
    for name, axis in document["axis"].items():
        axis["feedforward"] = LIMITS
        axis["regulators"] = {**axis["regulators"], "speed_feedforward": CASES[name][0]}
    return {"axis": document["axis"], "sim": {"pace": "lockstep", "modbus": False}, "guard": {"clock": "sync"}}


@pytest.fixture
def client(bench: Bench, short_settling_time: None, tmp_path: Path) -> Iterator[GuardClient]:
    for axis in "XY":
        record = commission_axis(bench.config, axis)
        save_record(record, bench.config.store.directory)
        assert record.options["1402"] == 0x400 + bench.config.get_node_id(axis)
    path = tmp_path / "machine.toml"
    path.write_text(toml(json.loads(bench.config.model_dump_json(exclude_none=True))), "utf-8")
    run = bench.config.store.run_directory
    assert run is not None
    with ChildProcess("guard", ["fdhil.cli.guard", str(path)], tmp_path / "guard.log") as guard:
        guard.await_event("ready", PATIENCE_S)
        with GuardClient(run) as guard_client:
            yield guard_client
        assert guard.stop() == 0


def switch_on(client: GuardClient, bench: Bench) -> None:
    models = build_nominal_models(bench.config)
    laws = {axis: derive_feedforward_law(models[axis], bench.config.axis[axis], 0.001) for axis in "XY"}
    run = bench.config.store.run_directory
    assert run is not None
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        client.send_alive()
        answer = client.enable_feedforward(read_token(run), laws, dict.fromkeys(FEEDFORWARD_FACTS, True))
        if answer["ok"]:
            return
        time.sleep(0.1)
    raise AssertionError(answer)


def largest_errors_um(bench: Bench, client: GuardClient, demand: Path, trace: Path, rows: int) -> dict[str, float]:
    bench.command(json.dumps({"command": "trace", "file": str(trace)}))
    bench.command(json.dumps({"command": "play", "file": str(demand)}))
    while bench.events.empty() or not any(e["event"] == "finished" for e in list(bench.events.queue)):
        client.send_alive()
        time.sleep(0.05)
    bench.event("finished")
    data = np.genfromtxt(trace, delimiter=",", names=True)[:rows]
    errors: dict[str, Float] = {axis: data[f"{axis}_table_mm"] - data[f"{axis}_reference_mm"] for axis in "XY"}
    return {axis: 1e3 * float(np.abs(error).max()) for axis, error in errors.items()}


def test_feedforward_reduces_the_largest_following_error(bench: Bench, client: GuardClient, tmp_path: Path) -> None:
    demand = tmp_path / "demand.csv"
    path = build_bench_demand(10)
    lines = [f"{k * 0.001:.3f},{x:.9f},{y:.9f}" for k, (x, y) in enumerate(path)]
    demand.write_text("time_s,X_mm,Y_mm\n" + "\n".join(lines) + "\n", "utf-8")
    bench.command('{"command": "nc", "on": true}')
    bench.event("nc")
    before = largest_errors_um(bench, client, demand, tmp_path / "before.csv", len(path))
    switch_on(client, bench)
    after = largest_errors_um(bench, client, demand, tmp_path / "after.csv", len(path))
    for axis, (_, smaller) in CASES.items():
        assert before[axis] / after[axis] >= smaller, (before, after)
    client.disarm()
    deadline = time.monotonic() + PATIENCE_S
    while client.read_status()["feedforward"]["state"] != "OFF" and time.monotonic() < deadline:
        time.sleep(0.02)
    status = client.read_status()["feedforward"]
    assert status["state"] == "OFF"
    assert status["cause"]["code"] == "Disarmed"
    assert status["applied"] == {"X": [0, 0], "Y": [0, 0]}
