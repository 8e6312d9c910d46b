"""A check that continues while the machine runs: checked rows are sent, none after a refused position."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.arming.checked_program import FIRST_S, CheckedBlock, CheckedProgram, RowStream
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.operator_token import read_token
from fdhil.arming.program_check import check_program
from fdhil.config import MachineConfig
from fdhil.correction import PlanLimits
from fdhil.correction import check_offsets as check_limits
from fdhil.guard.interlocks import FACTS
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import compute_program_digest
from fdhil.records import Float, Reason
from tests.integration.conftest import PATIENCE_S, Bench
from tests.integration.test_guard import DIGEST, client, sections
from tests.paths import build_bench_demand

pytestmark = pytest.mark.usefixtures("processes")

__all__ = ["client", "sections"]


@pytest.fixture
def transport() -> str:
    return "hub"


@contextlib.contextmanager
def kept_alive(client: GuardClient) -> Iterator[None]:
    ended = threading.Event()

    def tell() -> None:
        while not ended.wait(0.05):
            client.send_alive()

    thread = threading.Thread(target=tell)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def written(folder: Path, path: Float) -> Path:
    demand = folder / "demand.csv"
    np.savetxt(
        demand,
        np.column_stack([np.arange(len(path)) * 0.001, path]),
        fmt=["%.3f", "%.9f", "%.9f"],
        delimiter=",",
        header="time_s,X_mm,Y_mm",
        comments="",
    )
    return demand


def play(bench: Bench, client: GuardClient, demand: Path, stream: RowStream) -> None:
    bench.command('{"command": "nc", "on": true}')
    bench.event("nc")
    piece = stream.take_rows(FIRST_S)
    assert client.load_table("XY", piece.demand, piece.offset, DIGEST, piece.first, piece.final)["ok"]
    run = bench.config.store.run_directory
    assert run is not None
    deadline = time.monotonic() + PATIENCE_S
    while not client.arm(read_token(run), DIGEST, dict.fromkeys(FACTS, True))["ok"] and time.monotonic() < deadline:
        client.send_alive()
        time.sleep(0.1)
    trace = demand.with_name("trace.csv")
    bench.command(json.dumps({"command": "trace", "file": str(trace)}))
    bench.command(json.dumps({"command": "play", "file": str(demand)}))
    with kept_alive(client):
        while bench.events.empty() or not any(e["event"] == "finished" for e in list(bench.events.queue)):
            status = client.read_status()
            if stream.has_too_few_rows(status) and stream.has_block and status["state"] != "OFF":
                piece = stream.take_rows()
                answer = client.load_table("XY", piece.demand, piece.offset, DIGEST, piece.first, piece.final)
                assert answer["ok"], answer
            else:
                time.sleep(0.03)


def test_streamed_rows_end_before_a_refused_position(bench: Bench, client: GuardClient, tmp_path: Path) -> None:
    there, hard = build_bench_demand(10), build_bench_demand(20, (0.030, 0.015))
    path = np.concatenate([np.repeat(there[:1], 300, axis=0), *[there, there[::-1]] * 2, hard])
    place = len(path) - len(hard)
    demand = written(tmp_path, path)
    (tmp_path / "rows").touch()
    checked = CheckedProgram(tmp_path / "rows", "XY")
    checking = threading.Thread(target=grow, args=(checked, demand, tmp_path / "rows", bench.config))
    checking.start()
    while checked.row_count < 10_000:
        time.sleep(0.01)
    stream = RowStream(checked, DIGEST, 0.001)
    play(bench, client, demand, stream)
    checking.join()
    assert checked.refused[0].code == "DemandTooHigh"
    assert place - 2_500 <= checked.row_count <= place
    assert stream.end == checked.row_count
    assert client.read_status()["cause"]["code"] == "TableStarved"
    trace = np.genfromtxt(tmp_path / "trace.csv", delimiter=",", names=True)
    limits = PlanLimits.derive(bench.config.axis["X"], 0.001)
    for axis in "XY":
        sent = np.rint(trace[f"{axis}_offset_um"] / limits.um_per_increment)
        assert np.any(sent[: checked.row_count - 1_000])
        assert not np.any(sent[checked.row_count - 500 :])
        assert check_limits(sent.astype(np.int64), limits) == []


def grow(checked: CheckedProgram, demand: Path, rows: Path, config: MachineConfig) -> None:
    def hear(result: Mapping[str, Any]) -> None:
        if "block" in result:
            end, sha256 = result["block"]
            checked.add_block(CheckedBlock(end, sha256, result["last"]), result["errors"])
        elif "refused" in result:
            checked.refused += (Reason(**result["refused"]),)

    with rows.open("r+b") as body:
        check_program(demand, compute_program_digest(demand), build_nominal_models(config), config, body, hear)
