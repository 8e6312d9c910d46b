"""A program longer than the guard's ring: checked as a whole, handed on and applied while the machine runs."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fdhil.daemon.program_check import check, keep
from fdhil.daemon.streamed import FIRST_S, Checked, Stream
from fdhil.daemon.token import read_token
from fdhil.guard.client import GuardClient
from fdhil.guard.interlocks import FACTS
from fdhil.prediction import contour_error_um
from fdhil.prediction.models import nominal_models
from fdhil.program import program_digest
from fdhil.records import Float
from tests.integration.conftest import PATIENCE_S, Bench
from tests.integration.test_guard import DIGEST, client, sections
from tests.paths import bench_demand, rms

pytestmark = pytest.mark.timeout(300)
__all__ = ["client", "sections"]
PASSES = 10


@pytest.fixture
def transport() -> str:
    """The transport that joins processes."""
    return "hub"


def contour_um(trace: Path, rows: int) -> Float:
    """The contour error along the played path."""
    data = np.genfromtxt(trace, delimiter=",", names=True)[:rows]
    reference, actual = (
        np.column_stack([data[f"{axis}_{what}_mm"] for axis in "XY"]) for what in ("reference", "table")
    )
    return contour_error_um(reference, actual, 0.001)


@contextlib.contextmanager
def kept_alive(client: GuardClient) -> Iterator[None]:
    """Tell the guard that this process lives, whatever it is busy with."""
    ended = threading.Event()

    def tell() -> None:
        while not ended.wait(0.05):
            client.alive()

    thread = threading.Thread(target=tell)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_a_program_longer_than_the_ring(bench: Bench, client: GuardClient, tmp_path: Path) -> None:
    """Armed with its first 10 s, never interrupted, 20 times better on the whole."""
    there = bench_demand(10)
    path = np.concatenate([np.repeat(there[:1], 300, axis=0), *[there, there[::-1]] * (PASSES // 2)])
    demand = tmp_path / "demand.csv"
    np.savetxt(
        demand,
        np.column_stack([np.arange(len(path)) * 0.001, path]),
        fmt=["%.3f", "%.9f", "%.9f"],
        delimiter=",",
        header="time_s,X_mm,Y_mm",
        comments="",
    )
    bench.command('{"command": "nc", "on": true}')
    bench.event("nc")
    models = nominal_models(bench.config)
    digest = program_digest(demand)
    keep(tmp_path, "key", lambda body: check(demand, digest, models, bench.config, body, lambda told: None))
    checked = Checked.find(tmp_path, "key", tmp_path)
    assert checked is not None
    stream = Stream(checked, DIGEST, 0.001)
    piece = stream.take(FIRST_S)
    assert client.load("XY", piece.demand, piece.offset, DIGEST, piece.first, piece.final)["ok"]
    run = bench.config.store.run_directory
    assert run is not None
    deadline = time.monotonic() + PATIENCE_S
    while not client.arm(read_token(run), DIGEST, dict.fromkeys(FACTS, True))["ok"] and time.monotonic() < deadline:
        client.alive()
        time.sleep(0.1)
    trace = tmp_path / "trace.csv"
    bench.command(json.dumps({"command": "trace", "file": str(trace)}))
    bench.command(json.dumps({"command": "play", "file": str(demand)}))
    states, held = set(), 0
    with kept_alive(client):
        while bench.events.empty() or not any(e["event"] == "finished" for e in list(bench.events.queue)):
            status = client.status()
            if status["row"]:
                states.add(status["state"])
                held = max(held, status["rows"][1] - status["rows"][0])
            if stream.lacks(status):
                piece = stream.take()
                answer = client.load("XY", piece.demand, piece.offset, DIGEST, piece.first, piece.final)
                assert answer["ok"], answer
            else:
                time.sleep(0.01)
    # one process hands on here and runs the twin: it may sleep longer than the twin waits, a few cycles of 30,000
    assert max(bench.event("finished")["late_rpdo"].values()) < 10
    assert stream.done
    assert states <= {"RAMPING", "ACTIVE"}
    assert held < 15_000  # the ring, not the program
    cause = client.status()["cause"]
    assert cause["code"] == "Finished"
    after = contour_um(trace, len(path))[400:]
    assert checked.header["before"]["rms_um"] > 20 * rms(after)
