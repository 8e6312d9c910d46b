"""The real processes: the twin with its NC on a bus of its own, the daemon beside it, the command line against both."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.processes import Process, Twin
from fdhil.config import MachineConfig
from fdhil.daemon.control import ask
from fdhil.errors import ConnectError
from fdhil.store.history import History
from fdhil.store.windows import list_windows

REAL = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.085, "ft": 0.05, "Cd": 5.0}
SHUTTLE = "G21 G90 G94\nG0 X300\nG4 P0.4\nG0 X0\nG4 P0.4\nG0 X300\nG4 P0.4\nG0 X0\nG4 P0.4\nM2\n"
AXIS = """
[machine]
name = "bench"
[axis.X]
screw_pitch_mm = 20.0
rapid_speed_mm_s = 500.0
max_acceleration_mm_s2 = 4000.0
[axis.X.nominal]
R = 0.5
L = 0.005
K = 0.8
Jt = 0.075
ft = 0.05
Cd = 5.0
[axis.X.regulators]
position_gain_per_s = 50.0
speed_kp = 23.562
speed_ki = 1184.35
current_limit_a = 200.0
current_kp = 12.566
current_ki = 1256.64
voltage_limit_v = 300.0
[axis.X.correction]
max_offset_um = 250.0
max_speed_mm_s = 20.0
max_acceleration_mm_s2 = 2000.0
"""
TWIN = '[sim.axis.X]\nJt = 0.085\n[bus.can0]\ninterface = "socketcand"\n'


@dataclass
class Shop:
    """A twin that runs, and the configuration of the machine that it is."""

    folder: Path
    twin: Twin
    path: Path
    config: MachineConfig

    @property
    def socket(self) -> Path:
        """The daemon's control socket."""
        assert self.config.store.run_directory is not None
        return self.config.store.run_directory / "daemon.sock"

    def daemon(self) -> Process:
        """Start a daemon and wait until it listens."""
        daemon = Process("daemon", ["fdhil", "run", str(self.path)], self.folder / "daemon.log")
        while not self.listens():
            daemon.check()
            time.sleep(0.05)
        return daemon

    def listens(self) -> bool:
        """Whether the daemon answers and its bus is open."""
        try:
            return bool(ask(self.socket, {"request": "status"})["source"]["state"] == "listening")
        except ConnectError:
            return False

    def status_when(self, ready: Any) -> dict[str, Any]:
        """Return the first status for which ``ready`` holds."""
        while not ready(status := ask(self.socket, {"request": "status"})):
            self.twin.check()
            time.sleep(0.1)
        return status


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    """A twin whose table is heavier than the data sheet says."""
    (tmp_path / "twin.toml").write_text(AXIS + TWIN)
    with Twin(tmp_path / "twin.toml", tmp_path / "twin.log") as twin:
        bus = twin.ready["buses"]["can0"]
        machine = tmp_path / "machine.toml"
        place = (
            f'interface = "socketcand"\nchannel = "{bus["channel"]}"\nhost = "{bus["host"]}"\nport = {bus["port"]}\n'
        )
        machine.write_text(f"{AXIS}[bus.can0]\n{place}")
        yield Shop(tmp_path, twin, machine, machine_config.load(machine))


def fdhil(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command line."""
    return subprocess.run([sys.executable, "-m", "fdhil", *map(str, arguments)], capture_output=True, text=True)


def test_from_the_bus_to_the_history_and_back(shop: Shop) -> None:
    (shop.folder / "shuttle.ngc").write_text(SHUTTLE)
    with shop.daemon() as daemon:
        shop.twin.command("nc", on=True)
        shop.twin.event("nc", 30.0)
        shop.twin.play(shop.folder / "shuttle.ngc")
        status = shop.status_when(lambda s: s["axes"]["X"]["accepted"] + s["axes"]["X"]["refused"] >= 4)
        second = Process("second daemon", ["fdhil", "run", str(shop.path)], shop.folder / "second.log")
        with pytest.raises(ConnectError, match="BusLocked"):
            second.event("ready", 60.0)
        assert second.stop() == 3
        assert daemon.stop() == 0
    log = (shop.folder / "daemon.log").read_text()
    assert log.splitlines()[-1] == "stopped, offset 0", log
    axis = status["axes"]["X"]
    assert (axis["accepted"], axis["refused"]) == (4, 0), log
    assert status["state"] == "OFF(SHADOW)"
    assert status["frames"]["received"] > 10_000
    assert status["sync"]["rate_hz"] > 0
    for name, true in REAL.items():
        told = axis["parameters"][name]
        assert told["value"] == pytest.approx(true, rel=0.02 if name not in {"ft", "Cd"} else 0.1), name
        assert told["low"] < told["high"]
    assert axis["skill"]["rms_um"] < 0.1 * axis["skill"]["measured_rms_um"]
    _replays_bit_by_bit(shop)
    _history_is_told(shop)


def _replays_bit_by_bit(shop: Shop) -> None:
    folder = shop.config.store.directory / "windows"
    files = [file.path for file in list_windows(folder).windows]
    assert len(files) == 4
    replayed = fdhil("replay", "--config", shop.path, "--json", *files)
    assert replayed.returncode == 0, replayed.stderr
    document = json.loads(replayed.stdout)
    with History.read(shop.config.store.directory) as history:
        stored, revisions, skills = history.windows("X"), history.revisions("X"), history.skills("X")
    for file, window, revision, skill in zip(document["files"], stored, revisions, skills, strict=True):
        of = {outcome["kind"]: outcome for outcome in file["outcomes"]}
        unitless = {
            name: {key: value for key, value in told.items() if key != "unit"}
            for name, told in of["window"]["parameters"].items()
        }
        assert unitless == window.parameters
        assert of["window"]["fit_percent"] == window.fit_percent
        values = {name: told["value"] for name, told in of["parameters"]["parameters"].items()}
        assert values == revision.set.parameters.as_dict()
        assert of["skill"]["rms_um"] == skill.rms_um
    exported = fdhil("export", files[0], "--out", shop.folder / "window.csv")
    assert exported.returncode == 0, exported.stderr
    again = fdhil("replay", "--config", shop.path, "--json", shop.folder / "window.csv")
    assert json.loads(again.stdout)["validated"], again.stdout


def _history_is_told(shop: Shop) -> None:
    told = json.loads(fdhil("history", shop.path, "--json").stdout)
    assert [row["revision"] for row in told["revisions"]] == [1, 2, 3, 4]
    table = fdhil("history", shop.path)
    assert "axis X: 4 revisions" in table.stdout
    stopped = fdhil("status", shop.path)
    assert stopped.returncode == 3
    assert "is not running" in stopped.stderr
