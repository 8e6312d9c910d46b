"""The on-line feed-forward: torque and speed offsets from the demand alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.correction import plan_correction
from fdhil.correction.flatness_feedforward import compute_feedforward_offsets
from fdhil.prediction import predict_corrected_path, predict_path
from fdhil.prediction.axis_models import build_nominal_models
from tests.bench import bench_config
from tests.correction.test_correction_planner import change_config
from tests.correction.test_inverse_correction import scatter_parameters
from tests.paths import build_bench_trajectory, compute_rms

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)


@pytest.mark.parametrize(("feed", "feedforward"), [(10, 1.0), (20, 1.0), (10, 0.5), (10, 0.0)])
def test_error_is_fifty_times_smaller_at_any_drive_feedforward(feed: float, feedforward: float) -> None:
    """Includes drives whose lag is too large for position offsets; position offsets stay 0."""
    config = change_config(speed_feedforward=feedforward)
    reference = build_bench_trajectory(feed)
    correction = plan_correction(reference, MODELS, config, "flatness")
    assert correction.refused == ()
    assert not any(offset.any() for offset in correction.offset_um.values())
    plants = scatter_parameters(3)
    before = predict_path(reference, plants, config).contour_um
    speed, torque = correction.speed_offset_rad_s, correction.torque_offset_nm
    after = predict_corrected_path(reference, plants, config, None, speed, torque).contour_um
    assert compute_rms(before) / compute_rms(after) > 50


def test_offsets_are_whole_counts_of_the_drive() -> None:
    """0x60B1 in increments per second, 0x60B2 in 0.1 % of the rated torque."""
    axis = CONFIG.axis["X"]
    speed, torque = compute_feedforward_offsets(
        np.asarray(build_bench_trajectory(10).position_mm["X"]), MODELS["X"], axis, 0.001
    )
    counts = speed * 65536 / (2 * np.pi)
    assert np.allclose(counts, np.rint(counts), atol=1e-6)
    counts = torque / (0.8 * 50.0 * 0.001)
    assert np.allclose(counts, np.rint(counts), atol=1e-6)
    assert np.abs(torque).max() == pytest.approx(0.075 * 52.36 / 0.06 + 7.6, rel=0.1)


def test_torque_offset_uses_nominal_torque_constant() -> None:
    axis = CONFIG.axis["X"]
    path = np.asarray(build_bench_trajectory(10).position_mm["X"])
    _, nominal = compute_feedforward_offsets(path, MODELS["X"], axis, 0.001)
    _, weaker = compute_feedforward_offsets(path, replace(MODELS["X"], K=0.72), axis, 0.001)
    assert np.abs(weaker).max() == pytest.approx(np.abs(nominal).max() * 0.8 / 0.72, rel=0.01)
