"""``fdhil record`` with the simulator, both as processes on the hub."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil.program import load_trajectory
from fdhil.records import Float, Trajectory
from tests.sim.simulator_process import SimulatorProcess, write_config

pytestmark = pytest.mark.usefixtures("processes")

PROGRAM = "G61 G1 X12 F6000\nG3 X24 Y12 J12\nG1 Y20\nG4 P0.2\nG0 X0 Y0\nM2\n"
NC = '[nc]\nprofile = "jerk_limited"\n'


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[SimulatorProcess, Path]]:
    folder = tmp_path_factory.mktemp("twin")
    path = write_config(folder, sim="modbus = false")
    path.write_text(path.read_text() + NC)
    with SimulatorProcess(path) as process:
        place = process.ready["buses"]["can0"]
        joined = write_config(folder, bus=f'interface = "socketcand"\nport = {place["port"]}')
        joined.write_text(joined.read_text() + NC)
        process.send_command("nc", on=True)
        process.wait_for_event("nc")
        yield process, joined


class Recording:
    def __init__(self, config: Path, out: Path, *options: str) -> None:
        command = [sys.executable, "-m", "fdhil.cli.main", "record", str(config), "--out", str(out), "--json", *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        assert "waiting" in self.process.stderr.readline()

    def end(self) -> tuple[int, dict[str, object]]:
        stdout, _ = self.process.communicate()
        return self.process.returncode, json.loads(stdout)


def convert_to_increments(reference: Trajectory) -> Float:
    return np.round(np.column_stack(list(reference.position_mm.values())) * (65536 / 20))


def test_recorded_demand_equals_program_to_the_increment(
    simulator: tuple[SimulatorProcess, Path], tmp_path: Path
) -> None:
    process, config = simulator
    program, out = tmp_path / "program.ngc", tmp_path / "demand.csv"
    program.write_text(PROGRAM)
    recording = Recording(config, out, "--rest", "0.6")
    process.send_command("play", file=str(program))
    code, document = recording.end()
    assert (code, document["complete"], document["gaps"]) == (0, True, []), document
    machine = configuration.load_config(config)
    ordered, received = (
        convert_to_increments(load_trajectory(program, machine)),
        convert_to_increments(load_trajectory(out, machine)),
    )
    first = int(np.flatnonzero(np.abs(np.diff(ordered, axis=0)).max(axis=1))[0])  # the first increment that moves
    rows = min(len(received), len(ordered) - first)
    assert rows > len(ordered) - 60
    np.testing.assert_array_equal(received[:rows], ordered[first : first + rows])


def test_recording_without_motion_writes_nothing(simulator: tuple[SimulatorProcess, Path], tmp_path: Path) -> None:
    out = tmp_path / "demand.csv"
    recording = Recording(simulator[1], out)
    recording.process.send_signal(signal.SIGINT)
    code, document = recording.end()
    assert (code, document["rows"], document["file"]) == (1, 0, None)
    assert document["doubts"] == ["nothing moved; start the program on the NC while the recording waits"]
    assert not out.exists()


def test_demand_with_gap_is_not_written(simulator: tuple[SimulatorProcess, Path], tmp_path: Path) -> None:
    process, config = simulator
    program, out = tmp_path / "program.ngc", tmp_path / "demand.csv"
    program.write_text("G1 X12 Y12 F6000\nM2\n")
    recording = Recording(config, out, "--rest", "0.3")
    process.send_command("fault", axis="X", fault="drop_tpdo", value=1, duration_s=0.005, at_row=60)
    process.send_command("play", file=str(program))
    code, document = recording.end()
    assert code == 1, document
    assert not document["complete"]
    gaps = document["gaps"]
    assert isinstance(gaps, list)
    assert gaps[0]["axis"] == "X"
    assert 1 <= gaps[0]["rows"] <= 10
    assert not out.exists()
