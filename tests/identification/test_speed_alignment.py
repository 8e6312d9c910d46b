"""The lag of a late speed is estimated from the position, and removed before any other step."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.estimators import least_squares, maximum_likelihood
from fdhil.identification.speed_alignment import (
    align_speed_to_samples,
    apply_first_order_filter,
    convert_means_to_instants,
    differentiate_position,
    estimate_speed_lag,
    shift_samples,
)
from fdhil.pipeline import analyse_window
from fdhil.records import Float, Window, freeze_array
from studies.real_plant import Mechanics, Sensors
from tests.identification.realistic_rapids import simulate_rapids

TRUTH = np.array(list(Mechanics().truth().values()))
SETTINGS = Identification()
TIMES = np.arange(200) * 1e-3


@pytest.mark.parametrize(
    ("sensors", "late_us"),
    [
        (Sensors(speed="difference", encoder_bits=20), 500.0),
        (Sensors(speed="difference", encoder_bits=13), 500.0),
        (Sensors(speed="difference", filter_s=0.002), 2041.5),
        (Sensors(filter_s=0.002), 1541.5),
    ],
)
def test_speed_lag_is_estimated_from_the_position(sensors: Sensors, late_us: float) -> None:
    (window,) = simulate_rapids(sensors=sensors)
    reported = align_speed_to_samples(window)
    assert reported.speed_late_s is not None
    assert 1e6 * reported.speed_late_s == pytest.approx(late_us, abs=60.0)
    assert abs(1e6 * reported.speed_late_s - late_us) < 5 * 1e6 * reported.speed_late_std_s


@pytest.mark.parametrize("speed", ["sensor", "middle"])
def test_speed_without_lag_is_unchanged(speed: str) -> None:
    (window,) = simulate_rapids(sensors=Sensors(speed=speed))
    assert align_speed_to_samples(window) is window


def test_aligned_speed_matches_the_shaft() -> None:
    (window,) = simulate_rapids(sensors=Sensors(noise=0.0, speed="difference", encoder_bits=24))
    (true,) = simulate_rapids(sensors=Sensors(noise=0.0))
    rows = np.flatnonzero(np.abs(true.speed_rad_s) > 10.0)
    shift = window.start_tick - true.start_tick
    reported = align_speed_to_samples(window).speed_rad_s[rows - shift]
    assert np.abs(window.speed_rad_s[rows - shift] - true.speed_rad_s[rows]).max() > 0.5
    assert np.abs(reported - true.speed_rad_s[rows]).max() < 0.02


@pytest.mark.parametrize("estimator", [maximum_likelihood, least_squares])
def test_speed_from_position_differences_does_not_bias_parameters(estimator: ModuleType) -> None:
    (window,) = simulate_rapids(sensors=Sensors(speed="difference", encoder_bits=16))
    estimate = estimator.estimate([window], SETTINGS)
    apart = np.abs(estimate.values[:6] - TRUTH) / np.sqrt(np.diag(estimate.covariance)[:6])
    assert apart.max() < 4.0
    np.testing.assert_allclose(estimate.values[:4], TRUTH[:4], rtol=0.01)


def test_the_lag_is_told_with_the_parameters_and_the_window_stays_as_recorded() -> None:
    (window,) = simulate_rapids(sensors=Sensors(speed="difference", encoder_bits=16))
    outcome = analyse_window(window, SETTINGS)
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert outcome.window is window
    assert outcome.estimate is not None
    assert outcome.estimate.get_value("speed_delay") == pytest.approx(5e-4, abs=2e-5)
    assert outcome.estimate.get_std("speed_delay") < 2e-5


def test_a_setting_says_what_the_speed_is() -> None:
    (window,) = simulate_rapids(sensors=Sensors(speed="difference"))
    assert align_speed_to_samples(window, "sensor") is window
    (steady,) = simulate_rapids()
    reported = estimate_speed_lag(steady, "difference")
    assert reported is not None
    assert reported.mean
    assert estimate_speed_lag(steady, "filtered") is None or estimate_speed_lag(steady, "filtered") != reported


def test_other_speed_errors_are_not_taken_for_a_lag() -> None:
    (window,) = simulate_rapids(sensors=Sensors(speed="difference"))
    position = np.array(window.position_mm)
    position[400:] += 3.0  # samples are lost there
    assert align_speed_to_samples(replace(window, position_mm=freeze_array(position))).speed_late_s is None
    stuck = replace(window, position_mm=freeze_array(np.full(window.n, 7.0)))
    assert align_speed_to_samples(stuck) is stuck


def test_lost_samples_stay_lost_after_alignment() -> None:
    (window,) = simulate_rapids(sensors=Sensors(speed="difference"))
    holed = _remove_samples(window, 300, 303)
    reported = align_speed_to_samples(holed)
    assert reported.speed_late_s is not None
    assert np.isnan(reported.speed_rad_s[300:303]).all()
    assert np.isnan(reported.speed_rad_s).sum() <= 9


def _remove_samples(window: Window, begin: int, end: int) -> Window:
    def blank_samples(values: Float | None) -> Float:
        rows = np.array(values)
        rows[begin:end] = np.nan
        return freeze_array(rows)

    return replace(
        window,
        gaps=((begin, end),),
        speed_rad_s=blank_samples(window.speed_rad_s),
        current_a=blank_samples(window.current_a),
        voltage_v=blank_samples(window.voltage_v),
        position_mm=blank_samples(window.position_mm),
    )


def test_alignment_stencils_are_exact_for_cubics() -> None:
    course, slope = TIMES**3 - 0.1 * TIMES**2 + TIMES, 3 * TIMES**2 - 0.2 * TIMES + 1.0
    inside = slice(3, -3)
    np.testing.assert_allclose(differentiate_position(course, 1e-3)[inside], slope[inside], atol=1e-12)
    whole = TIMES**4 / 4 - 0.1 * TIMES**3 / 3 + TIMES**2 / 2
    means = np.diff(whole, prepend=0.0) / 1e-3
    np.testing.assert_allclose(convert_means_to_instants(means)[inside], course[inside], atol=1e-12)
    np.testing.assert_allclose(
        shift_samples(course, 2.3)[inside][:-3], np.interp(TIMES + 2.3e-3, TIMES, course)[inside][:-3], atol=1e-6
    )


def test_first_order_filter_keeps_its_share_per_sample() -> None:
    rng = np.random.default_rng(3)
    values = rng.standard_normal(50)
    expected = values.copy()
    for k in range(1, 50):
        expected[k] = 0.6 * expected[k - 1] + 0.4 * values[k]
    np.testing.assert_allclose(apply_first_order_filter(values, 0.6), expected, atol=1e-5)
