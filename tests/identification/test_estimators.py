"""Every listed estimator on the bench: accurate, with valid intervals, equivariant, and empty where nothing is
determined.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fdhil import tables
from fdhil.config import Identification
from fdhil.identification.between import ALIKE
from fdhil.identification.estimators import Estimator, chosen, least_squares, maximum_likelihood
from fdhil.identification.normal import inverse_of
from fdhil.identification.pooling import member, pooled
from fdhil.identification.windows import find_windows
from fdhil.records import PARAMETERS, Estimate, Float, Result, Window, freeze_array
from fdhil.store.recording_csv import parse_recording
from studies import bench, instrumental_variables
from tests.identification.recorded import signals, windows

SETTINGS = Identification()
TRUTH = np.array([bench.Plant().truth()[name] for name in PARAMETERS])
# largest error of one rapid at 0.1 % noise, %, in the order of PARAMETERS: any estimator, and the most accurate one
REACH = (0.3, 0.6, 0.1, 0.5, 8.0, 12.0)
CLOSER: dict[str, tuple[float, ...]] = {"maximum_likelihood": (0.1, 0.2, 0.05, 0.1, 1.5, 2.0)}


@pytest.fixture(params=[*tables.ESTIMATORS, instrumental_variables.NAME])
def name(request: pytest.FixtureRequest) -> str:
    """The name of a listed estimator, or of the one that only studies use."""
    return str(request.param)


def _estimator(name: str) -> Estimator:
    if name == instrumental_variables.NAME:
        return instrumental_variables.estimate
    return chosen(SETTINGS.model_copy(update={"method": name}))[1]


def _errors_percent(estimate: Estimate) -> Float:
    errors: Float = 100 * np.abs(estimate.values / TRUTH - 1)
    return errors


def _chance(estimate: Estimate) -> Float:
    """Return the variances (6,) without the model doubts, which more windows do not reduce."""
    shared = estimate.systematic
    doubts = np.zeros(6) if shared is None else np.square(shared[:6]).sum(axis=1)
    variances: Float = np.diag(estimate.covariance)[:6] - doubts
    return variances


def test_the_named_default_is_taken() -> None:
    assert chosen(SETTINGS)[0] == tables.DEFAULT_ESTIMATOR == "maximum_likelihood"


def test_one_rapid(name: str) -> None:
    estimate = _estimator(name)(windows(0.001), SETTINGS)
    assert estimate.result is Result.OK
    assert estimate.method == name
    assert (_errors_percent(estimate) < CLOSER.get(name, REACH)).all()


def test_windows_together_beat_one(name: str) -> None:
    estimate = _estimator(name)(windows(0.005, moves=4), SETTINGS)
    assert (_errors_percent(estimate) < (1.0, 1.0, 1.0, 1.0, 5.0, 5.0)).all()
    one = _estimator(name)(windows(0.005, moves=4)[:1], SETTINGS)
    assert (_chance(estimate)[:4] < _chance(one)[:4]).all()


def test_deviations_are_honest(name: str) -> None:
    scores = []
    for seed in range(8):
        estimate = _estimator(name)(windows(0.005, seed), SETTINGS)
        scores.append((estimate.values - TRUTH) / np.sqrt(_chance(estimate)))
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert (rms > 0.3).all()
    assert (rms < 2.0).all()


def test_either_direction_gives_the_same(name: str) -> None:
    window = windows(0.002)[0]
    assert window.voltage_v is not None
    mirrored = replace(
        window,
        voltage_v=freeze_array(-window.voltage_v),
        current_a=freeze_array(-window.current_a),
        speed_rad_s=freeze_array(-window.speed_rad_s),
        direction=-1,
    )
    there, back = (_estimator(name)([w], SETTINGS) for w in (window, mirrored))
    np.testing.assert_allclose(back.values, there.values, rtol=1e-6)


def test_order_of_windows_does_not_matter(name: str) -> None:
    three = windows(0.005, moves=3)
    there, back = (_estimator(name)(order, SETTINGS) for order in (three, three[::-1]))
    np.testing.assert_allclose(back.values, there.values, rtol=1e-5)


def test_scaled_units_scale_the_parameters(name: str) -> None:
    window = windows(0.002)[0]
    assert window.voltage_v is not None
    in_kilovolt = replace(window, voltage_v=freeze_array(window.voltage_v * 1e-3))
    plain, scaled = (_estimator(name)([w], SETTINGS) for w in (window, in_kilovolt))
    # torque = K i is in kilo-units too, so every parameter shrinks by the same factor
    np.testing.assert_allclose(scaled.values, plain.values * 1e-3, rtol=1e-4)


def test_lost_rows_are_left_out(name: str) -> None:
    window = windows(0.001)[0]
    assert window.voltage_v is not None
    lost = {}
    for field in ("voltage_v", "current_a", "speed_rad_s"):
        values = np.array(getattr(window, field))
        values[400:403] = np.nan
        lost[field] = freeze_array(values)
    holed = Window(**{f: getattr(window, f) for f in window.__slots__} | lost | {"gaps": ((400, 403),)})
    assert (_errors_percent(_estimator(name)([holed], SETTINGS)) < CLOSER.get(name, REACH)).all()


def test_instants_of_a_switching_voltage_are_honest(name: str) -> None:
    clean = signals()
    sampled = replace(clean, voltage=clean.voltage_instant)
    found = find_windows(parse_recording(bench.as_csv(sampled, 0.003, 1, voltage_sampling="instant")))
    estimate = _estimator(name)(found, SETTINGS)
    apart = np.abs(estimate.values - TRUTH) / np.sqrt(np.diag(estimate.covariance))
    assert (apart < 3.0).all()


def test_nothing_to_fit_is_told(name: str) -> None:
    window = windows(0.001)[0]
    still = replace(window, speed_rad_s=freeze_array(np.zeros(window.n)))
    estimate = _estimator(name)([still], SETTINGS)
    assert estimate.result is not Result.OK
    assert set(estimate.missing) == set(PARAMETERS)
    assert np.isnan(estimate.values).all()


def test_a_window_without_a_voltage_is_left_out(name: str) -> None:
    window = windows(0.001)[0]
    without = replace(window, voltage_v=None)
    alone, beside = (_estimator(name)(given, SETTINGS) for given in ([without], [window, without]))
    assert alone.result is not Result.OK
    assert np.isnan(alone.values).all()
    assert (_errors_percent(beside) < CLOSER.get(name, REACH)).all()


def test_instruments_take_the_bias_of_raw_noise_out() -> None:
    unfiltered = SETTINGS.model_copy(update={"lowpass_hz": 1e6})
    plain, paired = [], []
    for seed in range(12):
        found = windows(0.005, seed)
        signals = [least_squares.align(w, unfiltered) for w in found]
        plain.append(least_squares.raw_values(signals, [w.dt_s for w in found]))
        paired.append(instrumental_variables.raw_values(found, unfiltered))
    biased, clean = (np.mean(np.array(values), axis=0) / TRUTH - 1 for values in (plain, paired))
    inertia = PARAMETERS.index("Jt")
    assert biased[inertia] < -0.5
    assert abs(clean[inertia]) < 0.01
    assert np.abs(clean[[0, 2]]).max() < 0.002


def test_instruments_need_a_demand_that_moves() -> None:
    window = windows(0.002)[0]
    still = replace(window, demand_mm=freeze_array(np.zeros(window.n)))
    estimate = _estimator("instrumental_variables")([still], SETTINGS)
    assert estimate.result is not Result.OK
    assert np.isnan(estimate.values).all()
    assert {reason.code for reason in estimate.missing.values()} <= {"RankDeficient", "LowExcitation"}


def _late(window: Window, share: float) -> Window:
    """Return the window with its voltage late by ``share`` of a sample."""
    assert window.voltage_v is not None
    row = np.arange(window.n)
    return replace(window, voltage_v=freeze_array(np.interp(row - share, row, window.voltage_v)))


@pytest.mark.parametrize("share", [0.0, 0.03, -0.03])
def test_what_may_be_the_voltages_course_is_a_doubt_and_no_delay(share: float) -> None:
    late = [_late(window, share) for window in windows(0.0002, moves=4)]
    one = maximum_likelihood.estimate(late[:1], SETTINGS)
    all_four = maximum_likelihood.estimate(late, SETTINGS)
    alone = [maximum_likelihood.estimate([window], SETTINGS) for window in late]
    members = [member(*told, k) for k, told in enumerate(zip(late, alone, strict=True))]
    averaged = pooled(members, alone[0], ALIKE, joining=False)
    for estimate in (one, all_four, averaged):
        assert estimate.delay_s is None
        apart = np.abs(estimate.values - TRUTH) / np.sqrt(np.diag(estimate.covariance))
        assert (apart < 3.0).all()
    # more windows do not reduce a doubt that they share
    assert averaged.get_std("L") > 0.8 * one.get_std("L")


def test_a_delay_that_is_told_carries_the_doubt_of_the_course() -> None:
    estimate = maximum_likelihood.estimate([_late(windows(0.0002)[0], 0.2)], SETTINGS)
    assert estimate.delay_s == pytest.approx(0.2e-3, abs=3e-5)
    assert estimate.delay_std_s is not None
    assert 2e-5 < estimate.delay_std_s < 6e-5
    assert abs(estimate.get_value("L") / TRUTH[1] - 1) < 3 * estimate.get_std("L") / TRUTH[1]


def _coloured(window: Window, seed: int) -> Window:
    """Return the noise-free window with white noise on voltage, and noise correlated over 5 samples on the others."""
    rng = np.random.default_rng(seed)
    assert window.voltage_v is not None
    white = rng.standard_normal((3, window.n + 200))
    lasting = lfilter([0.6], [1.0, -0.8], white, axis=1)[:, 200:]
    return replace(
        window,
        voltage_v=freeze_array(window.voltage_v + 0.18 * white[0, 200:]),
        current_a=freeze_array(window.current_a + 0.15 * lasting[1]),
        speed_rad_s=freeze_array(window.speed_rad_s + 0.45 * lasting[2]),
    )


def test_intervals_hold_where_noise_is_coloured() -> None:
    clean = windows(0.0)[0]
    wide, narrow = [], []
    for seed in range(24):
        fit = maximum_likelihood.fit_windows([_coloured(clean, seed)], SETTINGS)
        assert fit is not None
        estimate = maximum_likelihood.finish(fit)
        apart = np.abs(estimate.values - TRUTH)
        wide.append(apart / np.sqrt(np.diag(estimate.covariance)))
        narrow.append(apart / np.sqrt(np.diag(inverse_of(fit.information)[0])))
    assert np.mean(np.array(wide) < 1.96) > 0.88
    assert np.mean(np.array(narrow) < 1.96) < 0.7  # by the information alone


def test_white_noise_leaves_the_information_as_it_is() -> None:
    fit = maximum_likelihood.fit_windows(windows(0.005), SETTINGS)
    assert fit is not None
    inverse = inverse_of(fit.information)[0]
    np.testing.assert_array_equal(maximum_likelihood.robust_inverse(fit, inverse), inverse)
