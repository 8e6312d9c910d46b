"""Predicted path errors of the bench: the published figures, zones, drifts, and properties of the contour error."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.daemon.kernel_warmup import simulate_nominal_rapid
from fdhil.errors import ConfigError
from fdhil.prediction import assess_model_skill, compute_contour_error_um, predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Float, Skill, Window
from tests.bench import bench_config
from tests.paths import build_bench_trajectory, build_trajectory, compute_rms

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)


@pytest.mark.parametrize(
    ("feed", "smoothing", "rms_um", "max_um"),
    [(10, (0.060, 0.030), 24.2, 98.6), (20, (0.060, 0.030), 64.1, 218.0), (10, (0.030, 0.015), 39.4, 211.0)],
)
def test_bench_prediction_figures(feed: float, smoothing: tuple[float, float], rms_um: float, max_um: float) -> None:
    """The contour errors of the bench path, reference held for 0.5 s at its end."""
    prediction = predict_path(build_bench_trajectory(feed, smoothing), MODELS, CONFIG)
    assert compute_rms(prediction.contour_um) == pytest.approx(rms_um, rel=0.02)
    assert prediction.contour_um.max() == pytest.approx(max_um, rel=0.01)


def test_zones_report_position_and_cause() -> None:
    zones = predict_path(build_bench_trajectory(10), MODELS, CONFIG).zones
    corners = [zone.where for zone in zones if zone.cause == "corner"]
    expected = [(0, 55), (100, 55), (200, 55), (250, 55)]
    assert len(corners) == 4
    for where, (x, y) in zip(corners, expected, strict=True):
        _, x_mm, _, y_mm = where.split()
        assert abs(float(x_mm) - x) < 2.5
        assert abs(float(y_mm) - y) < 2.5
    assert any(zone.cause == "reversal" and zone.where.startswith("X 150") for zone in zones)
    assert all(zone.end_s > zone.start_s and zone.max_um >= 1.0 for zone in zones)


def test_saturation_zone_is_found() -> None:
    """20 m/min with short smoothing exceeds the current limit."""
    prediction = predict_path(build_bench_trajectory(20, (0.030, 0.015)), MODELS, CONFIG)
    assert prediction.limited_s["X"] > 0.1
    assert {zone.cause for zone in prediction.zones} == {"saturation"}


@pytest.mark.parametrize(
    ("drift", "at_e_um", "largest_um"),
    [({"ft": 0.01, "Cd": 1.0}, (0.0, 2.0), (10.0, 16.0)), ({"Jt": 0.085}, (5.0, 20.0), (5.0, 25.0))],
)
def test_parameter_drift_changes_path(
    drift: dict[str, float], at_e_um: tuple[float, float], largest_um: tuple[float, float]
) -> None:
    """Figures 14 and 15: a drift on one axis moves the path, near E by little (friction) or much (inertia)."""
    reference = build_bench_trajectory(10)
    healthy = predict_path(reference, MODELS, CONFIG)
    drifted = predict_path(reference, MODELS | {"X": MODELS["X"].replace_values(**drift)}, CONFIG)
    moved = np.abs(healthy.predicted_mm["X"] - drifted.predicted_mm["X"]) * 1e3
    x, y = reference.position_mm["X"], reference.position_mm["Y"]
    near_e = np.hypot(x - 200, y - 55) < 5
    assert at_e_um[0] <= moved[near_e].max() <= at_e_um[1]
    assert largest_um[0] <= moved.max() <= largest_um[1]


def test_axis_without_model_raises_config_error() -> None:
    with pytest.raises(ConfigError, match=r"model\.Y"):
        predict_path(build_bench_trajectory(10), {"X": MODELS["X"]}, CONFIG)
    with pytest.raises(ConfigError, match=r"axis\.Y"):
        predict_path(build_bench_trajectory(10), MODELS, bench_config("X"))


def search_all_segments(reference: Float, actual: Float, half: int) -> Float:
    out = np.empty(len(actual))
    for k, point in enumerate(actual):
        low, high = max(0, k - half), min(len(reference) - 1, k + half)
        a, b = reference[low:high], reference[low + 1 : high + 1]
        edge = b - a
        length = np.maximum((edge**2).sum(axis=1), 1e-300)
        t = np.clip(((point - a) * edge).sum(axis=1) / length, 0, 1)
        out[k] = np.sqrt(((point - a - t[:, None] * edge) ** 2).sum(axis=1)).min()
    return out * 1e3


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.floats(0, 50))
def test_contour_error_equals_full_search(seed: int, d: int, noise: float) -> None:
    random = np.random.default_rng(seed)
    steps = random.normal(0, 1, (120, d)) * (random.random((120, 1)) > 0.3)
    reference = np.cumsum(steps, axis=0)
    actual = reference + random.normal(0, 1, (120, d)) * noise * random.random()
    assert np.allclose(
        compute_contour_error_um(reference, actual, 0.02),
        search_all_segments(reference, actual, 20),
        rtol=1e-9,
        atol=1e-9,
    )


def test_contour_error_of_selected_rows_matches_all() -> None:
    """For rows 40 to 69 alone, the path before and behind them counts as before."""
    random = np.random.default_rng(3)
    reference = np.cumsum(random.normal(0, 1, (120, 2)), axis=0)
    actual = reference + random.normal(0, 1, (120, 2))
    whole = compute_contour_error_um(reference, actual, 0.02)
    assert np.array_equal(compute_contour_error_um(reference, actual[40:70], 0.02, 40), whole[40:70])


@pytest.mark.parametrize("first", [None, -1, 2])
def test_contour_error_rejects_mismatched_shapes(first: int | None) -> None:
    with pytest.raises(ValueError, match="must both be"):
        compute_contour_error_um(np.zeros((4, 2)), np.zeros((3, 2)), 0.001, first)


def make_rapid(**signals: Any) -> Window:
    return replace(simulate_nominal_rapid("Y", CONFIG.axis["Y"], 0.001, 1, seed=0), **signals)


def assess_skill(window: Window) -> Skill | None:
    return assess_model_skill(window, MODELS["Y"], CONFIG.axis["Y"], 0.001)


def test_skill_of_exact_model_is_perfect_and_finds_delay() -> None:
    """The model's own response has only noise as its error; the same response two cycles late shows 2 ms."""
    window = make_rapid()
    same = assess_skill(window)
    assert same is not None
    assert same.rms_um < 0.5
    assert same.tick == window.start_tick
    assert same.measured_rms_um > 20
    late = np.concatenate([np.repeat(window.position_mm[:1], 2), window.position_mm[:-2]])
    delayed = assess_skill(make_rapid(position_mm=late))
    assert delayed is not None
    assert delayed.delay_ms == pytest.approx(2.0, abs=0.1)
    assert delayed.rms_um > 100


def test_skill_skips_lost_rows_and_needs_position() -> None:
    window = make_rapid()
    demand, position = window.demand_mm.copy(), window.position_mm.copy()
    demand[300:303] = position[300:303] = np.nan
    found = assess_skill(make_rapid(demand_mm=demand, position_mm=position))
    assert found is not None
    assert found.rms_um < 0.5
    assert assess_skill(make_rapid(position_mm=np.full(window.n, np.nan))) is None


def test_skill_needs_standstill_before_move() -> None:
    window = make_rapid()
    settling = 0.2 * np.exp(-np.arange(window.n) / 20.0)
    assert assess_skill(make_rapid(position_mm=window.position_mm + settling)) is None
    assert assess_skill(make_rapid(position_mm=window.position_mm + 1e-3 * settling)) is not None
    moves = np.flatnonzero(np.abs(window.speed_rad_s) > 0.5)[0]
    rest = slice(max(0, moves - 5), None)
    cut = {name: getattr(window, name)[rest] for name in ("demand_mm", "position_mm", "speed_rad_s", "current_a")}
    assert assess_skill(make_rapid(**cut, voltage_v=None)) is None


def test_single_axis_is_predicted() -> None:
    demand = build_bench_trajectory(10).position_mm["Y"][:, None]
    prediction = predict_path(build_trajectory(np.asarray(demand), "Y"), MODELS, CONFIG)
    assert prediction.contour_um.max() < np.abs(prediction.error_um["Y"]).max()


def test_overflowing_model_is_refused() -> None:
    reference = build_bench_trajectory(10)
    wild = MODELS | {"X": MODELS["X"].replace_values(viscous_positive=1e9)}
    with pytest.raises(ConfigError, match="overflows"):
        predict_path(reference, wild, CONFIG)
