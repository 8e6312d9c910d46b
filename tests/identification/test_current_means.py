"""Where a drive's speed set-point steps at every SYNC, current readings are corrected to means."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdhil.api.recording_analysis import FileResult
from fdhil.cli.batch_analysis import analyse_file
from fdhil.config import Identification
from fdhil.config.config_loader import load_config
from fdhil.identification.current_means import simulate_reading_lag
from studies.zoo.examination import write_machine
from studies.zoo.machines import KINDS, Axis, machine
from studies.zoo.plant import run


def _build_axis(name: str) -> Axis:
    return machine(next(kind for kind in KINDS if name in kind.name), 3)["X"]


def _identify_axis(axis: Axis, folder: Path) -> FileResult:
    write_machine(folder, {"X": axis}, 3)
    return analyse_file(folder / "X.csv", Identification(), load_config(folder / "machine.toml"))


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("name", ["1 ms SYNC, stepping", "2 ms SYNC, stepping", "NC trace"])
def test_inertia_is_unbiased_with_and_without_stepping_set_points(name: str, tmp_path: Path) -> None:
    axis = _build_axis(name)
    estimates = [o.estimate for o in _identify_axis(axis, tmp_path).outcomes if o.estimate is not None]
    assert len(estimates) == 6
    for estimate in estimates:
        error = abs(estimate.get_value("Jt") - axis.plant.Jt)
        assert error < 0.03 * axis.plant.Jt
        assert error < 4.0 * estimate.get_std("Jt")


def test_reading_lag_matches_a_simulated_stepping_drive(tmp_path: Path) -> None:
    axis = _build_axis("2 ms SYNC, stepping")
    period_s = axis.kind.period_s
    moved = run(axis.plant, axis.drive, axis.kind.rapids.train(period_s), period_s)
    acceleration = np.gradient(moved.speed, period_s)
    steady = np.abs(acceleration) > 0.9 * np.abs(acceleration).max()
    beyond = (moved.current_mean - moved.current)[steady] / acceleration[steady]
    write_machine(tmp_path, {"X": axis}, 3)
    section = load_config(tmp_path / "machine.toml").axis["X"]
    assert simulate_reading_lag(section, period_s) == pytest.approx(float(np.median(beyond)), rel=0.2)


def test_peak_phase_values_are_refused_with_their_name(tmp_path: Path) -> None:
    found = _identify_axis(_build_axis("phase-peak"), tmp_path)
    assert not found.verdict.accepted
    assert any("peak values of a phase" in reason.text for reason in found.verdict.reasons)


def test_pool_without_data_sheet_warns_of_unproven_scale(tmp_path: Path) -> None:
    axis = _build_axis("phase-peak")
    write_machine(tmp_path, {"X": axis}, 3)
    found = analyse_file(tmp_path / "X.csv", Identification())
    assert "ScaleUnproven" in [warning.code for warning in found.verdict.warnings]


def test_winding_intervals_cover_imperfectly_decoupled_axes(tmp_path: Path) -> None:
    axis = _build_axis("ordinary screw")
    coupled = replace(axis, drive=axis.drive._replace(decoupling=0.7))
    found = _identify_axis(coupled, tmp_path)
    assert found.pooled is not None
    for name, true in coupled.truth().items():
        assert abs(found.pooled.get_value(name) - true) < 3.0 * found.pooled.get_std(name), name
