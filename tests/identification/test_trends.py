"""Trends: slopes with valid intervals, steps within drift, the date of a limit."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.identification.trends import compute_student_95, find_crossing, find_steps, fit_slope, remove_direction_bias
from fdhil.records import PARAMETERS, Float

BENCH = np.array([0.5, 0.005, 0.8, 0.075, 0.05, 5.0])
STDS = np.array([0.0003, 1e-5, 0.00016, 0.00004, 0.0006, 0.1])


def _build_series(rng: np.random.Generator, share: Float) -> tuple[Float, Float]:
    """Return the estimates (n, 6) of a drive whose friction is ``share`` (n,) of the bench's, and their deviations."""
    values = np.tile(BENCH, (share.size, 1))
    values[:, 4:] *= share[:, None]
    return values + STDS * rng.standard_normal(values.shape), np.tile(STDS, (share.size, 1))


def test_slope_interval_covers_the_truth() -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        t = np.linspace(20, 22, 20)
        line = fit_slope(5 - 0.5 * (t - 20) + 0.08 * rng.standard_normal(20), t, np.full(20, 0.08))
        assert line is not None
        low, high = line.compute_interval()
        inside += low <= -0.5 <= high
    assert 180 <= inside <= 200


def test_slope_interval_widens_with_the_scatter() -> None:
    rng = np.random.default_rng(4)
    t = np.linspace(0, 1, 30)
    points = t + 0.1 * rng.standard_normal(30)
    calm = fit_slope(points, t, np.full(30, 0.1))
    trusting = fit_slope(points, t, np.full(30, 0.001))
    assert calm is not None
    assert trusting is not None
    assert trusting.std == pytest.approx(calm.std, rel=0.5)


@pytest.mark.parametrize("points", [[], [1.0], [1.0, 2.0], [np.nan] * 5])
def test_too_few_points_yield_no_slope(points: list[float]) -> None:
    values = np.array(points)
    assert fit_slope(values, np.arange(values.size, dtype=float)) is None
    assert fit_slope(np.ones(4), np.zeros(4)) is None


@pytest.mark.parametrize("n", [4, 8, 20])
@pytest.mark.parametrize("promised", [0.1, 0.001])
def test_slope_interval_is_valid_for_few_points_and_small_stds(n: int, promised: float) -> None:
    rng = np.random.default_rng(n)
    inside = 0
    for _ in range(300):
        x = np.linspace(0, 1, n)
        line = fit_slope(1 + 2 * x + 0.1 * rng.standard_normal(n), x, np.full(n, promised))
        assert line is not None
        low, high = line.compute_interval()
        inside += low <= 2 <= high
    assert 0.91 * 300 <= inside <= 0.995 * 300


def test_student_quantile_approaches_the_normal() -> None:
    assert compute_student_95(np.inf) == pytest.approx(1.95996, abs=1e-4)
    assert compute_student_95(5) == pytest.approx(2.5706, rel=2e-3)
    assert compute_student_95(3) == pytest.approx(3.1824, rel=1e-2)


def test_temperature_effect_is_not_wear() -> None:
    rng = np.random.default_rng(6)
    days = np.linspace(0, 30, 40)
    celsius = 20 + 0.1 * days + 0.5 * rng.standard_normal(40)
    points = 5 - 0.4 * (celsius - 20) + 0.05 * rng.standard_normal(40)
    naive, fair = fit_slope(points, days, np.full(40, 0.05)), fit_slope(points, days, np.full(40, 0.05), celsius)
    assert naive is not None
    assert fair is not None
    assert naive.compute_interval()[1] < 0
    assert fair.compute_interval()[0] <= 0 <= fair.compute_interval()[1]
    assert fit_slope(points, days, np.full(40, 0.05), days * 2) is None  # the two cannot be separated


def test_limit_date_has_an_interval() -> None:
    rng = np.random.default_rng(7)
    inside = []
    for _ in range(300):
        days = np.sort(rng.uniform(0, 30, 20))
        line = fit_slope(5 + 0.05 * days + 0.1 * rng.standard_normal(20), days, np.full(20, 0.1))
        assert line is not None
        reached = find_crossing(line, 7.5)
        assert reached is not None
        assert reached.low < reached.at < reached.high
        inside.append(reached.low <= 50 <= reached.high)
    assert 0.91 <= np.mean(inside) <= 0.99


def test_insignificant_slope_yields_no_date() -> None:
    line = fit_slope(np.array([4.9, 5.1] * 10), np.arange(20.0), np.full(20, 0.1))
    assert line is not None
    assert find_crossing(line, 10.0) is None


@pytest.mark.parametrize(("name", "share"), [("Jt", 1.13), ("Jt", 1.04), ("ft", 0.75), ("Cd", 0.8), ("K", 0.9)])
def test_step_is_located_during_warm_up(name: str, share: float) -> None:
    rng = np.random.default_rng(9)
    k = PARAMETERS.index(name)
    for at in (3, 11, 26):
        celsius = np.linspace(20, 22, 30)
        values, stds = _build_series(rng, 1 - 0.1 * (celsius - 20))
        values[at:, k] *= share
        (step,) = find_steps(values, stds, celsius)
        assert step.name == name
        assert abs(step.row - at) <= 1
        friction = (1 - 0.1 * (celsius[at] - 20)) if k >= 4 else 1.0
        assert step.size == pytest.approx((share - 1) * BENCH[k] * friction, rel=0.25)
        assert abs(step.size) > 5 * step.std


def test_newest_step_is_reported_from_its_second_row() -> None:
    values, stds = _build_series(np.random.default_rng(13), np.ones(12))
    values[10:, 3] *= 1.13
    assert [(step.name, step.row) for step in find_steps(values, stds)] == [("Jt", 10)]
    assert find_steps(values[:11], stds[:11]) == []


def test_two_steps_are_distinguished() -> None:
    values, stds = _build_series(np.random.default_rng(10), np.ones(40))
    values[12:, 3] *= 1.13
    values[25:, 3] /= 1.13
    values[25:, 4] *= 0.7
    assert [(step.name, step.row) for step in find_steps(values, stds)] == [("Jt", 12), ("Jt", 25), ("ft", 25)]


def test_drift_warming_and_outliers_are_not_steps() -> None:
    rng = np.random.default_rng(11)
    false = 0
    for k in range(100):
        n = int(rng.integers(6, 80))
        warming = 1 - 0.35 * (1 - np.exp(-np.linspace(0, rng.uniform(1, 6), n)))
        values, stds = _build_series(rng, warming if k % 2 else np.ones(n))
        if k % 4 == 0:
            values[n // 2, 0] *= 1.5
        false += bool(find_steps(values, stds))
    assert false <= 1


def test_missing_values_are_tolerated() -> None:
    values, stds = _build_series(np.random.default_rng(12), np.ones(20))
    values[3, 1] = np.nan
    stds[5] = np.nan
    values[:, 4] = np.nan
    values[10:, 3] *= 1.2
    assert [(step.name, step.row) for step in find_steps(values, stds, np.full(20, np.nan))] == [("Jt", 10)]
    assert find_steps(values[:4], stds[:4]) == []


def test_direction_dependent_friction_is_neither_scatter_nor_step() -> None:
    side = np.array([1.0, -1.0] * 10)
    worn = np.array([5.0 + 0.02 * k for k in range(20)])
    assert remove_direction_bias(worn + 2.5 * side, side) == pytest.approx(worn, abs=0.011)
    stepped = np.array([5.0] * 10 + [6.0] * 10)
    assert remove_direction_bias(stepped + 2.5 * side, side) == pytest.approx(stepped)
    assert remove_direction_bias(worn, np.ones(20)) is worn
