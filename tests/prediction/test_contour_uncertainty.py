"""The prediction's own uncertainty against drawn plants, and which parameter drives which zone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.prediction import predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.prediction.contour_uncertainty import compute_contour_std_um, compute_sensitivity_um
from fdhil.records import PARAMETERS, Parameters
from tests.bench import bench_config
from tests.paths import build_bench_trajectory

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)
RELATIVE = np.array([0.001, 0.003, 0.0005, 0.005, 0.04, 0.04])
VALUES = np.array([getattr(MODELS["X"], name) for name in PARAMETERS])
COVARIANCE = np.diag((RELATIVE * VALUES) ** 2)
COVARIANCE[4, 5] = COVARIANCE[5, 4] = -0.9 * np.sqrt(COVARIANCE[4, 4] * COVARIANCE[5, 5])


@pytest.mark.usefixtures("long_computation")
def test_contour_std_matches_sampled_plants() -> None:
    """Away from the path the contour error scatters as predicted, within the error of 60 draws.

    95 % of the draws are within 1.96 of it.
    """
    reference = build_bench_trajectory(10)
    reported = compute_contour_std_um(reference, MODELS, {"X": COVARIANCE, "Y": COVARIANCE}, CONFIG)
    random = np.random.default_rng(5)
    drawn = []
    for _ in range(60):
        plants = {axis: Parameters(*random.multivariate_normal(VALUES, COVARIANCE)) for axis in "XY"}
        drawn.append(predict_path(reference, plants, CONFIG).contour_um)
    nominal = predict_path(reference, MODELS, CONFIG).contour_um
    scatter = np.std(drawn, axis=0)
    large = (nominal > 20) & (scatter > 0.05)
    assert large.sum() > 100
    assert np.median(reported[large] / scatter[large]) == pytest.approx(1.0, abs=0.2)
    within = np.abs(np.array(drawn) - nominal)[:, large] <= 1.96 * reported[large]
    assert 0.90 < within.mean() < 0.99


def test_exact_model_has_no_uncertainty() -> None:
    """Covariances of 0 or NaN (an undetermined parameter, taken as known) add nothing."""
    reference = build_bench_trajectory(10)
    assert (
        compute_contour_std_um(reference, MODELS, {"X": np.zeros((6, 6)), "Y": np.full((6, 6), np.nan)}, CONFIG).max()
        == 0.0
    )


def test_inertia_dominates_corners() -> None:
    """At the corners the inertia has the largest effect: that of a prediction with 1 % more."""
    reference = build_bench_trajectory(10)
    prediction = predict_path(reference, MODELS, CONFIG)
    sensitivities = compute_sensitivity_um(prediction, MODELS, CONFIG)
    assert len(sensitivities) == len(prediction.zones)
    corner = next(k for k, zone in enumerate(prediction.zones) if zone.cause == "corner")
    ranked = sensitivities[corner]["Y"]
    assert max(ranked, key=lambda name: abs(ranked[name])) in ("Jt", "K")
    zone = prediction.zones[corner]
    rows = (reference.time_s >= zone.start_s) & (reference.time_s < zone.end_s)
    more = predict_path(reference, MODELS | {"Y": replace(MODELS["Y"], Jt=0.075 * 1.01)}, CONFIG)
    assert ranked["Jt"] == pytest.approx(more.contour_um[rows].max() - zone.max_um, abs=0.05)


def test_terms_add_to_uncertainty() -> None:
    """Falling friction known to 0.5 N.m adds its effect; a covariance of the six alone omits it."""
    reference = build_bench_trajectory(10)
    models = {axis: MODELS[axis].replace_values(stribeck=1.0, stribeck_speed=10.0) for axis in "XY"}
    six, eight = np.zeros((6, 6)), np.zeros((8, 8))
    eight[6, 6] = 0.25
    assert compute_contour_std_um(reference, models, {"X": six, "Y": six}, CONFIG).max() == 0.0
    reported = compute_contour_std_um(reference, models, {"X": eight, "Y": eight}, CONFIG)
    less, more = ({axis: models[axis].replace_values(stribeck=nm) for axis in "XY"} for nm in (0.95, 1.05))
    small, large = (predict_path(reference, changed, CONFIG).error_um for changed in (less, more))
    moved = [(large[axis][600:700] - small[axis][600:700]) * 0.5 / 0.1 for axis in "XY"]
    # on the straight along X what is across the path is Y's
    assert reported[600:700] == pytest.approx(np.abs(moved[1]), rel=0.2, abs=0.02)
    assert reported.max() > 1.0


def test_dominant_term_of_zone_is_named() -> None:
    reference = build_bench_trajectory(10)
    rich = MODELS["X"].replace_values(stribeck=2.0, stribeck_speed=10.0, ripple_screw_1=0.5, ripple_screw_1_phase=1.0)
    models = {"X": rich, "Y": MODELS["Y"]}
    prediction = predict_path(reference, models, CONFIG)
    for zone in compute_sensitivity_um(prediction, models, CONFIG):
        assert set(zone["X"]) == {*PARAMETERS, "stribeck", "ripple_screw_1"}
        assert set(zone["Y"]) == set(PARAMETERS)
