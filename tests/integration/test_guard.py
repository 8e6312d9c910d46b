"""The guard's process on a bus between processes: mute until armed, then every offset in its own cycle."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.arming.guard_client import GuardClient
from fdhil.arming.operator_token import read_token
from fdhil.cli.demo.processes import ChildProcess
from fdhil.guard.interlocks import FACTS
from tests.integration.conftest import PATIENCE_S, Bench, sign_off

pytestmark = pytest.mark.usefixtures("processes")

DIGEST = "0" * 64


@pytest.fixture(params=["hub", pytest.param("socketcan", marks=pytest.mark.socketcan)])
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def sections() -> dict[str, Any]:
    return {"sim": {"pace": "lockstep", "modbus": False}, "guard": {"clock": "sync"}}


@pytest.fixture
def client(bench: Bench, tmp_path: Path) -> Iterator[GuardClient]:
    with guarded(bench, tmp_path) as guard_client:
        yield guard_client


@contextmanager
def guarded(bench: Bench, tmp_path: Path) -> Iterator[GuardClient]:
    document = json.loads(bench.config.model_dump_json(exclude_none=True))
    path = tmp_path / "machine.toml"
    path.write_text(toml(document), "utf-8")
    run = bench.config.store.run_directory
    assert run is not None
    sign_off(bench.config)
    with ChildProcess("guard", ["fdhil.cli.guard", str(path)], tmp_path / "guard.log") as guard:
        guard.await_event("ready", PATIENCE_S)
        with closing(GuardClient(run)) as guard_client:
            yield guard_client
        assert guard.stop() == 0


def toml(document: dict[str, Any], path: str = "") -> str:
    plain = {k: v for k, v in document.items() if not isinstance(v, dict)}
    lines = [f"[{path}]"] if path else []
    lines += [f"{key} = {json.dumps(value)}" for key, value in plain.items()]
    inner = [toml(v, f"{path}.{k}" if path else k) for k, v in document.items() if isinstance(v, dict)]
    return "\n".join(lines + inner) + "\n"


def arm(client: GuardClient, token: str) -> dict[str, Any]:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        client.send_alive()
        answer = dict(client.arm(token, DIGEST, dict.fromkeys(FACTS, True)))
        if answer["ok"]:
            return answer
        time.sleep(0.1)
    raise AssertionError(answer)


def missed_until_it_is_waited_for(client: GuardClient) -> int:
    first = client.read_status()["tick"]
    while (status := client.read_status())["tick"] < first + 50:
        client.send_alive()
        time.sleep(0.02)
    return int(status["missed_cycles"])


def test_every_offset_is_applied_in_its_own_cycle(bench: Bench, client: GuardClient, tmp_path: Path) -> None:
    every_offset_is_applied_in_its_own_cycle(bench, client, tmp_path)


def every_offset_is_applied_in_its_own_cycle(bench: Bench, client: GuardClient, tmp_path: Path) -> None:
    way = np.concatenate([np.zeros(20), 2.5 * (1 - np.cos(np.linspace(0, np.pi, 500))), np.full(100, 5.0)])
    demand = tmp_path / "demand.csv"
    rows = [f"{k * 0.001:.3f},{x:.6f},{x:.6f}" for k, x in enumerate(way)]
    demand.write_text("time_s,X_mm,Y_mm\n" + "\n".join(rows) + "\n", "utf-8")
    bump = np.round(100 * np.sin(np.linspace(0, np.pi, way.size)) ** 2).astype(int).tolist()
    increments = np.round(way * 65536 / 20).astype(int).tolist()
    bench.command('{"command": "nc", "on": true}')
    bench.event("nc")
    loaded = client.load_table(("X", "Y"), {"X": increments, "Y": increments}, {"X": bump, "Y": bump}, DIGEST)
    assert loaded["ok"], loaded
    assert client.read_status()["state"] == "OFF"
    run = bench.config.store.run_directory
    assert run is not None
    assert arm(client, read_token(run))["state"] == "ARMED"
    missed = missed_until_it_is_waited_for(client)
    trace = tmp_path / "trace.csv"
    bench.command(json.dumps({"command": "trace", "file": str(trace)}))
    bench.command(json.dumps({"command": "play", "file": str(demand)}))
    while bench.events.empty() or not any(e["event"] == "finished" for e in list(bench.events.queue)):
        client.send_alive()
        time.sleep(0.05)
    late = bench.event("finished")["late_rpdo"]
    # a host that halts the guard for a cycle is counted; whatever is not counted must be right
    missed = client.read_status()["missed_cycles"] - missed
    assert missed <= len(way) // 100
    assert max(late.values()) <= missed
    applied = np.genfromtxt(trace, delimiter=",", names=True)["X_offset_um"][: way.size] * 65536 / 20e3
    first = 30  # the guard knows where it is once the path has begun to move
    assert np.count_nonzero(np.abs(applied[first:] - np.array(bump[first:])) > 0.01) <= missed
