"""The lag of a late speed is estimated from the position, and removed before any other step."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.estimators import least_squares, maximum_likelihood
from fdhil.identification.signals import between_means, filtered, lag_of, mended, of_position, shifted
from fdhil.pipeline import analyse
from fdhil.records import Float, Window, freeze_array
from studies.real_plant import Mechanics, Sensors
from tests.identification.realistic import rapids

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
def test_the_position_tells_how_late_a_speed_is(sensors: Sensors, late_us: float) -> None:
    (window,) = rapids(sensors=sensors)
    told = mended(window)
    assert told.speed_late_s is not None
    assert 1e6 * told.speed_late_s == pytest.approx(late_us, abs=60.0)
    assert abs(1e6 * told.speed_late_s - late_us) < 5 * 1e6 * told.speed_late_std_s


@pytest.mark.parametrize("speed", ["sensor", "middle"])
def test_a_speed_of_the_instants_stays_as_it_is(speed: str) -> None:
    (window,) = rapids(sensors=Sensors(speed=speed))
    assert mended(window) is window


def test_a_mended_speed_is_that_of_the_shaft() -> None:
    (window,) = rapids(sensors=Sensors(noise=0.0, speed="difference", encoder_bits=24))
    (true,) = rapids(sensors=Sensors(noise=0.0))
    rows = np.flatnonzero(np.abs(true.speed_rad_s) > 10.0)
    shift = window.start_tick - true.start_tick
    told = mended(window).speed_rad_s[rows - shift]
    assert np.abs(window.speed_rad_s[rows - shift] - true.speed_rad_s[rows]).max() > 0.5
    assert np.abs(told - true.speed_rad_s[rows]).max() < 0.02


@pytest.mark.parametrize("estimator", [maximum_likelihood, least_squares])
def test_a_difference_of_positions_biases_no_parameter(estimator: ModuleType) -> None:
    (window,) = rapids(sensors=Sensors(speed="difference", encoder_bits=16))
    estimate = estimator.estimate([window], SETTINGS)
    apart = np.abs(estimate.values[:6] - TRUTH) / np.sqrt(np.diag(estimate.covariance)[:6])
    assert apart.max() < 4.0
    np.testing.assert_allclose(estimate.values[:4], TRUTH[:4], rtol=0.01)


def test_the_lag_is_told_with_the_parameters_and_the_window_stays_as_recorded() -> None:
    (window,) = rapids(sensors=Sensors(speed="difference", encoder_bits=16))
    outcome = analyse(window, SETTINGS)
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert outcome.window is window
    assert outcome.estimate is not None
    assert outcome.estimate.get_value("speed_delay") == pytest.approx(5e-4, abs=2e-5)
    assert outcome.estimate.get_std("speed_delay") < 2e-5


def test_a_setting_says_what_the_speed_is() -> None:
    (window,) = rapids(sensors=Sensors(speed="difference"))
    assert mended(window, "sensor") is window
    (steady,) = rapids()
    told = lag_of(steady, "difference")
    assert told is not None
    assert told.mean
    assert lag_of(steady, "filtered") is None or lag_of(steady, "filtered") != told


def test_what_parts_speed_and_position_otherwise_is_no_lag() -> None:
    (window,) = rapids(sensors=Sensors(speed="difference"))
    position = np.array(window.position_mm)
    position[400:] += 3.0  # samples are lost there
    assert mended(replace(window, position_mm=freeze_array(position))).speed_late_s is None
    stuck = replace(window, position_mm=freeze_array(np.full(window.n, 7.0)))
    assert mended(stuck) is stuck


def test_lost_rows_stay_lost() -> None:
    (window,) = rapids(sensors=Sensors(speed="difference"))
    holed = _without(window, 300, 303)
    told = mended(holed)
    assert told.speed_late_s is not None
    assert np.isnan(told.speed_rad_s[300:303]).all()
    assert np.isnan(told.speed_rad_s).sum() <= 9


def _without(window: Window, begin: int, end: int) -> Window:
    def lost(values: Float | None) -> Float:
        rows = np.array(values)
        rows[begin:end] = np.nan
        return freeze_array(rows)

    return replace(
        window,
        gaps=((begin, end),),
        speed_rad_s=lost(window.speed_rad_s),
        current_a=lost(window.current_a),
        voltage_v=lost(window.voltage_v),
        position_mm=lost(window.position_mm),
    )


def test_the_stencils_are_exact_for_cubics() -> None:
    course, slope = TIMES**3 - 0.1 * TIMES**2 + TIMES, 3 * TIMES**2 - 0.2 * TIMES + 1.0
    inside = slice(3, -3)
    np.testing.assert_allclose(of_position(course, 1e-3)[inside], slope[inside], atol=1e-12)
    whole = TIMES**4 / 4 - 0.1 * TIMES**3 / 3 + TIMES**2 / 2
    means = np.diff(whole, prepend=0.0) / 1e-3
    np.testing.assert_allclose(between_means(means)[inside], course[inside], atol=1e-12)
    np.testing.assert_allclose(
        shifted(course, 2.3)[inside][:-3], np.interp(TIMES + 2.3e-3, TIMES, course)[inside][:-3], atol=1e-6
    )


def test_a_filter_keeps_its_share_of_the_row_before() -> None:
    rng = np.random.default_rng(3)
    values = rng.standard_normal(50)
    expected = values.copy()
    for k in range(1, 50):
        expected[k] = 0.6 * expected[k - 1] + 0.4 * values[k]
    np.testing.assert_allclose(filtered(values, 0.6), expected, atol=1e-5)
