"""Every model that identify validates, of a window or a pool, is usable by predict, correct and arm, on any drive."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import correction
from fdhil.api.identification_json import build_file_document
from fdhil.api.recording_analysis import FileResult
from fdhil.cli.model_file import write_model
from fdhil.config import Identification
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.prediction import predict_path
from fdhil.prediction.axis_models import load_model_file, load_validated_models
from fdhil.records import PARAMETERS, Estimate, Result, Trajectory, Verdict, WindowOutcome
from studies import real_plant as real
from tests.bench import bench_config
from tests.identification.realistic_rapids import simulate_rapids
from tests.paths import build_trajectory, smooth_demand
from tests.store.sample_records import make_published
from tests.tiers import sampled

CONFIG = bench_config("X")
PLANTS = {
    "bench": real.Mechanics(),
    "weight above dry friction": real.Mechanics(Cd=1.0, load_nm=5.8),
    "weight pulls up": real.Mechanics(Cd=2.0, load_nm=-6.0),
    "no viscous friction": real.Mechanics(ft=0.0),
    "hardly any dry friction": real.Mechanics(Cd=0.02),
    "no friction": real.Mechanics(ft=0.0, Cd=0.02),
    "sticks": real.Mechanics(static=0.3),
    "asymmetric": real.Mechanics(asymmetry=0.2, load_nm=1.0),
    "ordinary": real.ORDINARY_MECHANICS,
    "friction builds up": replace(real.SLOW, static=-0.25, static_speed_rad_s=20.0),
    "friction builds up from zero": replace(real.SLOW, static=-0.98, static_speed_rad_s=12.0),
    "slow axis that sticks": replace(real.SLOW, static=0.2, static_speed_rad_s=20.0),
    "slow weight above dry friction": replace(real.SLOW, load_nm=5.0),
}


def make_short_move() -> Trajectory:
    way = np.concatenate([np.linspace(0.0, 5.0, 60), np.linspace(5.0, 0.0, 60), np.zeros(180)])
    return build_trajectory(smooth_demand(way[:, None], (0.060, 0.030), 0.001), "X")


MOVE = make_short_move()


@cache
def identify_plant(plant: real.Mechanics) -> FileResult:
    loops = real.SLOW_LOOPS if plant.Jt < 0.05 else None
    outcomes = [
        analyse_window(window, Identification()) for window in simulate_rapids(plant, None, loops, moves=4, seed=3)
    ]
    estimate, verdict = pool_windows(outcomes, Identification())
    return FileResult("recording.csv", "X", tuple(outcomes), estimate, verdict)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.usefixtures("long_computation")
def test_most_random_plants_are_validated() -> None:
    assert sum(identify_plant(plant).verdict.accepted for plant in PLANTS.values()) >= 9


def load_model(told: dict[str, Any]) -> dict[str, Any]:
    six = {name: figures["value"] for name, figures in told["parameters"].items()}
    return {**six, "terms": {name: figures["value"] for name, figures in told["terms"].items()}}


@pytest.mark.parametrize("plant", sampled(PLANTS, every=4))
def test_validated_model_is_used(plant: str, tmp_path: Path) -> None:
    result = identify_plant(PLANTS[plant])
    document = build_file_document(result, {}, with_loops=False)
    reported = [each for each in (*document["windows"], document["pooled"]) if each["validated"]]
    path = tmp_path / "model.json"
    for each in reported:
        path.write_text(json.dumps({"X": load_model(each)}))
        predict_path(MOVE, load_model_file(path).parameters, CONFIG)
    if not result.verdict.accepted or result.pooled is None:
        return
    write_model([result], CONFIG.axis, path)
    written = load_model_file(path).parameters
    newest = replace(make_published(1, "X", result.pooled.build_parameters()), covariance=result.pooled.covariance)
    assert load_validated_models({"X": newest}, CONFIG, "store")[0] == written
    assert correction.plan_correction(MOVE, written, CONFIG).after.rms_um < 50.0


def test_pool_with_slightly_negative_friction_is_used(tmp_path: Path) -> None:
    """Each window hardly separates the friction from zero; together they have -6.4 +- 2.0 N.m at a Cd of 4.95."""
    names = (*PARAMETERS, "stribeck", "stribeck_speed")
    values = np.array([0.5, 0.005, 0.8, 0.075, 0.05, 4.95, -6.4, 8.0])
    covariance = np.diag([1e-8, 1e-10, 1e-8, 1e-10, 1e-6, 0.25, 2.8**2, 1.0])
    reported = Estimate("maximum_likelihood", names, values, covariance, {}, Result.OK)
    outcomes = [WindowOutcome(window, reported, Verdict(True, 99.0)) for window in simulate_rapids(moves=2)]
    estimate, verdict = pool_windows(outcomes, Identification())
    assert verdict.accepted
    assert estimate is not None
    assert estimate.get_value("Cd") == pytest.approx(4.95 + 1.45 / (1 + 2.8**2 / 0.25), rel=1e-3)
    path = tmp_path / "model.json"
    write_model([FileResult("recording.csv", "X", tuple(outcomes), estimate, verdict)], CONFIG.axis, path)
    written = load_model_file(path).parameters["X"]
    assert written.Cd + written.get_term("stribeck") == 0.0
    predict_path(MOVE, {"X": written}, CONFIG)
