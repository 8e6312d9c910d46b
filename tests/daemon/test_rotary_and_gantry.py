"""Machines with a rotary and a gantry axis: record, identify, predict, correct, measure again."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.loop import compute_true_parameters, read_trace
from fdhil.cli.demo.machines import load_machine_document
from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.prediction import compute_contour_error_um, predict_path
from fdhil.program import load_trajectory
from fdhil.records import Parameters, compute_rms, compute_table_path
from fdhil.store.history_database import History
from tests.bench import rotary_axis
from tests.drivers.peer import DrivePeer
from tests.machine.complete_machine import CompleteMachine
from tests.short_waits import shorten_waits

pytestmark = pytest.mark.usefixtures("long_computation")


@dataclass(frozen=True)
class Whole:
    """Results of a machine: identified and true parameters, contour error predicted and measured (um RMS)."""

    found: Mapping[str, Parameters]
    true: Mapping[str, Parameters]
    predicted_um: float
    measured_um: float
    corrected_um: float
    notices: tuple[str, ...]


def program_of(lines: str) -> str:
    return lines.replace("|", "\n") + "\nM2\n"


@contextmanager
def shuttled(folder: Path, document: dict[str, Any], shuttle: str) -> Iterator[CompleteMachine]:
    with CompleteMachine(config=document | on_a_bus("memory"), folder=folder) as machine:
        machine.start_processes("guard")
        machine.start_processes("daemon")
        machine.switch_nc(on=True)
        machine.play_program(program_of(shuttle), "shuttle.ngc")
        machine.run_for(1.0)
        yield machine


def on_a_bus(channel: str) -> dict[str, Any]:
    return {"bus": {"can0": {"interface": "virtual", "channel": channel}}}


def run(folder: Path, document: dict[str, Any], path: str, shuttle: str) -> Whole:
    with shuttled(folder, document, shuttle) as machine:
        config, program = machine.config, machine.write_program(program_of(path), "path.ngc")
        with History.open_read_only(config.store.directory) as history:
            found = {axis: history.read_revisions(axis, limit=1)[0].set.parameters for axis in config.axis}
        predicted = predict_path(load_trajectory(program, config), found, config)
        measured_um = cut(machine, path)
        answer = machine.arm_program(program, method="inverse")
        assert answer["ok"], answer
        corrected_um = cut(machine, path)
        machine.run_for(1.0)
        status = machine.request_daemon("status")
        assert status["guard"]["cause"]["code"] == "Finished"
        assert machine.wrong == []
        notices = tuple(notice["text"] for notice in status["notices"])
        return Whole(found, compute_true_parameters(config), predicted.rms_um, measured_um, corrected_um, notices)


def cut(machine: CompleteMachine, path: str) -> float:
    trace = machine.folder / "trace.csv"
    machine.plant.record_next_file(trace)
    machine.play_program(program_of(path), "path.ngc")
    axes = tuple(machine.config.axis)
    reference, table = (compute_table_path(axes, rows) for rows in read_trace(trace, axes))
    return compute_rms(compute_contour_error_um(reference, table, 0.001))


def machine(*axes: str) -> dict[str, Any]:
    document = load_machine_document()
    for table in (document["axis"], document["sim"]["axis"]):
        for axis in [*table]:
            if axis not in axes:
                del table[axis]
    return document


def check(whole: Whole) -> None:
    for axis, found in whole.found.items():
        for name in ("R", "L", "K", "Jt", "ft", "Cd"):
            assert getattr(found, name) == pytest.approx(getattr(whole.true[axis], name), rel=0.02), (axis, name)
    assert whole.measured_um == pytest.approx(whole.predicted_um, rel=0.1)
    assert whole.corrected_um < whole.measured_um / 20
    assert not any("apart" in text for text in whole.notices)


def rotary() -> dict[str, Any]:
    document = machine("X")
    document["axis"]["A"] = rotary_axis()
    document["sim"]["axis"]["A"] = {"Jt": 0.082, "Cd": 5.5, "start_deg": 0.0}
    return document


def test_rotary_axis_is_identified_and_corrected(tmp_path: Path) -> None:
    shuttle = "|G4 P0.25|".join(["G0 X400 A224", "G0 X0 A0", "G0 X300 A168", "G0 X0 A0", ""])
    check(run(tmp_path, rotary(), "F1500|G1 X30 A40|X60 A0|X80 A60|X0 A0", shuttle))


GANTRY = "F10000|G1 Y55|X100|G3 X200 I50|G1 X250|Y0"
GANTRY_SHUTTLE = "|G4 P0.25|".join(["G0 X400 Y400", "G0 X0 Y0", "G0 X250 Y250", "G0 X0 Y0", ""])


def gantry(**second: Any) -> dict[str, Any]:
    document = machine("X", "Y")
    document["axis"]["Y2"] = {"drive": {"sign": -1}, **second}
    document["sim"]["axis"]["Y2"] = {"Jt": 0.085, "R": 0.52}
    return document


def test_each_gantry_drive_is_identified_and_corrected_by_its_own_model(tmp_path: Path) -> None:
    whole = run(tmp_path, gantry(), GANTRY, GANTRY_SHUTTLE)
    check(whole)
    assert np.abs(whole.found["Y"].Jt - whole.found["Y2"].Jt) > 0.008


def test_skewed_gantry_ends_the_correction(tmp_path: Path) -> None:
    with shuttled(tmp_path, gantry(max_difference_um=2.0), GANTRY_SHUTTLE) as machine:
        assert any(
            "the drives Y and Y2 are" in notice["text"] for notice in machine.request_daemon("status")["notices"]
        )
        answer = machine.arm_program(machine.write_program(program_of(GANTRY), "path.ngc"), method="inverse")
        assert answer["ok"], answer
        for unit in machine.plant.units.values():
            unit.set_temperature(26.0)
        machine.play_program(program_of(GANTRY), "path.ngc")
        status = machine.request_daemon("status")
        assert status["state"] == "OFF"
        assert status["guard"]["cause"]["code"] != "Finished"
        assert machine.wrong == []


@pytest.mark.parametrize("document", [rotary(), gantry()], ids=["rotary", "gantry"])
def test_each_drive_is_commissioned(document: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_waits(monkeypatch)
    config = machine_config.parse_config(document | on_a_bus(uuid.uuid4().hex))
    with ExitStack() as peers:
        for axis in config.axis:
            peers.enter_context(DrivePeer(config, axis))
        for axis in config.axis:
            record = commission_axis(config, axis)
            assert record.readback_ok
            assert record.offset_in_feedforward
            assert record.watchdog == "proven"
            assert record.sign_test_um == pytest.approx(10.0, rel=0.2)
