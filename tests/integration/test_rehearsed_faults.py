"""Bus faults rehearsed during a cut: the guard's process on the simulated bus ramps the offset to zero."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.arming.guard_client import GuardClient
from fdhil.arming.operator_token import read_token
from tests.integration.conftest import PATIENCE_S, Bench
from tests.integration.test_guard import DIGEST, arm, client, sections, transport

pytestmark = pytest.mark.usefixtures("processes")

__all__ = ["client", "sections", "transport"]

REHEARSED: dict[str, tuple[str, dict[str, Any]]] = {
    "A10 feedback lost": ("StaleData", {"fault": "bus_drop", "can_id": 0x181}),
    "E15 read-back spoilt": ("EchoMismatch", {"fault": "bus_mutate", "can_id": 0x381, "value": 8}),
}
WAY = np.concatenate([np.zeros(20), 2.5 * (1 - np.cos(np.linspace(0, np.pi, 900)))])


@pytest.mark.fault("A10", "E15")
@pytest.mark.parametrize("case", REHEARSED)
def test_bus_fault_ends_at_zero_with_its_class(case: str, bench: Bench, client: GuardClient, tmp_path: Path) -> None:
    code, fault = REHEARSED[case]
    demand = tmp_path / "demand.csv"
    demand.write_text("time_s,X_mm,Y_mm\n" + "".join(f"{k * 1e-3:.3f},{x:.6f},{x:.6f}\n" for k, x in enumerate(WAY)))
    increments = np.round(WAY * 65536 / 20).astype(int).tolist()
    bump = np.round(200 * np.sin(np.linspace(0, np.pi, WAY.size)) ** 2).astype(int).tolist()
    bench.command('{"command": "nc", "on": true}')
    bench.event("nc")
    assert client.load_table(("X", "Y"), {"X": increments, "Y": increments}, {"X": bump, "Y": bump}, DIGEST)["ok"]
    run = bench.config.store.run_directory
    assert run is not None
    arm(client, read_token(run))
    trace = tmp_path / "trace.csv"
    bench.command(json.dumps({"command": "trace", "file": str(trace)}))
    bench.command(json.dumps({"command": "fault", "at_row": 450, "duration_s": 0.05, **fault}))
    bench.command(json.dumps({"command": "play", "file": str(demand)}))
    deadline = time.monotonic() + PATIENCE_S
    while (status := client.read_status())["state"] not in ("OFF", "FROZEN"):
        assert time.monotonic() < deadline, status
        client.send_alive()
        time.sleep(0.02)
    assert status["cause"]["code"] == code
    bench.event("finished")
    held_um = np.genfromtxt(trace, delimiter=",", names=True)["X_offset_um"]
    assert held_um.max() > 40.0
    assert held_um[-1] == 0.0
