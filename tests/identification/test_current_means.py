"""Where a drive's speed set-point steps at every SYNC, current readings are corrected to means."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdhil.api.analysis import FileResult
from fdhil.cli.batch import analyse_file
from fdhil.config import Identification
from fdhil.config.config_loader import load_config
from fdhil.identification.current_means import reading_lag
from studies.zoo.examination import write_machine
from studies.zoo.machines import KINDS, Axis, machine
from studies.zoo.plant import run


def _axis(name: str) -> Axis:
    return machine(next(kind for kind in KINDS if name in kind.name), 3)["X"]


def _identified(axis: Axis, folder: Path) -> FileResult:
    write_machine(folder, {"X": axis}, 3)
    return analyse_file(folder / "X.csv", Identification(), load_config(folder / "machine.toml"))


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("name", ["1 ms SYNC, stepping", "2 ms SYNC, stepping", "NC trace"])
def test_inertia_is_right_whether_set_points_step_or_not(name: str, tmp_path: Path) -> None:
    axis = _axis(name)
    estimates = [o.estimate for o in _identified(axis, tmp_path).outcomes if o.estimate is not None]
    assert len(estimates) == 6
    for estimate in estimates:
        error = abs(estimate.get_value("Jt") - axis.plant.Jt)
        assert error < 0.03 * axis.plant.Jt
        assert error < 4.0 * estimate.get_std("Jt")


def test_lag_of_readings_is_that_of_a_drive_that_steps(tmp_path: Path) -> None:
    axis = _axis("2 ms SYNC, stepping")
    period_s = axis.kind.period_s
    moved = run(axis.plant, axis.drive, axis.kind.rapids.train(period_s), period_s)
    acceleration = np.gradient(moved.speed, period_s)
    steady = np.abs(acceleration) > 0.9 * np.abs(acceleration).max()
    beyond = (moved.current_mean - moved.current)[steady] / acceleration[steady]
    write_machine(tmp_path, {"X": axis}, 3)
    section = load_config(tmp_path / "machine.toml").axis["X"]
    assert reading_lag(section, period_s) == pytest.approx(float(np.median(beyond)), rel=0.2)


def test_values_of_the_peak_of_a_phase_are_named_and_refused(tmp_path: Path) -> None:
    found = _identified(_axis("phase-peak"), tmp_path)
    assert not found.verdict.accepted
    assert any("peak values of a phase" in reason.text for reason in found.verdict.reasons)


def test_pool_without_a_data_sheet_says_that_its_scale_is_unproven(tmp_path: Path) -> None:
    axis = _axis("phase-peak")
    write_machine(tmp_path, {"X": axis}, 3)
    found = analyse_file(tmp_path / "X.csv", Identification())
    assert "ScaleUnproven" in [warning.code for warning in found.verdict.warnings]


def test_interval_of_the_winding_contains_axes_that_are_not_quite_parted(tmp_path: Path) -> None:
    axis = _axis("ordinary screw")
    coupled = replace(axis, drive=axis.drive._replace(decoupling=0.7))
    found = _identified(coupled, tmp_path)
    assert found.pooled is not None
    for name, true in coupled.truth().items():
        assert abs(found.pooled.get_value(name) - true) < 3.0 * found.pooled.get_std(name), name
