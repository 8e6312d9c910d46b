"""The guard on the simulated machine: the drives follow the table row by row."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.guard.guard_settings import encode_settings
from tests.guard.drive_peer import open_bus, write_config
from tests.guard.simulated_bus import FACTS_GIVEN, commissioned

pytestmark = pytest.mark.usefixtures("processes")

ROWS = 900
TOKEN = "the operator's"
PATIENT = """\
from fdhil.cli.main import main
from fdhil.sim import simulator_service
# of a guard that is held up while its offset is 0, too
simulator_service.LOCKSTEP_WAIT_S = simulator_service.LOCKSTEP_HOLDING_WAIT_S
main()
"""


def demand_mm() -> list[tuple[float, float]]:
    """Return a smooth move of both axes, at standstill at both ends."""
    parts = [min(max((k - 50) / (ROWS - 100), 0.0), 1.0) for k in range(ROWS)]
    ways = [10 * t**3 - 15 * t**4 + 6 * t**5 for t in parts]
    return [(40.0 * way, -15.0 * way) for way in ways]


def offset_increments() -> list[int]:
    """Return a bump of 61 um over the middle of the move."""
    return [
        round(100 * (1 - math.cos(2 * math.pi * (k - 100) / (ROWS - 200)))) if 100 <= k < ROWS - 100 else 0
        for k in range(ROWS)
    ]


class SimulatedDriveRig:
    def __init__(self, folder: Path) -> None:
        self.config = write_config(folder, 0)
        with self.config.open("a") as file:
            file.write('[sim]\npace = "lockstep"\nmodbus = false\n')
        self.process = subprocess.Popen(
            [sys.executable, "-c", PATIENT, "sim", str(self.config), "--json"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.port = int(self.event("ready")["buses"]["can0"]["port"])
        self.command(command="nc", on=True)
        assert self.event("nc")["on"]

    def command(self, **document: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(document) + "\n")
        self.process.stdin.flush()

    def event(self, kind: str) -> dict[str, Any]:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            event: dict[str, Any] = json.loads(line)
            if event["event"] == kind:
                return event
        raise AssertionError(f"the twin ended before it said {kind}")


def play(twin: SimulatedDriveRig, guard: GuardClient, folder: Path) -> dict[str, Any]:
    rows = demand_mm()
    columns = [[round(row[k] * 3276.8) for row in rows] for k in (0, 1)]
    bump = offset_increments()
    loaded = guard.load_table("XY", dict(zip("XY", columns, strict=True)), {"X": bump, "Y": [-v for v in bump]}, "p")
    assert loaded["ok"], loaded
    while guard.read_status()["good_for"] <= 100:
        time.sleep(0.01)
    armed = guard.arm(TOKEN, "p", FACTS_GIVEN)
    assert armed["ok"], armed
    tick = guard.read_status()["tick"]
    while guard.read_status()["tick"] < tick + 50:  # what it is behind SYNC is over
        time.sleep(0.01)
    file = folder / "demand.csv"
    lines = [f"{k * 1e-3:.3f},{x:.9f},{y:.9f}" for k, (x, y) in enumerate(rows)]
    file.write_text("time_s,X_mm,Y_mm\n" + "\n".join(lines) + "\n")
    twin.command(command="trace", file=str(folder / "trace.csv"))
    twin.command(command="play", file=str(file))
    return twin.event("finished")


def test_each_row_is_applied_at_its_own_cycle(tmp_path: Path) -> None:
    twin = SimulatedDriveRig(tmp_path)
    config = machine_config.load_config(twin.config)
    bus = config.bus["can0"].model_copy(update={"port": twin.port})
    settings = tmp_path / "guard.json"
    made = make_guard_settings(config, "can0", tmp_path, hashlib.sha256(TOKEN.encode()).hexdigest())
    settings.write_text(encode_settings(commissioned(made)))
    with open_bus("can0", bus) as far:
        command = [sys.executable, "-m", "fdhil.guard", "--settings", str(settings), "--descriptor", str(far.fileno())]
        guard = subprocess.Popen(command, stdout=subprocess.PIPE, pass_fds=[far.fileno()])
    assert guard.stdout is not None
    guard.stdout.readline()
    ended = threading.Event()
    with GuardClient(tmp_path, timeout_s=300.0) as client:

        def keep_alive() -> None:
            while not ended.wait(0.05):
                client.send_alive()

        keeper = threading.Thread(target=keep_alive)
        keeper.start()
        try:
            finished = play(twin, client, tmp_path)
            while (status := client.read_status())["state"] != "OFF":
                time.sleep(0.01)
        finally:
            ended.set()
            keeper.join()
    guard.terminate()  # while there is SYNC: it answers at one
    guard.communicate()
    twin.command(command="quit")
    assert twin.process.wait(300) == 0
    twin.process.communicate()
    assert status["cause"]["code"] == "Finished"
    assert finished["late_rpdo"] == {"X": 0, "Y": 0}
    with (tmp_path / "trace.csv").open() as file:
        trace = list(csv.DictReader(file))
    bump = offset_increments()
    assert [round(float(row["X_offset_um"]) * 3.2768) for row in trace[:ROWS]] == bump
    assert [round(float(row["Y_offset_um"]) * 3.2768) for row in trace[:ROWS]] == [-v for v in bump]
