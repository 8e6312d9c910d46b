"""Forecasts of a path's error from the parameters' history."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.prediction import compute_sensitivity_um, predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.prediction.error_forecast import (
    ParameterTrend,
    compare_zones,
    compute_step_costs,
    find_last_step,
    fit_parameter_trend,
    predict_tolerance_crossing,
)
from fdhil.records import PARAMETERS, Parameters, ParameterSet, Trajectory, freeze_array, freeze_integers
from tests.bench import bench_config
from tests.paths import build_bench_trajectory

CONFIG = bench_config()
NOMINAL = build_nominal_models(CONFIG)["X"]
STD = np.array([0.003 * value for value in NOMINAL.as_dict().values()])


def make_parameter_set(axis: str, revision: int, **changed: float) -> ParameterSet:
    """Return a set with some values other than nominal, known to 0.3 %."""
    values = NOMINAL.replace_values(**changed)
    return ParameterSet(axis, revision, values, freeze_array(np.diag(STD**2)), 3, 0, None, "digest")


def add_line_numbers(reference: Trajectory) -> Trajectory:
    """Return the reference as a program with one line per 100 ms."""
    return replace(reference, line=freeze_integers(1 + np.arange(reference.time_s.size) // 100))


def test_fixture_cost_equals_prediction_difference() -> None:
    """Jt + 13 % on X: the largest rise of the contour error, at its line; Y has not changed."""
    reference = add_line_numbers(build_bench_trajectory(10))
    now = {"X": make_parameter_set("X", 4, Jt=0.085), "Y": make_parameter_set("Y", 9)}
    earlier = {"X": make_parameter_set("X", 3), "Y": make_parameter_set("Y", 8)}
    models = {axis: known.parameters for axis, known in now.items()}
    predicted = predict_path(reference, models, CONFIG)
    (step,) = compute_step_costs(predicted, models, earlier, now, CONFIG)
    assert (step.axis, step.what, step.since_revision) == ("X", "inertia", 3)
    assert step.changed == {"Jt": (0.075, 0.085)}
    rise = predicted.contour_um - predict_path(reference, {"X": NOMINAL, "Y": NOMINAL}, CONFIG).contour_um
    assert step.cost_um == pytest.approx(float(rise.max()))
    assert step.cost_um > 5
    assert step.line == reference.line[int(np.argmax(rise))]


def test_new_and_gone_zones_are_reported_with_cause() -> None:
    reference = add_line_numbers(build_bench_trajectory(10))
    earlier = {"X": NOMINAL, "Y": replace(NOMINAL, Cd=1.0, Jt=0.06)}
    models = {"X": replace(NOMINAL, Jt=0.085), "Y": NOMINAL}
    predicted, then = predict_path(reference, models, CONFIG), predict_path(reference, earlier, CONFIG)
    std = np.full(reference.time_s.size, 0.3)
    recorded = [(zone, 0.4) for zone in then.zones]
    changes = compare_zones(predicted, models, earlier, std, recorded, CONFIG, same_settings=True)
    assert len(changes) >= len(predicted.zones)
    assert {(axis, name) for change in changes for axis, name, _ in change.by} == {
        ("X", "Jt"),
        ("Y", "Jt"),
        ("Y", "Cd"),
    }
    assert all(change.settings_um is None for change in changes)
    assert len({change.by[0][:2] for change in changes}) > 1
    largest = max(changes, key=lambda change: abs(change.now_um - change.before_um))
    assert sum(um for _, _, um in largest.by) == pytest.approx(largest.now_um - largest.before_um, rel=0.3)
    assert largest.std_um == pytest.approx(0.5)
    gone = [z for z in then.zones if all(z.end_s <= o.start_s or z.start_s >= o.end_s for o in predicted.zones)]
    assert {zone.where for zone in gone} <= {change.where for change in changes}
    assert gone


def test_improvement_has_negative_cost() -> None:
    reference = build_bench_trajectory(10)
    low, usual = {"X": make_parameter_set("X", 2, ft=0.01, Cd=1.0)}, {"X": make_parameter_set("X", 1)}
    costs = []
    for earlier, now in ((usual, low), (low, usual)):
        models = {"X": now["X"].parameters, "Y": NOMINAL}
        (step,) = compute_step_costs(predict_path(reference, models, CONFIG), models, earlier, now, CONFIG)
        assert step.what == "friction"
        assert set(step.changed) == {"ft", "Cd"}
        assert step.line == 0
        costs.append(step.cost_um)
    assert costs[0] > 5
    assert costs[1] == pytest.approx(-costs[0])


def test_last_step_is_found_and_drift_ignored() -> None:
    course = [0.075, 0.0752, 0.0751, 0.085, 0.0851]
    assert find_last_step([make_parameter_set("X", k, Jt=jt) for k, jt in enumerate(course)]) == 2
    assert find_last_step([make_parameter_set("X", k, Jt=0.075 + 0.0005 * k) for k in range(9)]) is None
    assert find_last_step([make_parameter_set("X", k, Jt=jt) for k, jt in enumerate([0.075, 0.085, 0.0752])]) == 1
    assert find_last_step([]) is None


def test_tolerance_crossing_day_is_predicted() -> None:
    """Jt rises by 0.1 % a day: with that day's parameters the predicted error equals the tolerance."""
    reference = build_bench_trajectory(10)
    days = np.arange(-20.0, 1.0)
    random = np.random.default_rng(3)
    sets = [
        make_parameter_set("Y", k, Jt=0.075 * (1 + 0.001 * day) + random.normal(0, 3e-5)) for k, day in enumerate(days)
    ]
    courses = {"Y": select_inertia(fit_parameter_trend(sets, days))}
    models = {"X": NOMINAL, "Y": NOMINAL}
    predicted = predict_path(reference, models, CONFIG)
    k = next(k for k, zone in enumerate(predicted.zones) if zone.cause == "corner")
    zone, reported = predicted.zones[k], compute_sensitivity_um(predicted, models, CONFIG)[k]
    tolerance = zone.max_um + 4.0
    found = predict_tolerance_crossing(zone, reported, models, courses, tolerance)
    assert found is not None
    assert (found.axis, found.parameter) == ("Y", "Jt")
    assert found.earliest_days < found.days < found.latest_days
    then = replace(NOMINAL, Jt=0.075 * (1 + 0.001 * found.days))
    rows = (reference.time_s >= zone.start_s) & (reference.time_s < zone.end_s)
    error = predict_path(reference, {"X": NOMINAL, "Y": then}, CONFIG).contour_um[rows].max()
    assert error == pytest.approx(tolerance, abs=0.5)
    # the same slope, seen for a fifth of the time that it would have to be followed at most, foresees nothing
    short = {"Y": replace(courses["Y"], span_days=0.19 * found.days)}
    assert predict_tolerance_crossing(zone, reported, models, short, tolerance) is None


def select_inertia(known: ParameterTrend) -> ParameterTrend:
    return replace(known, slopes={"Jt": known.slopes["Jt"]})


def test_insignificant_trend_yields_no_crossing() -> None:
    reference = build_bench_trajectory(10)
    models = {"X": NOMINAL, "Y": NOMINAL}
    predicted = predict_path(reference, models, CONFIG)
    k = next(k for k, zone in enumerate(predicted.zones) if zone.cause == "corner")
    zone, reported = predicted.zones[k], compute_sensitivity_um(predicted, models, CONFIG)[k]
    days = np.arange(-9.0, 1.0)
    for rises in (np.zeros(10), -0.001 * days):
        sets = [make_parameter_set("Y", n, Jt=0.075 * (1 + rise)) for n, rise in enumerate(rises)]
        courses = {"Y": select_inertia(fit_parameter_trend(sets, days))}
        rising = reported["Y"]["Jt"] * courses["Y"].slopes["Jt"].value > 0 and rises.any()
        assert (predict_tolerance_crossing(zone, reported, models, courses, zone.max_um + 4.0) is not None) == rising


def test_trends_start_after_last_step() -> None:
    values = [0.075] * 6 + [0.085] * 6
    found = fit_parameter_trend([make_parameter_set("X", k, Jt=jt) for k, jt in enumerate(values)], np.arange(12.0))
    assert abs(found.slopes["Jt"].value) < 1e-9
    assert set(found.slopes) == set(PARAMETERS)
    assert found.span_days == 5.0


def test_set_without_covariance_has_steps() -> None:
    unknown = freeze_array(np.full((6, 6), np.nan))
    before, after = (
        replace(make_parameter_set("X", k, Jt=jt), covariance=unknown) for k, jt in ((1, 0.075), (2, 0.085))
    )
    assert find_last_step([before, after]) == 0
    assert isinstance(before.parameters, Parameters)


def test_added_or_removed_term_is_reported_as_whole() -> None:
    """The effect of falling friction since a prediction without it, and the reverse."""
    reference = build_bench_trajectory(10)
    rich = NOMINAL.replace_values(stribeck=2.0, stribeck_speed=10.0)
    for earlier, now in ((NOMINAL, rich), (rich, NOMINAL)):
        models = {"X": now, "Y": now}
        prediction = predict_path(reference, models, CONFIG)
        std_um = np.zeros(prediction.contour_um.size)
        changes = compare_zones(prediction, models, {"X": earlier, "Y": earlier}, std_um, (), CONFIG, True)
        named = {(axis, name) for change in changes for axis, name, _ in change.by}
        assert named == {("X", "stribeck"), ("Y", "stribeck")}
        assert any(abs(change.now_um - change.before_um) > 1.0 for change in changes)
