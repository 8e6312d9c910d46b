"""LinuxCNC, the simulated drives, fdhil's daemon and guard, each a process: identify, cut, record, correct, cut."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.machines import machine_document
from fdhil.cli.demo.processes import Process
from fdhil.cli.demo.toml import to_toml
from fdhil.commissioning.record import save_record
from fdhil.commissioning.steps import commission
from fdhil.config import MachineConfig
from fdhil.daemon.control import SOCKET_NAME
from fdhil.prediction import contour_error_um
from fdhil.program import load_trajectory
from fdhil.records import Trajectory
from tests.linuxcnc.machine import LinuxCnc
from tests.sim.twin_process import TwinProcess

pytestmark = pytest.mark.debian
PATIENCE_S = 300.0

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


def fdhil(*arguments: object, code: int = 0) -> dict[str, Any]:
    """Run a command as a user does and return its JSON document."""
    done = subprocess.run(
        [sys.executable, "-m", "fdhil", *map(str, arguments), "--json"],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == code, (arguments, done.returncode, done.stdout, done.stderr)
    return dict(json.loads(done.stdout))


def until(ready: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.1)


@dataclass
class Shop:
    """The simulated machine with its trace, and fdhil beside it, commissioned and listening."""

    folder: Path
    config: MachineConfig
    twin: TwinProcess

    @property
    def file(self) -> Path:
        return self.folder / "machine.toml"

    def status(self) -> dict[str, Any]:
        return fdhil("status", self.file)


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    document = machine_document()
    document["sim"]["pace"] = "lockstep"
    document["nc"] = {"profile": "linuxcnc"}
    for axis in document["axis"].values():
        axis["max_acceleration_mm_s2"] = 2000.0
    (tmp_path / "twin.toml").write_text(to_toml(document))
    with TwinProcess(tmp_path / "twin.toml", "--demand", "-", "--trace", tmp_path / "trace.csv") as twin:
        document["bus"] = twin.ready["buses"]
        (tmp_path / "machine.toml").write_text(to_toml(document))
        config = machine_config.load(tmp_path / "machine.toml")
        for axis in config.axis:
            save_record(commission(config, axis), config.store.directory, config.store.commissioning_key)
        with (
            Process("guard", ["fdhil.cli.guard", str(tmp_path / "machine.toml")], tmp_path / "guard.log"),
            Process("daemon", ["fdhil", "run", str(tmp_path / "machine.toml")], tmp_path / "daemon.log"),
        ):
            assert config.store.run_directory is not None
            until((config.store.run_directory / SOCKET_NAME).exists)
            yield Shop(tmp_path, config, twin)


def recorded(shop: Shop, cut: Callable[[], None]) -> Path:
    """Record a demand from the bus while something is cut."""
    out = shop.folder / "part.csv"
    command = [sys.executable, "-m", "fdhil", "record", str(shop.file), "--out", str(out), "--rest", "0.6", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as recording:
        assert recording.stderr is not None
        assert "waiting for a motion" in recording.stderr.readline()
        cut()
        told, _ = recording.communicate(timeout=PATIENCE_S)
    assert json.loads(told)["complete"], told
    return out


def cuts(trace: Path, part: Trajectory) -> list[float]:
    """The contour error (um RMS), at the simulated table, of each time that the part was cut."""
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
            error = contour_error_um(reference[there], place[there], part.dt_s)
            found.append(float(np.sqrt(np.mean(error**2))))
            first += len(rows)
        else:
            first += 1
    return found


def test_the_second_cut_of_a_program_is_corrected(shop: Shop) -> None:
    with LinuxCnc() as nc, nc.driving(shop.twin):
        nc.run(SHUTTLE)
        until(lambda: all(axis["accepted"] >= 4 for axis in shop.status()["axes"].values()))
        part = recorded(shop, lambda: nc.run(PART))
        promised = fdhil("correct", part, "--config", shop.file, "--from-history")
        fdhil("arm", shop.file, part)
        nc.run(PART)
        until(lambda: bool(shop.status()["passes"]))
    shop.twin.event("finished")
    before, after = cuts(shop.folder / "trace.csv", load_trajectory(part, shop.config))
    assert promised["contour"]["rms_um"] == pytest.approx(before, rel=0.05)
    assert after < before / 50
