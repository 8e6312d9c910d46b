"""Terms are added where they are significant, with valid intervals, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification import kalman
from fdhil.identification.candidate_terms import (
    build_ripple_regressors,
    build_stribeck_regressor,
    build_stribeck_slope_regressor,
    list_candidates,
)
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.innovations import compute_filter_gains, compute_signal_response, whiten_innovations
from fdhil.identification.likelihood_fit import compute_jacobian, estimate_typical_sizes
from fdhil.identification.prepared_motion import TermRegressor, prepare_window
from fdhil.identification.term_regressors import FIRST_TERM
from fdhil.pipeline import analyse_window
from fdhil.records import Estimate, Window
from studies.real_plant import ORDINARY_LOOPS, ORDINARY_MECHANICS, ORDINARY_SENSORS, Loops, Mechanics, Sensors
from tests.identification.realistic_rapids import simulate_rapids

SETTINGS = Identification()
TRUTH = np.array(list(Mechanics().truth().values()))


def _estimate_windows(window: Window, settings: Identification = SETTINGS) -> Estimate:
    return maximum_likelihood.estimate([window], settings)


def _count_deviations(estimate: Estimate, truth: np.ndarray = TRUTH) -> np.ndarray:
    found: np.ndarray = np.abs(estimate.values[:6] - truth) / np.sqrt(np.diag(estimate.covariance)[:6])
    return found


def test_no_term_is_added_without_one_in_the_data() -> None:
    for seed in range(4):
        for window in simulate_rapids(sensors=Sensors(noise=0.002), moves=2, seed=seed):
            assert _estimate_windows(window).terms == ()


def test_dead_time_of_a_commanded_voltage_is_identified_without_bias() -> None:
    (window,) = simulate_rapids(sensors=Sensors(command=True), loops=Loops(dead_time_v=2.0))
    estimate = _estimate_windows(window)
    assert estimate.terms == ("dead_time",)
    assert estimate.get_value("dead_time") == pytest.approx(2.0, abs=4 * estimate.get_std("dead_time"))
    assert estimate.get_std("dead_time") < 0.1
    assert _count_deviations(estimate).max() < 4.0
    assert analyse_window(window, SETTINGS).verdict.accepted


def test_terminal_voltage_excludes_dead_time_candidates() -> None:
    (window,) = simulate_rapids(sensors=Sensors(command=True), loops=Loops(dead_time_v=2.0))
    reported = _estimate_windows(window, Identification(voltage_source="terminals"))
    assert "dead_time" not in reported.terms


def test_bus_sag_is_identified_per_watt() -> None:
    (window,) = simulate_rapids(sensors=Sensors(command=True), loops=Loops(bus_sag=0.05, peak_power_w=10e3))
    estimate = _estimate_windows(window)
    assert estimate.get_value("bus_sag") == pytest.approx(5e-6, rel=0.02)
    assert _count_deviations(estimate).max() < 4.0


def test_ripple_is_identified_by_amplitude_and_phase() -> None:
    (window,) = simulate_rapids(Mechanics(screw_ripple=0.15, screw_phase=1.0), Sensors(noise=0.002))
    estimate = _estimate_windows(window)
    assert estimate.terms == ("ripple_screw_1", "ripple_screw_1_phase")
    assert estimate.get_value("ripple_screw_1") == pytest.approx(0.75, abs=4 * estimate.get_std("ripple_screw_1"))
    assert estimate.get_value("ripple_screw_1_phase") == pytest.approx(
        1.0, abs=4 * estimate.get_std("ripple_screw_1_phase")
    )
    assert 0.0 < estimate.get_std("ripple_screw_1") < 0.2


@pytest.mark.parametrize("static", [-0.4, 0.4])
def test_stribeck_friction_of_either_sign_is_added(static: float) -> None:
    there, back = simulate_rapids(Mechanics(static=static, static_speed_rad_s=25.0), Sensors(noise=0.001), moves=2)
    for window in (there, back):
        estimate = _estimate_windows(window)
        assert estimate.terms == ("stribeck", "stribeck_speed")
        assert estimate.get_value("stribeck") == pytest.approx(5.0 * static, abs=4 * estimate.get_std("stribeck"))
        assert estimate.get_value("stribeck_speed") == pytest.approx(25.0, abs=4 * estimate.get_std("stribeck_speed"))
        assert _count_deviations(estimate).max() < 4.0


def test_machine_with_all_effects_is_identified() -> None:
    """With a gain error of 1 % of the current sensor, R and L are smaller, Jt, ft and Cd larger by 1 %; gravity adds to
    Cd.
    """
    for window in simulate_rapids(ORDINARY_MECHANICS, ORDINARY_SENSORS, ORDINARY_LOOPS, moves=2):
        estimate = _estimate_windows(window)
        truth = TRUTH / np.array([1.01, 1.01, 1.0, 1 / 1.01, 1 / 1.01, 1 / 1.01])
        np.testing.assert_allclose(estimate.values[[0, 2, 3]], truth[[0, 2, 3]], rtol=0.005)
        assert estimate.get_value("dead_time") == pytest.approx(2.0, rel=0.1)
        assert estimate.get_value("bus_sag") == pytest.approx(3e-6, rel=0.1)
        assert estimate.get_value("speed_delay") == pytest.approx(5e-4, rel=0.02)


def test_joint_windows_are_fitted_with_their_terms() -> None:
    windows = simulate_rapids(sensors=Sensors(command=True), loops=Loops(dead_time_v=1.0), moves=2)
    estimate = maximum_likelihood.estimate(windows, SETTINGS)
    assert estimate.get_value("dead_time") == pytest.approx(1.0, abs=4 * estimate.get_std("dead_time"))
    assert estimate.covariance.shape == (7, 7)


def test_term_response_equals_the_derivative_of_innovations() -> None:
    motion = prepare_window(simulate_rapids()[0])
    load = TermRegressor("stribeck", kalman.LOAD, np.sin(np.arange(motion.n) / 40.0))
    drop = TermRegressor("dead_time", kalman.VOLTAGE, np.cos(np.arange(motion.n) / 60.0))
    wider = replace(motion, courses=(load, drop))
    theta = np.array([*TRUTH, 0.0, 0.3, 0.2])
    problem = maximum_likelihood.build_problem([wider], theta, [motion.noise])
    base = problem.compute_residuals(theta)
    free = [*range(6), FIRST_TERM, FIRST_TERM + 1]
    columns = compute_jacobian(problem, theta, base, free, estimate_typical_sizes(theta, [wider]))
    for k, j in enumerate(free[6:], start=6):
        moved = theta.copy()
        moved[j] += 0.1
        np.testing.assert_allclose(columns[:, k], (base - problem.compute_residuals(moved)) / 0.1, atol=1e-6)


def test_load_regressor_equals_dry_friction() -> None:
    motion = prepare_window(simulate_rapids()[0])
    theta = np.array([*TRUTH, 0.0])
    friction = TermRegressor(
        "stribeck", kalman.LOAD, np.where(np.abs(motion.mode) == 1, motion.mode, 0).astype(np.float64)
    )
    wider = replace(motion, courses=(friction,))
    less = np.append(theta, 2.0)
    less[kalman.CD] -= 2.0
    variances = motion.noise.to_array()[None] ** 2
    np.testing.assert_allclose(
        whiten_innovations(wider, less[None], variances)[0],
        whiten_innovations(motion, theta[None], variances)[0],
        atol=1e-9,
    )


def test_ripple_regressors_are_interval_means() -> None:
    motion = prepare_window(simulate_rapids()[0])
    sine, cosine = build_ripple_regressors(motion)["ripple_motor_12"]
    row = int(np.flatnonzero(np.abs(motion.mode) == 1)[200])
    angles = np.linspace(motion.angle_rad[row], motion.angle_rad[row + 1], 2001)
    assert sine.values[row] == pytest.approx(np.trapezoid(np.sin(12 * angles)) / 2000, abs=1e-4)
    assert cosine.values[row] == pytest.approx(np.trapezoid(np.cos(12 * angles)) / 2000, abs=1e-4)


def test_aliased_ripple_orders_are_excluded() -> None:
    motion = prepare_window(simulate_rapids()[0])
    top = float(np.abs(np.diff(motion.angle_rad)).max())
    orders = [int(name.rpartition("_")[2]) for name in build_ripple_regressors(motion)]
    assert max(orders) * top < np.pi
    assert 24 * top > np.pi, "the rows are too short for this test"


def test_stribeck_slope_equals_the_numerical_derivative() -> None:
    motion = prepare_window(simulate_rapids()[0])
    slope = build_stribeck_slope_regressor(motion, build_stribeck_regressor(motion, 20.0)).values
    change = (build_stribeck_regressor(motion, 20.01).values - build_stribeck_regressor(motion, 19.99).values) / 0.02
    np.testing.assert_allclose(slope, change, atol=1e-6)


@pytest.mark.usefixtures("long_computation")
def test_candidate_terms_respond_like_actual_effects() -> None:
    motion = prepare_window(simulate_rapids(sensors=Sensors(command=True), loops=Loops(dead_time_v=1.0))[0])
    theta = np.array([*TRUTH, 0.0])
    gains = compute_filter_gains(motion, theta, motion.noise)
    names = {c.family for c in list_candidates([motion], command=True)}
    assert {"stribeck", "ripple_screw_1", "ripple_motor_6", "dead_time", "bus_sag"} <= names
    assert "dead_time" not in {c.family for c in list_candidates([motion], command=False)}
    for candidate in list_candidates([motion], command=True):
        for course in candidate.courses[0]:
            assert np.isfinite(compute_signal_response(motion, theta, gains, course.kind, course.values[None])).all()
