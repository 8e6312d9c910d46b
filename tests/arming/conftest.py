"""Fixtures of the arming tests: a guard peer, a corner, and its planned correction."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from fdhil import correction
from fdhil.config import MachineConfig
from fdhil.program import load_trajectory
from fdhil.records import Correction
from tests.arming.machine_peer import MachinePeer
from tests.arming.test_arm_plan import GENTLE
from tests.store.sample_records import make_published


@pytest.fixture
def machine_peer(config: MachineConfig) -> Iterator[MachinePeer]:
    assert config.store.run_directory is not None
    config.store.run_directory.mkdir(parents=True)
    made = MachinePeer(config.store.run_directory)
    yield made
    made.close()


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "gentle.ngc"
    path.write_text(GENTLE)
    return path


@pytest.fixture
def planned(config: MachineConfig, program: Path) -> Correction:
    models = {axis: make_published().parameters for axis in "XY"}
    return correction.plan_correction(load_trajectory(program, config), models, config)
