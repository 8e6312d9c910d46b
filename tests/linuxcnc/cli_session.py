"""fdhil next to LinuxCNC in normal use: commands in a shell, and the measurements at the simulated machine's table."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fdhil.arming.pass_monitor import FINISHED
from fdhil.child_process import wrap_to_end_with_parent
from fdhil.prediction import compute_contour_error_um
from fdhil.records import Trajectory

PATIENCE_S = 300.0
TRIES = 5  # on an overloaded computer LinuxCNC's task occasionally feeds its planner too late, which changes the demand
SHUTTLE = "G21 G90\n" + "G0 X400 Y400\nG4 P0.3\nG0 X0 Y0\nG4 P0.3\n" * 3 + "M2\n"
PART = """G21 G90 G17 G64 P0.01
F9000
G1 X0 Y55
G1 X60
G3 X100 I20
G1 X120
G1 X0 Y0
M2
"""


def run_fdhil(*arguments: object, code: int = 0) -> dict[str, Any]:
    done = subprocess.run(
        wrap_to_end_with_parent([sys.executable, "-m", "fdhil", *map(str, arguments), "--json"]),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == code, (arguments, done.returncode, done.stdout, done.stderr)
    return dict(json.loads(done.stdout))


def wait_for_state(ready: Callable[[], bool]) -> None:
    """Wait for a state; it may take long on a busy computer."""
    end = time.monotonic() + PATIENCE_S
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.1)


def record_demand(config: Path, out: Path, cut: Callable[[], None]) -> None:
    command = [sys.executable, "-m", "fdhil", "record", str(config), "--out", str(out), "--rest", "0.6", "--json"]
    with subprocess.Popen(
        wrap_to_end_with_parent(command), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as recording:
        assert recording.stderr is not None
        first = recording.stderr.readline()
        assert "waiting for a motion" in first, first + recording.stderr.read()
        cut()
        reported, _ = recording.communicate(timeout=PATIENCE_S)
    assert json.loads(reported)["complete"], reported


def is_pass_repeated(status: Mapping[str, Any]) -> bool:
    """Return whether the last pass was the armed demand to its end; otherwise the guard has ramped down."""
    return bool(status["passes"][-1]["ended_by"] == FINISHED)


def compute_contour_errors(trace: Path, part: Trajectory) -> list[float]:
    """Return the contour error (um RMS) at the simulated table for each cut of the part."""
    table = np.genfromtxt(trace, delimiter=",", names=True)
    reference, place = (
        np.column_stack([table[f"{axis}_{what}_mm"] for axis in part.axes]) for what in ("reference", "table")
    )
    per_mm, rows = 65536 / 20, part.path_mm
    found, first = [], 0
    while first + len(rows) <= len(reference):
        apart = np.abs(reference[first : first + len(rows)] - rows).max()
        if apart <= 1 / per_mm:
            there = slice(first, first + len(rows))
            error = compute_contour_error_um(reference[there], place[there], part.dt_s)
            found.append(float(np.sqrt(np.mean(error**2))))
            first += len(rows)
        else:
            first += 1
    return found
