"""A program that is planned at once has rows in the drives' increments; what was refused has none."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest

from fdhil import correction
from fdhil.arming.preparing import Refused
from fdhil.arming.program_check import encoded
from fdhil.config import MachineConfig, parse
from fdhil.prediction.models import nominal_models
from tests.arming.test_preparing import whole
from tests.bench import bench_config, bench_document
from tests.daemon.machine import config_of
from tests.paths import bench_trajectory


@pytest.fixture
def config(tmp_path: Path) -> MachineConfig:
    """The bench, two axes, writing allowed."""
    return config_of(tmp_path, ("X", "Y"))


def test_rows_are_in_the_drives_increments_and_sign() -> None:
    """Demand and offset are rounded, and turned where the drive counts against the axis."""
    document = copy.deepcopy(bench_document())
    document["axis"]["Y"]["drive"] = {"sign": -1}
    config = parse(document)
    planned = correction.plan(bench_trajectory(10), nominal_models(config), config, "mirror")
    position = planned.before.reference.position_mm
    rows = np.frombuffer(encoded(position, planned.offset_um, config), "<i4").reshape(-1, 4)
    per_mm = 65536 / 20
    assert np.array_equal(rows[:, 0], np.rint(position["X"] * per_mm))
    assert np.array_equal(rows[:, 3], np.rint(-planned.offset_um["Y"] * 1e-3 * per_mm))


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e9])
def test_what_is_no_increment_is_no_row(wrong: float) -> None:
    rows = {axis: np.array([0.0, wrong]) for axis in "XY"}
    with pytest.raises(ValueError, match="not finite, or too large"):
        encoded(rows, rows, bench_config())


def test_what_was_refused_has_no_rows(config: MachineConfig, tmp_path: Path) -> None:
    program = tmp_path / "dwell.ngc"
    program.write_text("G4 P0.2\nM2\n")
    refused = whole(program, config)
    assert isinstance(refused, Refused)
    assert refused.reasons[0].code == "NoGain"
