"""Parameter drift: jumps held back, a changed load, alarms with hysteresis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Maintenance
from fdhil.identification.parameter_drift import DriftPoint, DriftTracker
from fdhil.records import Notice, Parameters

BENCH = Parameters(R=0.5, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0)
COVARIANCE = np.diag(np.array([0.0005, 1e-5, 0.0002, 0.00005, 0.0005, 0.08]) ** 2)


def _build_tracker(history: int = 5) -> DriftTracker:
    tracker = DriftTracker(Maintenance(), "X")
    for k in range(history):
        assert tracker.update(BENCH, COVARIANCE, k) == []
    return tracker


def _list_codes(notices: list[Notice]) -> list[str]:
    return [notice.code for notice in notices]


def test_temperature_drift_is_not_a_jump() -> None:
    tracker = DriftTracker(Maintenance())
    for k in range(20):
        celsius = 20 + 2 * k / 19
        share = 1 - 0.15 * (celsius - 20)
        assert tracker.update(replace(BENCH, ft=0.05 * share, Cd=5.0 * share), COVARIANCE, k) == []


def test_single_outlier_is_held_back_and_dropped() -> None:
    tracker = _build_tracker()
    assert _list_codes(tracker.update(replace(BENCH, R=0.7), COVARIANCE, 9)) == ["ParameterJump"]
    assert tracker.is_holding_back
    assert tracker.update(BENCH, COVARIANCE, 10) == []
    assert not tracker.is_holding_back


def test_step_is_accepted_after_two_further_estimates() -> None:
    tracker = _build_tracker()
    moved = replace(BENCH, R=0.7)
    for k in range(2):
        assert _list_codes(tracker.update(moved, COVARIANCE, 9 + k)) == ["ParameterJump"]
        assert tracker.is_holding_back
    notices = tracker.update(moved, COVARIANCE, 11)
    assert _list_codes(notices)[0] == "ParameterJump"
    assert not tracker.is_holding_back
    assert tracker.points[-1].values[0] == 0.7


@pytest.mark.fault("D4")
def test_changed_load_is_reported_at_once_and_used_from_the_second_estimate() -> None:
    tracker = _build_tracker()
    loaded = replace(BENCH, Jt=0.085)
    (first,) = tracker.update(loaded, COVARIANCE, 9)
    assert (first.code, first.severity) == ("LoadChanged", "MAJOR")
    assert tracker.is_holding_back
    (second,) = tracker.update(loaded, COVARIANCE, 10)
    assert second.code == "LoadChanged"
    assert tracker.points[-1].values[3] == 0.085
    assert tracker.update(loaded, COVARIANCE, 11) == []


@pytest.mark.fault("D4")
def test_disagreeing_estimates_stay_held_back() -> None:
    tracker = _build_tracker()
    for k in range(6):
        assert _list_codes(tracker.update(replace(BENCH, R=0.7 + 0.1 * k), COVARIANCE, 9 + k)) == ["ParameterJump"]
        assert tracker.is_holding_back


def test_alarm_has_hysteresis() -> None:
    tracker = _build_tracker()
    reported = []
    for k, share in enumerate([1.1, 1.3, 1.6, 1.9, 2.1, 2.05, 1.95, 1.85, 1.7, 1.5]):
        reported += tracker.update(replace(BENCH, Cd=5.0 * share), COVARIANCE, 20 + k)
    alarms = [notice for notice in reported if notice.code == "MaintenanceDue"]
    assert [a.severity for a in alarms] == ["minor", "info"]


def test_change_near_its_limit_raises_one_alarm() -> None:
    rng = np.random.default_rng(5)
    limits = Maintenance(Cd=0.1)
    tracker = DriftTracker(limits, "X")
    tracker.update(BENCH, COVARIANCE)
    reported = []
    for k in range(600):  # the deviation of an estimate is 1.6 %, the change varies between 9 and 13 %
        share = 1.11 + 0.02 * np.sin(k / 15)
        cd = 5.0 * share + 0.08 * rng.standard_normal()
        reported += tracker.update(replace(BENCH, Cd=cd), COVARIANCE, k)
    assert [notice.severity for notice in reported if notice.code == "MaintenanceDue"] == ["minor"]


def test_alarm_is_not_repeated_after_a_restart() -> None:
    stds = np.sqrt(np.diag(COVARIANCE))
    worn = np.array([*list(BENCH.as_dict().values())[:5], 10.5])
    tracker = DriftTracker(Maintenance(), "X")
    tracker.resume({1: BENCH}, [DriftPoint(worn, stds, k) for k in range(4)])
    assert tracker.alarms == {"Cd"}
    assert tracker.update(replace(BENCH, Cd=10.5), COVARIANCE, 9) == []
    back = [notice for k in range(6) for notice in tracker.update(BENCH, COVARIANCE, 10 + k)]
    assert [n.severity for n in back if n.code == "MaintenanceDue"] == ["info"]


def test_missing_parameters_are_tolerated() -> None:
    tracker = _build_tracker()
    unknown = replace(BENCH, ft=np.nan)
    covariance = COVARIANCE.copy()
    covariance[4, :] = covariance[:, 4] = np.nan
    assert tracker.update(unknown, covariance, 9) == []


def test_load_dependent_friction_by_direction_is_neither_jump_nor_wear() -> None:
    tracker = DriftTracker(Maintenance(Cd=0.3), "X")
    for k in range(12):
        side = 1 - 2 * (k % 2)
        assert tracker.update(replace(BENCH, Cd=5.0 + 2.5 * side), COVARIANCE, k, side) == []
    worn = replace(BENCH, Cd=2.5 * 1.9)  # of the negative direction: 90 % more, not 5 % less than 5
    assert _list_codes(tracker.update(worn, COVARIANCE, 13, -1)) == ["ParameterJump"]


def test_restart_compares_wear_with_the_first_values_per_direction() -> None:
    tracker = DriftTracker(Maintenance(Cd=0.3), "X")
    tracker.resume({1: BENCH, -1: replace(BENCH, Cd=2.5)}, [])
    assert tracker.update(replace(BENCH, Cd=2.6), COVARIANCE, 1, -1) == []
    assert _list_codes(tracker.update(replace(BENCH, Cd=3.9), COVARIANCE, 2, -1)) == ["MaintenanceDue"]
