"""A complete machine on virtual time: corrected cuts stay within their prediction, for any length."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.prediction import contour_error_um
from tests.machine.invariants import Judge
from tests.machine.whole_machine import Machine

ROUND = "G1 X60 F8000\nG1 Y40\nG1 X0\nG1 Y0\n"
Begin = Callable[[], Machine]


def part(rounds: int) -> str:
    """Return a program of this number of rounds."""
    return f"G21 G90 G94\nG4 P0.2\n{ROUND * rounds}G4 P0.2\nM2\n"


def cut(machine: Machine, program: str, name: str) -> float:
    """Cut a program; return the RMS contour error at the table, um."""
    trace = machine.folder / f"{name}.csv"
    machine.plant.trace(trace)
    machine.play(program, name)
    rows = np.genfromtxt(trace, delimiter=",", names=True)
    reference, table = (np.column_stack([rows[f"{axis}_{of}_mm"] for axis in "XY"]) for of in ("reference", "table"))
    return float(np.sqrt(np.mean(contour_error_um(reference, table, 1e-3) ** 2)))


def passed(machine: Machine) -> dict[str, Any]:
    """Return the daemon's measurement of the last pass."""
    machine.run(1.0)
    measured: dict[str, Any] = machine.ask("status")["passes"][-1]
    return measured


def test_a_cut_is_corrected_as_predicted_and_measured_by_the_daemon(begin: Begin) -> None:
    machine = begin()
    judge = Judge(machine)
    answer = machine.arm(machine.write(part(1), "part.ngc"))
    assert answer["ok"], answer
    assert cut(machine, part(1), "part.ngc") < 0.1 * answer["before"]["rms_um"]
    last = passed(machine)
    assert last["ended_by"] == "Finished"
    assert last["measured"]["rms_um"] < answer["after"]["rms_um"] + answer["after"]["uncertainty_um"]
    assert judge.status()["state"] == "OFF"
    assert machine.wrong == []
    told = re.findall(r"OFF -> ARMED|Armed: armed|ARMED -> ACTIVE|PassMeasured: ", machine.log.getvalue())
    assert told == ["OFF -> ARMED", "Armed: armed", "ARMED -> ACTIVE", "PassMeasured: "]  # as it happened


@pytest.mark.usefixtures("long_computation")
def test_a_program_longer_than_the_ring_is_corrected_to_its_end(begin: Begin) -> None:
    machine = begin()
    Judge(machine)
    answer = machine.arm(machine.write(part(7), "long.ngc"))
    assert answer["ok"], answer
    assert answer["streamed"] is True
    assert answer["rows"] > 11_000
    assert answer["before"]["rms_um"] > 20 * cut(machine, part(7), "long.ngc")
    assert passed(machine)["ended_by"] == "Finished"  # never interrupted
    assert machine.wrong == []


def test_a_long_program_is_refused_by_the_line_that_no_drive_can_follow(begin: Begin) -> None:
    lines = part(14).splitlines()
    lines[35:37] = ["G1 Y400 F60000", "G1 X-400", "G1 X0 Y40 F8000"]
    machine = begin()
    answer = machine.arm(machine.write("\n".join(lines) + "\n", "hard.ngc"))
    assert answer["code"] == "DemandTooHigh", answer
    assert re.search(r"line 3[67], at \d+\.\d+ s: axis [XY] is at", answer["text"]), answer
    assert answer["text"].endswith("no offset can help"), answer
    assert answer["advice"].startswith("lower the feed"), answer


def test_an_operator_who_disarms_in_the_cut_is_answered_at_zero(begin: Begin) -> None:
    machine = begin()
    judge = Judge(machine)
    assert machine.arm(machine.write(part(2), "part.ngc"))["ok"]
    machine.play(part(2), "part.ngc", wait=False)
    machine.run_until(lambda: any(machine.held_um().values()))
    assert machine.ask("disarm") == {
        "ok": True,
        "text": "guard: OFF, offset 0",
        "state": "OFF",
        "may_stand_um": {"X": 0.0, "Y": 0.0},
    }
    assert not any(machine.held_um().values())
    assert judge.status()["armed"] is None
    assert machine.wrong == []


def test_a_drive_that_was_written_to_is_not_armed_until_it_is_compared(begin: Begin) -> None:
    machine = begin()
    machine.send(0x601, bytes.fromhex("2365600000800000"))  # the following error window, to what it was
    machine.run(1.2)
    path: Path = machine.write(part(1), "part.ngc")
    refused = machine.arm(path)
    assert (refused["code"], refused["axis"]) == ("RecordVoid", "X"), refused
    assert any(notice["code"] == "RecordVoid" for notice in machine.ask("status")["notices"])
    machine.attest()
    machine.run(0.6)
    assert machine.arm(path)["ok"]
