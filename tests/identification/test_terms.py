"""Terms are added where they are significant, with valid intervals, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification import kalman
from fdhil.identification.courses import FIRST_COURSE
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.fit import jacobian, typical
from fdhil.identification.innovations import answers, gains_of, whiten
from fdhil.identification.motion import Course, prepare
from fdhil.identification.terms import candidates, ripples, stribeck, stribeck_slope
from fdhil.pipeline import analyse
from fdhil.records import Estimate, Window
from studies.real_plant import ORDINARY_LOOPS, ORDINARY_MECHANICS, ORDINARY_SENSORS, Loops, Mechanics, Sensors
from tests.identification.realistic import rapids

SETTINGS = Identification()
TRUTH = np.array(list(Mechanics().truth().values()))


def _estimate(window: Window, settings: Identification = SETTINGS) -> Estimate:
    return maximum_likelihood.estimate([window], settings)


def _apart(estimate: Estimate, truth: np.ndarray = TRUTH) -> np.ndarray:
    found: np.ndarray = np.abs(estimate.values[:6] - truth) / np.sqrt(np.diag(estimate.covariance)[:6])
    return found


def test_no_term_joins_where_there_is_none() -> None:
    for seed in range(4):
        for window in rapids(sensors=Sensors(noise=0.002), moves=2, seed=seed):
            assert _estimate(window).terms == ()


def test_the_dead_time_of_a_commanded_voltage_is_told_and_biases_nothing() -> None:
    (window,) = rapids(sensors=Sensors(command=True), loops=Loops(dead_time_v=2.0))
    estimate = _estimate(window)
    assert estimate.terms == ("dead_time",)
    assert estimate.get_value("dead_time") == pytest.approx(2.0, abs=4 * estimate.get_std("dead_time"))
    assert estimate.get_std("dead_time") < 0.1
    assert _apart(estimate).max() < 4.0
    assert analyse(window, SETTINGS).verdict.accepted


def test_at_the_terminals_no_dead_time_is_looked_for() -> None:
    (window,) = rapids(sensors=Sensors(command=True), loops=Loops(dead_time_v=2.0))
    told = _estimate(window, Identification(voltage_source="terminals"))
    assert "dead_time" not in told.terms


def test_a_bus_that_sags_is_told_per_watt() -> None:
    (window,) = rapids(sensors=Sensors(command=True), loops=Loops(bus_sag=0.05, peak_power_w=10e3))
    estimate = _estimate(window)
    assert estimate.get_value("bus_sag") == pytest.approx(5e-6, rel=0.02)
    assert _apart(estimate).max() < 4.0


def test_a_ripple_has_amplitude_and_phase() -> None:
    (window,) = rapids(Mechanics(screw_ripple=0.15, screw_phase=1.0), Sensors(noise=0.002))
    estimate = _estimate(window)
    assert estimate.terms == ("ripple_screw_1", "ripple_screw_1_phase")
    assert estimate.get_value("ripple_screw_1") == pytest.approx(0.75, abs=4 * estimate.get_std("ripple_screw_1"))
    assert estimate.get_value("ripple_screw_1_phase") == pytest.approx(
        1.0, abs=4 * estimate.get_std("ripple_screw_1_phase")
    )
    assert 0.0 < estimate.get_std("ripple_screw_1") < 0.2


@pytest.mark.parametrize("static", [-0.4, 0.4])
def test_friction_that_rises_or_falls_at_low_speed_joins(static: float) -> None:
    there, back = rapids(Mechanics(static=static, static_speed_rad_s=25.0), Sensors(noise=0.001), moves=2)
    for window in (there, back):
        estimate = _estimate(window)
        assert estimate.terms == ("stribeck", "stribeck_speed")
        assert estimate.get_value("stribeck") == pytest.approx(5.0 * static, abs=4 * estimate.get_std("stribeck"))
        assert estimate.get_value("stribeck_speed") == pytest.approx(25.0, abs=4 * estimate.get_std("stribeck_speed"))
        assert _apart(estimate).max() < 4.0


def test_an_ordinary_machine_with_everything_at_once_is_known() -> None:
    """With a gain error of 1 % of the current sensor, R and L are smaller, Jt, ft and Cd larger by 1 %; gravity adds to
    Cd.
    """
    for window in rapids(ORDINARY_MECHANICS, ORDINARY_SENSORS, ORDINARY_LOOPS, moves=2):
        estimate = _estimate(window)
        truth = TRUTH / np.array([1.01, 1.01, 1.0, 1 / 1.01, 1 / 1.01, 1 / 1.01])
        np.testing.assert_allclose(estimate.values[[0, 2, 3]], truth[[0, 2, 3]], rtol=0.005)
        assert estimate.get_value("dead_time") == pytest.approx(2.0, rel=0.1)
        assert estimate.get_value("bus_sag") == pytest.approx(3e-6, rel=0.1)
        assert estimate.get_value("speed_delay") == pytest.approx(5e-4, rel=0.02)


def test_windows_are_fitted_together_with_their_terms() -> None:
    windows = rapids(sensors=Sensors(command=True), loops=Loops(dead_time_v=1.0), moves=2)
    estimate = maximum_likelihood.estimate(windows, SETTINGS)
    assert estimate.get_value("dead_time") == pytest.approx(1.0, abs=4 * estimate.get_std("dead_time"))
    assert estimate.covariance.shape == (7, 7)


def test_a_terms_column_is_the_derivative_of_the_innovations() -> None:
    motion = prepare(rapids()[0])
    load = Course("stribeck", kalman.LOAD, np.sin(np.arange(motion.n) / 40.0))
    drop = Course("dead_time", kalman.VOLTAGE, np.cos(np.arange(motion.n) / 60.0))
    wider = replace(motion, courses=(load, drop))
    theta = np.array([*TRUTH, 0.0, 0.3, 0.2])
    problem = maximum_likelihood.pose([wider], theta, [motion.noise])
    base = problem.residuals(theta)
    free = [*range(6), FIRST_COURSE, FIRST_COURSE + 1]
    columns = jacobian(problem, theta, base, free, typical(theta, [wider]))
    for k, j in enumerate(free[6:], start=6):
        moved = theta.copy()
        moved[j] += 0.1
        np.testing.assert_allclose(columns[:, k], (base - problem.residuals(moved)) / 0.1, atol=1e-6)


def test_a_load_course_is_what_dry_friction_was() -> None:
    motion = prepare(rapids()[0])
    theta = np.array([*TRUTH, 0.0])
    friction = Course("stribeck", kalman.LOAD, np.where(np.abs(motion.mode) == 1, motion.mode, 0).astype(np.float64))
    wider = replace(motion, courses=(friction,))
    less = np.append(theta, 2.0)
    less[kalman.CD] -= 2.0
    variances = motion.noise.vector()[None] ** 2
    np.testing.assert_allclose(
        whiten(wider, less[None], variances)[0], whiten(motion, theta[None], variances)[0], atol=1e-9
    )


def test_ripples_are_means_over_each_interval() -> None:
    motion = prepare(rapids()[0])
    sine, cosine = ripples(motion)["ripple_motor_12"]
    row = int(np.flatnonzero(np.abs(motion.mode) == 1)[200])
    angles = np.linspace(motion.angle_rad[row], motion.angle_rad[row + 1], 2001)
    assert sine.values[row] == pytest.approx(np.trapezoid(np.sin(12 * angles)) / 2000, abs=1e-4)
    assert cosine.values[row] == pytest.approx(np.trapezoid(np.cos(12 * angles)) / 2000, abs=1e-4)


def test_an_order_that_looks_like_another_in_these_rows_is_none() -> None:
    motion = prepare(rapids()[0])
    top = float(np.abs(np.diff(motion.angle_rad)).max())
    orders = [int(name.rpartition("_")[2]) for name in ripples(motion)]
    assert max(orders) * top < np.pi
    assert 24 * top > np.pi, "the rows are too short for this test"


def test_how_low_speed_friction_changes_with_its_speed() -> None:
    motion = prepare(rapids()[0])
    slope = stribeck_slope(motion, stribeck(motion, 20.0)).values
    change = (stribeck(motion, 20.01).values - stribeck(motion, 19.99).values) / 0.02
    np.testing.assert_allclose(slope, change, atol=1e-6)


@pytest.mark.usefixtures("long_computation")
def test_what_may_join_answers_as_it_is_there() -> None:
    motion = prepare(rapids(sensors=Sensors(command=True), loops=Loops(dead_time_v=1.0))[0])
    theta = np.array([*TRUTH, 0.0])
    gains = gains_of(motion, theta, motion.noise)
    names = {c.family for c in candidates([motion], command=True)}
    assert {"stribeck", "ripple_screw_1", "ripple_motor_6", "dead_time", "bus_sag"} <= names
    assert "dead_time" not in {c.family for c in candidates([motion], command=False)}
    for candidate in candidates([motion], command=True):
        for course in candidate.courses[0]:
            assert np.isfinite(answers(motion, theta, gains, course.kind, course.values[None])).all()
