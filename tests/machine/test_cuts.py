"""A complete machine on virtual time: corrected cuts stay within their prediction, for any length."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.prediction import compute_contour_error_um
from tests.machine.complete_machine import CompleteMachine
from tests.machine.invariants import InvariantChecker

ROUND = "G1 X60 F8000\nG1 Y40\nG1 X0\nG1 Y0\n"
Begin = Callable[[], CompleteMachine]


def build_part(rounds: int) -> str:
    """Return a program of this number of rounds."""
    return f"G21 G90 G94\nG4 P0.2\n{ROUND * rounds}G4 P0.2\nM2\n"


def cut_part(machine: CompleteMachine, program: str, name: str) -> float:
    """Cut a program; return the RMS contour error at the table, um."""
    trace = machine.folder / f"{name}.csv"
    machine.plant.record_next_file(trace)
    machine.play_program(program, name)
    rows = np.genfromtxt(trace, delimiter=",", names=True)
    reference, table = (np.column_stack([rows[f"{axis}_{of}_mm"] for axis in "XY"]) for of in ("reference", "table"))
    return float(np.sqrt(np.mean(compute_contour_error_um(reference, table, 1e-3) ** 2)))


def read_pass(machine: CompleteMachine) -> dict[str, Any]:
    """Return the daemon's measurement of the last pass."""
    machine.run_for(1.0)
    measured: dict[str, Any] = machine.request_daemon("status")["passes"][-1]
    return measured


def test_correction_of_cut_matches_prediction_and_measurement(start_machine: Begin) -> None:
    machine = start_machine()
    judge = InvariantChecker(machine)
    answer = machine.arm_program(machine.write_program(build_part(1), "part.ngc"))
    assert answer["ok"], answer
    assert cut_part(machine, build_part(1), "part.ngc") < 0.1 * answer["before"]["rms_um"]
    last = read_pass(machine)
    assert last["ended_by"] == "Finished"
    assert last["measured"]["rms_um"] < answer["after"]["rms_um"] + answer["after"]["uncertainty_um"]
    assert judge.check_status()["state"] == "OFF"
    assert machine.wrong == []
    reported = re.findall(r"OFF -> ARMED|Armed: armed|ARMED -> ACTIVE|PassMeasured: ", machine.log.getvalue())
    assert reported == ["OFF -> ARMED", "Armed: armed", "ARMED -> ACTIVE", "PassMeasured: "]  # as it happened


@pytest.mark.usefixtures("long_computation")
def test_program_longer_than_ring_is_corrected_to_its_end(start_machine: Begin) -> None:
    machine = start_machine()
    InvariantChecker(machine)
    answer = machine.arm_program(machine.write_program(build_part(7), "long.ngc"))
    assert answer["ok"], answer
    assert answer["streamed"] is True
    assert answer["rows"] > 11_000
    assert answer["before"]["rms_um"] > 20 * cut_part(machine, build_part(7), "long.ngc")
    assert read_pass(machine)["ended_by"] == "Finished"  # never interrupted
    assert machine.wrong == []


def test_long_program_is_refused_at_line_that_drives_cannot_follow(start_machine: Begin) -> None:
    lines = build_part(14).splitlines()
    lines[35:37] = ["G1 Y400 F60000", "G1 X-400", "G1 X0 Y40 F8000"]
    machine = start_machine()
    answer = machine.arm_program(machine.write_program("\n".join(lines) + "\n", "hard.ngc"))
    assert answer["code"] == "DemandTooHigh", answer
    assert re.search(r"line 3[67], at \d+\.\d+ s: axis [XY] is at", answer["text"]), answer
    assert answer["text"].endswith("no offset can help"), answer
    assert answer["advice"].startswith("lower the feed"), answer


def test_disarm_during_cut_is_answered_at_zero_offset(start_machine: Begin) -> None:
    machine = start_machine()
    judge = InvariantChecker(machine)
    assert machine.arm_program(machine.write_program(build_part(2), "part.ngc"))["ok"]
    machine.play_program(build_part(2), "part.ngc", wait=False)
    machine.run_until(lambda: any(machine.read_offset_um().values()))
    assert machine.request_daemon("disarm") == {
        "ok": True,
        "text": "guard: OFF, offset 0",
        "state": "OFF",
        "may_stand_um": {"X": 0.0, "Y": 0.0},
    }
    assert not any(machine.read_offset_um().values())
    assert judge.check_status()["armed"] is None
    assert machine.wrong == []


def test_drive_changed_by_sdo_is_not_armed_until_checked(start_machine: Begin) -> None:
    machine = start_machine()
    machine.send_frame(0x601, bytes.fromhex("2365600000800000"))  # the following error window, to what it was
    machine.run_for(1.2)
    path: Path = machine.write_program(build_part(1), "part.ngc")
    refused = machine.arm_program(path)
    assert (refused["code"], refused["axis"]) == ("RecordVoid", "X"), refused
    assert any(notice["code"] == "RecordVoid" for notice in machine.request_daemon("status")["notices"])
    machine.attest_facts()
    machine.run_for(0.6)
    assert machine.arm_program(path)["ok"]
