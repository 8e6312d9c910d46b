"""The inverse correction: its residual when plant and model differ, its limits, its blocks, its delay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil.arming.guard_configuration import compute_offset_limits
from fdhil.correction import PlanLimits, check_offsets, mirror, plan_correction
from fdhil.correction.inverse import BLOCK_S
from fdhil.correction.linear_loop import invert_loop, measure_delay_s
from fdhil.guard.correction_table import check_rows
from fdhil.model import closed_loop
from fdhil.prediction import predict_corrected_path, predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Correction, Parameters, Trajectory
from tests.bench import bench_config
from tests.correction.test_correction_planner import change_config
from tests.paths import (
    build_bench_demand,
    build_bench_trajectory,
    build_jerky_demand,
    build_rounded_demand,
    build_trajectory,
    compute_rms,
    smooth_demand,
)

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)
SCATTER = {"R": 0.001, "L": 0.003, "K": 0.0005, "Jt": 0.001, "ft": 0.02, "Cd": 0.03}


def scatter_parameters(seed: int) -> dict[str, Parameters]:
    random = np.random.default_rng(seed)
    plants = {}
    for axis in "XY":
        nominal = MODELS[axis]
        plants[axis] = replace(
            nominal, **{k: getattr(nominal, k) * (1 + s * random.standard_normal()) for k, s in SCATTER.items()}
        )
    return plants


def assert_within_limits(correction: Correction) -> None:
    for axis, offset in correction.offset_um.items():
        limits = PlanLimits.derive(CONFIG.axis[axis], 0.001)
        increments = offset / limits.um_per_increment
        assert np.allclose(increments, np.rint(increments), atol=1e-6)
        whole = np.rint(increments).astype(np.int64)
        assert check_offsets(whole, limits) == []
        assert (
            check_rows(compute_offset_limits(CONFIG.axis[axis], 0.001), whole.tolist(), 0, whole.size) is None
        )  # as the guard


@pytest.mark.parametrize(("feed", "smoothing"), [(10, (0.060, 0.030)), (20, (0.060, 0.030)), (10, (0.030, 0.015))])
def test_error_is_sixty_times_smaller_with_identified_model(feed: float, smoothing: tuple[float, float]) -> None:
    """On scattered plants: RMS, no point worse by 2 um, no zone by 1 um, 8 times better than the mirror."""
    reference = build_bench_trajectory(feed, smoothing)
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    mirror = plan_correction(reference, MODELS, CONFIG, "mirror")
    assert correction.refused == ()
    assert_within_limits(correction)
    for seed in range(3):
        plants = scatter_parameters(seed)
        before = predict_path(reference, plants, CONFIG).contour_um
        after = predict_corrected_path(reference, plants, CONFIG, correction.offset_um).contour_um
        mirrored = predict_corrected_path(reference, plants, CONFIG, mirror.offset_um).contour_um
        assert compute_rms(before) / compute_rms(after) > 60
        assert compute_rms(mirrored) / compute_rms(after) > 8
        assert (after - before).max() < 2.0
        for zone in predict_path(reference, plants, CONFIG).zones:
            rows = (reference.time_s >= zone.start_s) & (reference.time_s < zone.end_s)
            assert after[rows].max() < zone.max_um + 1.0


@pytest.mark.parametrize("feed", [10, 20])
def test_jerky_demand_is_corrected(feed: float) -> None:
    """Steps of acceleration, as by LinuxCNC: 14 times better, twice as good as the mirror."""
    reference = build_trajectory(build_jerky_demand(feed))
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    assert correction.refused == ()
    assert_within_limits(correction)
    mirrored = mirror.plan_mirror_offsets(reference, MODELS, CONFIG, correction.before).offset_um
    for seed in range(2):
        plants = scatter_parameters(seed)
        before = predict_path(reference, plants, CONFIG).contour_um
        after = predict_corrected_path(reference, plants, CONFIG, correction.offset_um).contour_um
        assert compute_rms(before) / compute_rms(after) > 14
        assert (
            compute_rms(predict_corrected_path(reference, plants, CONFIG, mirrored).contour_um) / compute_rms(after) > 2
        )
        assert (after - before).max() < 2.0


@pytest.mark.parametrize("feed", [10, 20])
def test_rounded_corners_leave_no_oscillation(feed: float) -> None:
    """Figure 20: with the mirror the error oscillates behind each arc; with the inverse no oscillation is visible."""
    reference = build_trajectory(build_rounded_demand(feed))
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    assert_within_limits(correction)
    mirrored = plan_correction(reference, MODELS, CONFIG, "mirror").after
    for axis in "XY":
        assert measure_oscillation(correction.after.error_um[axis]) < 0.2 * measure_oscillation(mirrored.error_um[axis])
        assert measure_oscillation(correction.after.error_um[axis]) < 0.5
    assert correction.after.contour_um.max() < 1.0


def measure_oscillation(error_um: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Return the largest standard deviation (um) within 0.1 s of the part above 5 Hz."""
    slow = np.convolve(error_um, np.ones(200) / 200, mode="same")
    windows = np.lib.stride_tricks.sliding_window_view(error_um - slow, 100)
    return float(windows.std(axis=1).max())


def test_corners_do_not_oscillate() -> None:
    """Around a corner the corrected error stays below a micrometre; the mirror leaves 10 and more."""
    reference = build_bench_trajectory(10)
    after = plan_correction(reference, MODELS, CONFIG, "inverse").after
    for zone in predict_path(reference, MODELS, CONFIG).zones:
        rows = (reference.time_s >= zone.start_s - 0.05) & (reference.time_s < zone.end_s + 0.1)
        assert after.contour_um[rows].max() < 1.0


def test_inaccurate_model_still_improves_path() -> None:
    """Parameter errors of 5 to 10 % leave a few micrometres."""
    reference = build_bench_trajectory(10, (0.030, 0.015))
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    off = replace(MODELS["X"], R=0.53, L=0.0053, K=0.78, Jt=0.079, ft=0.055, Cd=5.5)
    plants = {"X": off, "Y": off}
    before = predict_path(reference, plants, CONFIG).contour_um
    after = predict_corrected_path(reference, plants, CONFIG, correction.offset_um).contour_um
    assert compute_rms(before) / compute_rms(after) > 8


def test_block_seams_cause_no_error() -> None:
    reference = build_bench_trajectory(10)
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    seam = np.abs(reference.time_s - BLOCK_S) < 0.1
    assert correction.after.contour_um[seam].max() < 0.5


@pytest.mark.parametrize(("feedforward", "expected"), [(1.0, 0.0), (0.5, 0.010), (0.0, 0.020)])
def test_delay_equals_position_loop_lag(feedforward: float, expected: float) -> None:
    """(1 - Kff) / Kv."""
    config = change_config(speed_feedforward=feedforward)
    assert measure_delay_s(MODELS["X"], config.axis["X"], 0.001) == pytest.approx(expected, abs=2e-5)


def test_slow_path_on_lagging_drive_needs_small_offsets() -> None:
    """With one delay for all axes only the corners need offsets: at 4 m/min these are small enough, the lag is not."""
    config = change_config(speed_feedforward=0.5)
    reference = build_bench_trajectory(4)
    correction = plan_correction(reference, MODELS, config, "inverse")
    lag_um = max(float(np.abs(error).max()) for error in correction.before.error_um.values())
    assert lag_um > 600
    assert correction.refused == ()
    assert max(float(np.abs(offset).max()) for offset in correction.offset_um.values()) < 250
    assert compute_rms(correction.before.contour_um) / compute_rms(correction.after.contour_um) > 20


@pytest.mark.parametrize("feedforward", [0.5, 0.0])
def test_large_lag_is_refused_with_feedforward_advice(feedforward: float) -> None:
    """At 10 m/min even the corners alone exceed the largest offset."""
    correction = plan_correction(
        build_bench_trajectory(10), MODELS, change_config(speed_feedforward=feedforward), "inverse"
    )
    assert {reason.code for reason in correction.refused} == {"LagTooLarge"}
    assert f"feed-forward (it is {feedforward:g})" in correction.refused[0].advice
    assert correction.after is correction.before


def test_different_axis_lags_are_refused() -> None:
    config = change_config()
    slow = change_config(speed_feedforward=0.5).axis["Y"]
    mixed = config.model_copy(update={"axis": {"X": config.axis["X"], "Y": slow}})
    correction = plan_correction(build_bench_trajectory(10), MODELS, mixed, "inverse")
    assert {reason.code for reason in correction.refused} == {"LagTooLarge"}


def test_loop_inverse_inverts_linear_loop() -> None:
    axis = CONFIG.axis["X"]
    parameters = replace(MODELS["X"], Cd=0.0)
    undo = invert_loop(parameters, axis, 0.001, 2000)
    bump = 0.02 * np.exp(-(((np.arange(1500) - 700) / 40.0) ** 2))
    offset = undo.compute_offset(bump)
    response = closed_loop.simulate_axis(parameters, axis, 0.001, np.zeros(1500), offset)
    assert np.abs(response.position_mm - bump).max() < 3e-5


def make_random_path(seed: int) -> Trajectory:
    random = np.random.default_rng(seed)
    speeds = np.concatenate(
        [np.repeat(random.uniform(-90, 90, (1, 2)) * (random.random(2) > 0.3), random.integers(80, 500), axis=0)
         for _ in range(9)]
    )  # fmt: skip
    path = np.cumsum(np.concatenate([speeds, np.zeros((200, 2))]) * 0.001, axis=0)
    path = np.concatenate([path[:1], path])
    path[0] = path[1]
    return build_trajectory(smooth_demand(path, (0.060, 0.030), 0.001))


@pytest.mark.parametrize("seed", range(4))
def test_random_path_improves_within_limits(seed: int) -> None:
    reference = make_random_path(seed)
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    assert correction.refused == ()
    assert_within_limits(correction)
    assert compute_rms(correction.before.contour_um) > 20 * compute_rms(correction.after.contour_um)


def test_narrow_offset_limits_are_kept() -> None:
    """With the default limits (50 um, 2 mm/s, 250 mm/s2) a slow path is corrected within them."""
    narrow = configuration.CorrectionLimits(max_offset_um=50.0, max_speed_mm_s=2.0, max_acceleration_mm_s2=250.0)
    axes = {name: axis.model_copy(update={"correction": narrow}) for name, axis in CONFIG.axis.items()}
    config = CONFIG.model_copy(update={"axis": axes})
    correction = plan_correction(build_trajectory(build_bench_demand(5)), MODELS, config, "inverse")
    assert correction.refused == ()
    for axis, offset in correction.offset_um.items():
        limits = PlanLimits.derive(config.axis[axis], 0.001)
        assert check_offsets(np.rint(offset / limits.um_per_increment).astype(np.int64), limits) == []
    assert compute_rms(correction.before.contour_um) > 4 * compute_rms(correction.after.contour_um)


@pytest.mark.parametrize("rows", [2, 3, 4, 40, 1999, 2000, 2001, 2500, 2501, 2502])
def test_path_of_any_length_is_planned(rows: int) -> None:
    reference = build_trajectory(build_bench_demand(10)[300 : 300 + rows])
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    assert all(offset.size == rows for offset in correction.offset_um.values())
    assert_within_limits(correction)


@pytest.mark.parametrize("rest_s", [0.5, 2.0, 4.5])
def test_rest_across_blocks_is_held(rest_s: float) -> None:
    demand = build_bench_demand(10)[:1000]
    pause = np.repeat(demand[-1:], round(rest_s / 0.001), axis=0)
    there = smooth_demand(
        np.concatenate([demand, pause, demand[::-1], np.repeat(demand[:1], 200, axis=0)]), (0.06,), 0.001
    )
    correction = plan_correction(build_trajectory(there), MODELS, CONFIG, "inverse")
    assert correction.refused == ()
    assert_within_limits(correction)
    assert compute_rms(correction.before.contour_um) > 30 * compute_rms(correction.after.contour_um)


def test_offset_one_cycle_late_leaves_tenfold_error() -> None:
    reference = build_bench_trajectory(10)
    correction = plan_correction(reference, MODELS, CONFIG, "inverse")
    late = {axis: np.concatenate([[0.0], offset[:-1]]) for axis, offset in correction.offset_um.items()}
    shifted = predict_corrected_path(reference, MODELS, CONFIG, late)
    assert compute_rms(shifted.contour_um) > 10 * compute_rms(correction.after.contour_um)
