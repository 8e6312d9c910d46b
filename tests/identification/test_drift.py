"""Drift: slopes with intervals, held jumps, a changed load, alarms with hysteresis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Maintenance
from fdhil.identification.drift import DriftTracker, slope
from fdhil.records import Notice, Parameters

BENCH = Parameters(R=0.5, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0)
COVARIANCE = np.diag(np.array([0.0005, 1e-5, 0.0002, 0.00005, 0.0005, 0.08]) ** 2)


def _tracker(history: int = 5) -> DriftTracker:
    tracker = DriftTracker(Maintenance(), "X")
    for k in range(history):
        assert tracker.update(BENCH, COVARIANCE, k, 20.0 + k) == []
    return tracker


def _codes(notices: list[Notice]) -> list[str]:
    return [notice.code for notice in notices]


def test_slope_and_its_interval_cover_the_truth() -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        t = np.linspace(20, 22, 20)
        line = slope(5 - 0.5 * (t - 20) + 0.08 * rng.standard_normal(20), t, np.full(20, 0.08))
        assert line is not None
        low, high = line.interval()
        inside += low <= -0.5 <= high
    assert 180 <= inside <= 200


def test_slope_widens_when_the_points_scatter_more_than_promised() -> None:
    rng = np.random.default_rng(4)
    t = np.linspace(0, 1, 30)
    points = t + 0.1 * rng.standard_normal(30)
    calm = slope(points, t, np.full(30, 0.1))
    trusting = slope(points, t, np.full(30, 0.001))
    assert calm is not None
    assert trusting is not None
    assert trusting.std == pytest.approx(calm.std, rel=0.5)


@pytest.mark.parametrize("points", [[], [1.0], [1.0, 2.0], [np.nan] * 5])
def test_no_slope_through_too_little(points: list[float]) -> None:
    values = np.array(points)
    assert slope(values, np.arange(values.size, dtype=float)) is None
    assert slope(np.ones(4), np.zeros(4)) is None


def test_trend_against_temperature() -> None:
    tracker = DriftTracker(Maintenance())
    for k in range(20):
        celsius = 20 + 2 * k / 19
        share = 1 - 0.15 * (celsius - 20)
        assert tracker.update(replace(BENCH, ft=0.05 * share, Cd=5.0 * share), COVARIANCE, k, celsius) == []
    falling = tracker.trend("Cd")
    assert falling is not None
    assert falling.value == pytest.approx(-0.75, rel=1e-6)
    assert falling.interval()[1] < 0


def test_one_outlier_is_held_and_forgotten() -> None:
    tracker = _tracker()
    assert _codes(tracker.update(replace(BENCH, R=0.7), COVARIANCE, 9)) == ["ParameterJump"]
    assert tracker.holding
    assert tracker.update(BENCH, COVARIANCE, 10) == []
    assert not tracker.holding


def test_a_step_is_believed_after_two_further_episodes() -> None:
    tracker = _tracker()
    moved = replace(BENCH, R=0.7)
    for k in range(2):
        assert _codes(tracker.update(moved, COVARIANCE, 9 + k)) == ["ParameterJump"]
        assert tracker.holding
    notices = tracker.update(moved, COVARIANCE, 11)
    assert _codes(notices)[0] == "ParameterJump"
    assert not tracker.holding
    assert tracker.points[-1].values[0] == 0.7


def test_a_changed_load_is_told_at_once_and_used_from_the_second() -> None:
    tracker = _tracker()
    loaded = replace(BENCH, Jt=0.085)
    (first,) = tracker.update(loaded, COVARIANCE, 9)
    assert (first.code, first.severity) == ("LoadChanged", "MAJOR")
    assert tracker.holding
    (second,) = tracker.update(loaded, COVARIANCE, 10)
    assert second.code == "LoadChanged"
    assert tracker.points[-1].values[3] == 0.085
    assert tracker.update(loaded, COVARIANCE, 11) == []


def test_values_that_disagree_never_settle() -> None:
    tracker = _tracker()
    for k in range(6):
        assert _codes(tracker.update(replace(BENCH, R=0.7 + 0.1 * k), COVARIANCE, 9 + k)) == ["ParameterJump"]
        assert tracker.holding


def test_alarm_has_hysteresis() -> None:
    tracker = _tracker()
    told = []
    for k, share in enumerate([1.1, 1.3, 1.6, 1.9, 2.1, 2.05, 1.95, 1.85, 1.7, 1.5]):
        told += tracker.update(replace(BENCH, Cd=5.0 * share), COVARIANCE, 20 + k)
    alarms = [notice for notice in told if notice.code == "MaintenanceDue"]
    assert [a.severity for a in alarms] == ["minor", "info"]


def test_not_published_parameters_do_no_harm() -> None:
    tracker = _tracker()
    unknown = replace(BENCH, ft=np.nan)
    covariance = COVARIANCE.copy()
    covariance[4, :] = covariance[:, 4] = np.nan
    assert tracker.update(unknown, covariance, 9) == []
