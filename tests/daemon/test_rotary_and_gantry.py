"""A machine with a rotary axis and one with a gantry, whole: record, identify, predict, correct, measure again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.cli.demo import loop
from fdhil.cli.demo.machines import machine_document
from fdhil.cli.demo.report import Cut
from fdhil.prediction import contour_error_um, predict
from fdhil.program import load_trajectory
from fdhil.records import Float, Parameters, rms, table_path
from fdhil.store.history import History
from tests.bench import rotary_axis
from tests.daemon.shop import patient
from tests.machine.whole_machine import Machine


@dataclass(frozen=True)
class Whole:
    """What came of a machine: identified and true parameters, contour error predicted and measured (um RMS)."""

    found: Mapping[str, Parameters]
    true: Mapping[str, Parameters]
    predicted_um: float
    measured_um: float
    corrected_um: float
    notices: tuple[str, ...]


def program_of(lines: str) -> str:
    """Return a program of these lines."""
    return lines.replace("|", "\n") + "\nM2\n"


@contextmanager
def shuttled(out: Path, document: dict[str, Any], path: str, shuttle: str) -> Iterator[loop.Stage]:
    """Have the demonstration's stage of a machine that has made the rapids of ``shuttle``, with a program ``path``."""
    with patient(), loop.running(out, False, lambda _: None, document) as stage:
        stage.programs = {"10 m/min": out / "path.ngc", "shuttle": out / "shuttle.ngc"}
        for program, text in zip(stage.programs.values(), (path, shuttle), strict=True):
            program.write_text(program_of(text))
        loop.play_shuttle(stage)
        yield stage


def run(out: Path, document: dict[str, Any], path: str, shuttle: str) -> Whole:
    """Identify, predict, cut, correct and cut again."""
    with shuttled(out, document, path, shuttle) as stage:
        axes = tuple(stage.config.axis)
        with History.read(stage.config.store.directory) as history:
            found = {axis: history.revisions(axis, limit=1)[0].set.parameters for axis in axes}
        predicted = predict(load_trajectory(stage.programs["10 m/min"], stage.config), found, stage.config)
        loop.cut(stage, "uncorrected", 20.0)
        loop.cut(stage, "corrected", 20.0, "inverse")
        measured = [_contour_um(cut, axes) for cut in stage.cuts]
        notices = tuple(notice["text"] for notice in stage.ask("status")["notices"])
        return Whole(
            found, loop.true_plants(stage.config), predicted.rms_um, rms(measured[0]), rms(measured[1]), notices
        )


def _contour_um(cut: Cut, axes: tuple[str, ...]) -> Float:
    reference, table = (table_path(axes, rows) for rows in (cut.reference_mm, cut.table_mm))
    return contour_error_um(reference, table, 0.001)


def machine(*axes: str) -> dict[str, Any]:
    """Return the demonstration's machine with these of its axes."""
    document = machine_document()
    for table in (document["axis"], document["sim"]["axis"]):
        for axis in [*table]:
            if axis not in axes:
                del table[axis]
    return document


def check(whole: Whole) -> None:
    """What must come of any machine: true parameters, a prediction that is measured, a smaller error."""
    for axis, found in whole.found.items():
        for name in ("R", "L", "K", "Jt", "ft", "Cd"):
            assert getattr(found, name) == pytest.approx(getattr(whole.true[axis], name), rel=0.02), (axis, name)
    assert whole.measured_um == pytest.approx(whole.predicted_um, rel=0.1)
    assert whole.corrected_um < whole.measured_um / 20
    assert not any("apart" in text for text in whole.notices)


@pytest.mark.usefixtures("processes")
def test_rotary_table_is_a_feed_drive_like_any_other(tmp_path: Path) -> None:
    document = machine("X")
    document["axis"]["A"] = rotary_axis()
    document["sim"]["axis"]["A"] = {"Jt": 0.082, "Cd": 5.5, "start_deg": 0.0}
    rests = "|G4 P0.25|"
    shuttle = rests.join(["G0 X400 A224", "G0 X0 A0", "G0 X300 A168", "G0 X0 A0", ""])
    check(run(tmp_path, document, "F1500|G1 X30 A40|X60 A0|X80 A60|X0 A0", shuttle))


GANTRY = "F10000|G1 Y55|X100|G3 X200 I50|G1 X250|Y0"
GANTRY_SHUTTLE = "|G4 P0.25|".join(["G0 X400 Y400", "G0 X0 Y0", "G0 X250 Y250", "G0 X0 Y0", ""])


def gantry(**second: Any) -> dict[str, Any]:
    """Return the machine with a gantry axis whose second motor is another one, mounted the other way round."""
    document = machine("X", "Y")
    document["axis"]["Y2"] = {"drive": {"sign": -1}, **second}
    document["sim"]["axis"]["Y2"] = {"Jt": 0.085, "R": 0.52}
    return document


@pytest.mark.usefixtures("processes")
def test_both_drives_of_a_gantry_are_identified_and_corrected_each_by_its_own_model(tmp_path: Path) -> None:
    whole = run(tmp_path, gantry(), GANTRY, GANTRY_SHUTTLE)
    check(whole)
    assert np.abs(whole.found["Y"].Jt - whole.found["Y2"].Jt) > 0.008


@pytest.mark.usefixtures("long_computation")
def test_skewed_gantry_ends_the_correction(tmp_path: Path) -> None:
    """A correction makes both drives alike until the slide-way of one of them warms: then 2 um are too few."""
    document = gantry(max_difference_um=2.0) | {"bus": {"can0": {"interface": "virtual", "channel": "memory"}}}
    with Machine(config=document, folder=tmp_path) as machine:
        machine.start("guard")
        machine.start("daemon")
        machine.nc(on=True)
        machine.play(program_of(GANTRY_SHUTTLE), "shuttle.ngc")
        machine.run(1.0)
        assert any("the drives Y and Y2 are" in notice["text"] for notice in machine.ask("status")["notices"])
        answer = machine.arm(machine.write(program_of(GANTRY), "path.ngc"), method="inverse")
        assert answer["ok"], answer
        for unit in machine.plant.units.values():
            unit.warm(26.0)
        machine.play(program_of(GANTRY), "path.ngc")
        status = machine.ask("status")
        assert status["state"] == "OFF"
        assert status["guard"]["cause"]["code"] != "Finished"
        assert machine.wrong == []
