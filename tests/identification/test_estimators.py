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
from fdhil.identification.between_window_variance import NO_BETWEEN_VARIANCE
from fdhil.identification.estimators import Estimator, least_squares, maximum_likelihood, select_estimator
from fdhil.identification.normal_equations import invert_symmetric
from fdhil.identification.rapid_windows import find_windows
from fdhil.identification.window_pool import build_pool_member, pool_estimates
from fdhil.records import PARAMETERS, Estimate, Float, Result, Window, freeze_array
from fdhil.store.recording_csv import parse_recording
from studies import bench, instrumental_variables
from tests.identification.bench_recordings import find_noisy_windows, simulate_bench_shuttle

SETTINGS = Identification()
TRUTH = np.array([bench.Plant().truth()[name] for name in PARAMETERS])
# largest error of one rapid at 0.1 % noise, %, in the order of PARAMETERS: any estimator, and the most accurate one
REACH = (0.3, 0.6, 0.1, 0.5, 8.0, 12.0)
CLOSER: dict[str, tuple[float, ...]] = {"maximum_likelihood": (0.1, 0.2, 0.05, 0.1, 1.5, 2.0)}


@pytest.fixture(params=[*tables.ESTIMATORS, instrumental_variables.NAME])
def estimator_name(request: pytest.FixtureRequest) -> str:
    """The name of a listed estimator, or of the one that only studies use."""
    return str(request.param)


def _load_estimator(name: str) -> Estimator:
    if name == instrumental_variables.NAME:
        return instrumental_variables.estimate
    return select_estimator(SETTINGS.model_copy(update={"method": name}))[1]


def _compute_errors_percent(estimate: Estimate) -> Float:
    errors: Float = 100 * np.abs(estimate.values / TRUTH - 1)
    return errors


def _compute_chance_variances(estimate: Estimate) -> Float:
    """Return the variances (6,) without the model doubts, which more windows do not reduce."""
    shared = estimate.systematic
    doubts = np.zeros(6) if shared is None else np.square(shared[:6]).sum(axis=1)
    variances: Float = np.diag(estimate.covariance)[:6] - doubts
    return variances


def test_default_estimator_is_used_without_a_method() -> None:
    assert select_estimator(SETTINGS)[0] == tables.DEFAULT_ESTIMATOR == "maximum_likelihood"


def test_single_rapid_yields_accurate_parameters(estimator_name: str) -> None:
    estimate = _load_estimator(estimator_name)(find_noisy_windows(0.001), SETTINGS)
    assert estimate.result is Result.OK
    assert estimate.method == estimator_name
    assert (_compute_errors_percent(estimate) < CLOSER.get(estimator_name, REACH)).all()


def test_joint_windows_are_more_accurate_than_one(estimator_name: str) -> None:
    estimate = _load_estimator(estimator_name)(find_noisy_windows(0.005, moves=4), SETTINGS)
    assert (_compute_errors_percent(estimate) < (1.0, 1.0, 1.0, 1.0, 5.0, 5.0)).all()
    one = _load_estimator(estimator_name)(find_noisy_windows(0.005, moves=4)[:1], SETTINGS)
    assert (_compute_chance_variances(estimate)[:4] < _compute_chance_variances(one)[:4]).all()


def test_standard_deviations_match_the_errors(estimator_name: str) -> None:
    scores = []
    for seed in range(8):
        estimate = _load_estimator(estimator_name)(find_noisy_windows(0.005, seed), SETTINGS)
        scores.append((estimate.values - TRUTH) / np.sqrt(_compute_chance_variances(estimate)))
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert (rms > 0.3).all()
    assert (rms < 2.0).all()


def test_both_directions_give_the_same_estimate(estimator_name: str) -> None:
    window = find_noisy_windows(0.002)[0]
    assert window.voltage_v is not None
    mirrored = replace(
        window,
        voltage_v=freeze_array(-window.voltage_v),
        current_a=freeze_array(-window.current_a),
        speed_rad_s=freeze_array(-window.speed_rad_s),
        direction=-1,
    )
    there, back = (_load_estimator(estimator_name)([w], SETTINGS) for w in (window, mirrored))
    np.testing.assert_allclose(back.values, there.values, rtol=1e-6)


def test_window_order_does_not_change_the_estimate(estimator_name: str) -> None:
    three = find_noisy_windows(0.005, moves=3)
    there, back = (_load_estimator(estimator_name)(order, SETTINGS) for order in (three, three[::-1]))
    np.testing.assert_allclose(back.values, there.values, rtol=1e-5)


def test_scaled_units_scale_the_parameters(estimator_name: str) -> None:
    window = find_noisy_windows(0.002)[0]
    assert window.voltage_v is not None
    in_kilovolt = replace(window, voltage_v=freeze_array(window.voltage_v * 1e-3))
    plain, scaled = (_load_estimator(estimator_name)([w], SETTINGS) for w in (window, in_kilovolt))
    # torque = K i is in kilo-units too, so every parameter shrinks by the same factor
    np.testing.assert_allclose(scaled.values, plain.values * 1e-3, rtol=1e-4)


def test_lost_samples_are_excluded(estimator_name: str) -> None:
    window = find_noisy_windows(0.001)[0]
    assert window.voltage_v is not None
    lost = {}
    for field in ("voltage_v", "current_a", "speed_rad_s"):
        values = np.array(getattr(window, field))
        values[400:403] = np.nan
        lost[field] = freeze_array(values)
    holed = Window(**{f: getattr(window, f) for f in window.__slots__} | lost | {"gaps": ((400, 403),)})
    assert (
        _compute_errors_percent(_load_estimator(estimator_name)([holed], SETTINGS)) < CLOSER.get(estimator_name, REACH)
    ).all()


def test_switching_voltage_instants_have_valid_intervals(estimator_name: str) -> None:
    clean = simulate_bench_shuttle()
    sampled = replace(clean, voltage=clean.voltage_instant)
    found = find_windows(parse_recording(bench.format_as_csv(sampled, 0.003, 1, voltage_sampling="instant")))
    estimate = _load_estimator(estimator_name)(found, SETTINGS)
    apart = np.abs(estimate.values - TRUTH) / np.sqrt(np.diag(estimate.covariance))
    assert (apart < 3.0).all()


def test_windows_without_motion_are_refused_with_a_reason(estimator_name: str) -> None:
    window = find_noisy_windows(0.001)[0]
    still = replace(window, speed_rad_s=freeze_array(np.zeros(window.n)))
    estimate = _load_estimator(estimator_name)([still], SETTINGS)
    assert estimate.result is not Result.OK
    assert set(estimate.missing) == set(PARAMETERS)
    assert np.isnan(estimate.values).all()


def test_window_without_voltage_is_excluded(estimator_name: str) -> None:
    window = find_noisy_windows(0.001)[0]
    without = replace(window, voltage_v=None)
    alone, adjacent = (_load_estimator(estimator_name)(given, SETTINGS) for given in ([without], [window, without]))
    assert alone.result is not Result.OK
    assert np.isnan(alone.values).all()
    assert (_compute_errors_percent(adjacent) < CLOSER.get(estimator_name, REACH)).all()


def test_instrumental_variables_remove_the_noise_bias() -> None:
    unfiltered = SETTINGS.model_copy(update={"lowpass_hz": 1e6})
    plain, paired = [], []
    for seed in range(12):
        found = find_noisy_windows(0.005, seed)
        signals = [least_squares.align_signals(w, unfiltered) for w in found]
        plain.append(least_squares.estimate_raw_values(signals, [w.dt_s for w in found]))
        paired.append(instrumental_variables.raw_values(found, unfiltered))
    biased, clean = (np.mean(np.array(values), axis=0) / TRUTH - 1 for values in (plain, paired))
    inertia = PARAMETERS.index("Jt")
    assert biased[inertia] < -0.5
    assert abs(clean[inertia]) < 0.01
    assert np.abs(clean[[0, 2]]).max() < 0.002


def test_instrumental_variables_require_a_moving_demand() -> None:
    window = find_noisy_windows(0.002)[0]
    still = replace(window, demand_mm=freeze_array(np.zeros(window.n)))
    estimate = _load_estimator("instrumental_variables")([still], SETTINGS)
    assert estimate.result is not Result.OK
    assert np.isnan(estimate.values).all()
    assert {reason.code for reason in estimate.missing.values()} <= {"RankDeficient", "LowExcitation"}


def _delay_voltage(window: Window, share: float) -> Window:
    """Return the window with its voltage late by ``share`` of a sample."""
    assert window.voltage_v is not None
    row = np.arange(window.n)
    return replace(window, voltage_v=freeze_array(np.interp(row - share, row, window.voltage_v)))


@pytest.mark.parametrize("share", [0.0, 0.03, -0.03])
def test_small_delay_counts_as_waveform_doubt(share: float) -> None:
    late = [_delay_voltage(window, share) for window in find_noisy_windows(0.0002, moves=4)]
    one = maximum_likelihood.estimate(late[:1], SETTINGS)
    all_four = maximum_likelihood.estimate(late, SETTINGS)
    alone = [maximum_likelihood.estimate([window], SETTINGS) for window in late]
    members = [build_pool_member(*told, k) for k, told in enumerate(zip(late, alone, strict=True))]
    averaged = pool_estimates(members, alone[0], NO_BETWEEN_VARIANCE, joining=False)
    for estimate in (one, all_four, averaged):
        assert estimate.delay_s is None
        apart = np.abs(estimate.values - TRUTH) / np.sqrt(np.diag(estimate.covariance))
        assert (apart < 3.0).all()
    # more windows do not reduce a doubt that they share
    assert averaged.get_std("L") > 0.8 * one.get_std("L")


def test_reported_delay_includes_the_waveform_doubt() -> None:
    estimate = maximum_likelihood.estimate([_delay_voltage(find_noisy_windows(0.0002)[0], 0.2)], SETTINGS)
    assert estimate.delay_s == pytest.approx(0.2e-3, abs=3e-5)
    assert estimate.delay_std_s is not None
    assert 2e-5 < estimate.delay_std_s < 6e-5
    assert abs(estimate.get_value("L") / TRUTH[1] - 1) < 3 * estimate.get_std("L") / TRUTH[1]


def _add_coloured_noise(window: Window, seed: int) -> Window:
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


def test_intervals_cover_the_truth_with_coloured_noise() -> None:
    clean = find_noisy_windows(0.0)[0]
    wide, narrow = [], []
    for seed in range(24):
        fit = maximum_likelihood.fit_windows([_add_coloured_noise(clean, seed)], SETTINGS)
        assert fit is not None
        estimate = maximum_likelihood.build_estimate(fit)
        apart = np.abs(estimate.values - TRUTH)
        wide.append(apart / np.sqrt(np.diag(estimate.covariance)))
        narrow.append(apart / np.sqrt(np.diag(invert_symmetric(fit.information)[0])))
    assert np.mean(np.array(wide) < 1.96) > 0.88
    assert np.mean(np.array(narrow) < 1.96) < 0.7  # by the information alone


def test_white_noise_does_not_inflate_the_covariance() -> None:
    fit = maximum_likelihood.fit_windows(find_noisy_windows(0.005), SETTINGS)
    assert fit is not None
    inverse = invert_symmetric(fit.information)[0]
    np.testing.assert_array_equal(maximum_likelihood.compute_robust_inverse(fit, inverse), inverse)
