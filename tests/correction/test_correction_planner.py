"""Corrections of the bench path: the residual of each method and the refusals of the gate."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil.correction import PlanLimits, check_offsets, plan_correction
from fdhil.model import closed_loop
from fdhil.prediction import compute_contour_error_um, predict_path
from fdhil.prediction.axis_models import build_nominal_models
from tests.bench import bench_config, bench_document
from tests.paths import build_bench_trajectory, build_trajectory, compute_rms

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)


def change_config(**regulators: Any) -> configuration.MachineConfig:
    document = copy.deepcopy(bench_document())
    for axis in document["axis"].values():
        axis["regulators"] |= regulators
    return configuration.parse_config(document)


@pytest.mark.parametrize(("feed", "rms_um", "max_um"), [(10, 3.5, 20.3), (20, 7.0, 32.0)])
def test_mirror_residual_matches_bench(feed: float, rms_um: float, max_um: float) -> None:
    correction = plan_correction(build_bench_trajectory(feed), MODELS, CONFIG, "mirror")
    assert correction.refused == ()
    assert compute_rms(correction.after.contour_um) == pytest.approx(rms_um, rel=0.02)
    assert [reason.code for reason in correction.warnings if reason.code != "NearLimit"] == ["HarmPredicted"]
    assert correction.after.contour_um.max() == pytest.approx(max_um, rel=0.02)
    for axis, offset in correction.offset_um.items():
        limits = PlanLimits.derive(CONFIG.axis[axis], 0.001)
        assert np.abs(offset + correction.before.error_um[axis]).max() <= 0.55 * limits.um_per_increment
        increments = offset / limits.um_per_increment
        assert np.allclose(increments, np.rint(increments), atol=1e-6)
        assert check_offsets(np.rint(increments).astype(np.int64), limits) == []


@pytest.mark.parametrize(("feedforward", "before_um", "after_um"), [(0.5, 85, 67), (0.0, 110, 233)])
def test_mirror_is_refused_on_lagging_drive(feedforward: float, before_um: float, after_um: float) -> None:
    """The largest error at D without limits: with H far from 1 the mirror hardly helps, or harms."""
    reference, config = build_bench_trajectory(10), change_config(speed_feedforward=feedforward)
    x, y = reference.position_mm["X"], reference.position_mm["Y"]
    at_d = np.hypot(x - 150, y - 5) < 20
    before = predict_path(reference, MODELS, config)
    assert before.contour_um[at_d].max() == pytest.approx(before_um, rel=0.08)
    mirrored = {axis: -error * 1e-3 for axis, error in before.error_um.items()}
    after = closed_loop.simulate_axes(MODELS, config.axis, 0.001, reference.position_mm, mirrored)
    actual = np.column_stack([after[axis].position_mm for axis in "XY"])
    assert compute_contour_error_um(np.column_stack([x, y]), actual, 0.001)[at_d].max() == pytest.approx(
        after_um, rel=0.08
    )


@pytest.mark.parametrize("method", ["mirror", "inverse"])
def test_lagging_drive_is_refused(method: str) -> None:
    correction = plan_correction(build_bench_trajectory(10), MODELS, change_config(speed_feedforward=0.5), method)
    assert {reason.code for reason in correction.refused} == {"LagTooLarge"}
    assert "feed-forward" in correction.refused[0].advice
    assert all(not offset.any() for offset in correction.offset_um.values())


@pytest.mark.parametrize("method", [None, "mirror"])
def test_excessive_demand_is_refused_with_feasible_feed(method: str | None) -> None:
    """20 m/min with 30 + 15 ms needs 1.7 times the current limit; 9 to 11 m/min are feasible."""
    correction = plan_correction(build_bench_trajectory(20, (0.030, 0.015)), MODELS, CONFIG, method)
    assert {reason.code for reason in correction.refused} == {"DemandTooHigh"}
    feed = float(correction.refused[0].advice.split()[4])
    assert 9 < feed < 11
    assert correction.after is correction.before


def test_demand_near_limit_only_warns() -> None:
    """20 m/min with 60 + 30 ms reaches 99 % of the current limit."""
    correction = plan_correction(build_bench_trajectory(20), MODELS, CONFIG, "mirror")
    assert "NearLimit" in {warning.code for warning in correction.warnings}


def test_axis_without_limits_is_refused() -> None:
    document = bench_document()
    del document["axis"]["Y"]["correction"]
    correction = plan_correction(build_bench_trajectory(10), MODELS, configuration.parse_config(document), "mirror")
    assert [reason.code for reason in correction.refused] == ["WritingOff"]
    assert "[axis.Y.correction]" in correction.refused[0].advice


def test_negligible_error_is_refused_as_no_gain() -> None:
    correction = plan_correction(build_trajectory(np.zeros((200, 2))), MODELS, CONFIG, "mirror")
    assert [reason.code for reason in correction.refused] == ["NoGain"]


def test_large_held_out_error_refuses_correction() -> None:
    reference = build_bench_trajectory(10)
    refused, accepted = (plan_correction(reference, MODELS, CONFIG, held_out_um=um) for um in (4.0, 1.0))
    assert [reason.code for reason in refused.refused] == ["HarmPredicted"]
    assert not any(offset.any() for offset in refused.offset_um.values())
    assert accepted.refused == ()
    assert accepted.after.rms_um < accepted.before.rms_um / 5
