"""Where a drive's speed set-point steps at every SYNC, readings of the current are moved to its means, or doubted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdhil.cli.batch import analyse_file
from fdhil.config import Identification, load_config
from fdhil.identification.current_means import reading_lag
from studies.zoo.examination import write_machine
from studies.zoo.machines import KINDS, machine
from studies.zoo.plant import run

SETTINGS = Identification()


def _kind(name: str):  # type: ignore[no-untyped-def]
    return next(kind for kind in KINDS if name in kind.name)


@pytest.mark.parametrize("name", ["1 ms SYNC, stepping", "2 ms SYNC, stepping", "ordinary screw", "NC trace"])
def test_inertia_is_right_whether_set_points_step_or_not(name: str, tmp_path: Path) -> None:
    axes = machine(_kind(name), 3)
    write_machine(tmp_path, axes, 3)
    found = analyse_file(tmp_path / "X.csv", SETTINGS, load_config(tmp_path / "machine.toml"))
    assert found.estimate is not None
    assert found.verdict.accepted
    error = found.estimate.value("Jt") - axes["X"].truth()["Jt"]
    assert abs(error) < min(0.03 * axes["X"].truth()["Jt"], 3.0 * found.estimate.std("Jt"))


def test_lag_of_readings_is_that_of_a_drive_that_steps() -> None:
    axis = machine(_kind("2 ms SYNC, stepping"), 3)["X"]
    period_s = axis.kind.period_s
    moved = run(axis.plant, axis.drive, axis.kind.rapids.train(period_s), period_s)
    section = load_config_of(axis)
    acceleration = np.gradient(moved.speed, period_s)
    fast = np.abs(acceleration) > 0.9 * np.abs(acceleration).max()
    beyond = (moved.current_mean - moved.current)[fast] @ acceleration[fast] / (acceleration[fast] @ acceleration[fast])
    assert reading_lag(section, period_s) == pytest.approx(beyond, rel=0.3)
