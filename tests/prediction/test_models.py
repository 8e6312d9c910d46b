"""Model files: what is wrong is said, all at once, as a config error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.errors import ConfigError
from fdhil.prediction.models import load_models, models_for, nominal_models
from tests.bench import bench_config
from tests.paths import trajectory

GOOD: dict[str, Any] = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.0, "Cd": 5}


def write(folder: Path, text: str) -> Path:
    """Write a model file."""
    path = folder / "m.json"
    path.write_text(text)
    return path


def test_reads_what_it_should(tmp_path: Path) -> None:
    """Six numbers per axis; a friction may be 0."""
    models = load_models(write(tmp_path, json.dumps({"X": GOOD, "Y": GOOD})))
    assert models["X"].Cd == 5.0
    assert set(models) == {"X", "Y"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": -1}, "X.R: must be above 0"),
        ({"L": 0}, "X.L: must be above 0"),
        ({"Cd": -0.1}, "X.Cd: must be at least 0"),
        ({"K": float("nan")}, "X.K: must be a finite number"),
        ({"K": 10**400}, "X.K: must be a finite number"),
        ({"Jt": None}, "X.Jt: must be a number, not None"),
        ({"ft": True}, "X.ft: must be a number"),
        ({"J": 0.07}, "did you mean 'Jt'"),
    ],
)
def test_names_the_fault(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    """Each wrong value is named with its axis and key."""
    with pytest.raises(ConfigError) as caught:
        load_models(write(tmp_path, json.dumps({"X": GOOD | change})))
    assert message in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"X": 3}', "no json", '{"X": {"R": 1}}', "[" * 100_000])
def test_refuses_other_files(tmp_path: Path, text: str) -> None:
    """What is no model file is a config error, never another exception."""
    with pytest.raises(ConfigError):
        load_models(write(tmp_path, text))


def test_all_faults_at_once(tmp_path: Path) -> None:
    """Not only the first fault is told."""
    with pytest.raises(ConfigError) as caught:
        load_models(write(tmp_path, json.dumps({"X": {"R": -1}, "Y": 2})))
    assert len(caught.value.faults) == 7


def test_an_axis_that_stands_still_needs_no_model() -> None:
    """Only an axis that moves must have been identified."""
    config = bench_config()
    demand = np.column_stack([np.linspace(0, 1, 10), np.zeros(10)])
    nominal = nominal_models(config)
    assert set(models_for(trajectory(demand), {"X": nominal["X"]}, config, "m.json")) == {"X", "Y"}
    with pytest.raises(ConfigError, match="X: moves and has no model"):
        models_for(trajectory(demand), {"Y": nominal["Y"]}, config, "m.json")
