"""Score tests on a window with a slow voltage: noise alone must not indicate a sensor's gain."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.estimators.maximum_likelihood import fit_windows
from fdhil.identification.low_rate_voltage.likelihood_ascent import (
    LowRateLikelihood,
    find_likelier_delay,
    maximise_likelihood,
)
from fdhil.identification.rapid_windows import find_windows
from fdhil.validation.structure_tests import run_structure_tests
from studies.judging import GOOD, assess_recording
from studies.slow_recordings import TO_AND_FRO, make_study_recording
from studies.slow_sensor import SETTINGS


def test_noise_is_no_evidence_of_imitated_gain() -> None:
    # a long cruise at little current: the gain's drift was "found" at 11 standard deviations in the noise it scales
    recording = make_study_recording(105, 2, GOOD).recording
    fit = fit_windows(find_windows(recording), SETTINGS)
    assert fit is not None
    gains = [f for f in run_structure_tests(fit) if "gain" in f.text]
    assert len(gains) == 3
    assert max(abs(f.statistic) for f in gains) < 5.5


def test_delay_just_behind_row_is_fitted() -> None:
    # instants at every second row, the delay's derivative taken across the row: a variance was negative
    recording = make_study_recording(191, 2, GOOD).recording
    with np.errstate(all="raise", under="ignore"):
        fit = fit_windows(find_windows(recording), SETTINGS)
    assert fit is not None
    assert fit.converged


def test_sample_near_row_adds_no_delay_precision() -> None:
    # instants at every other row: one that a derivative put before its row "told" the delay to 0.2 us, the friction not
    for window in find_windows(make_study_recording(121, 2002, TO_AND_FRO).recording):
        fit = fit_windows([window], SETTINGS)
        assert fit is not None
        column = fit.jacobian[:, 6]
        assert np.abs(column).max() ** 2 < 0.5 * (column @ column)
        assert set(maximum_likelihood.build_estimate(fit).missing) <= {"R", "L"}


@pytest.mark.usefixtures("long_computation")
def test_gain_step_or_drift_is_named() -> None:
    for seed, kind in ((0, "voltage gain steps"), (1, "voltage gain drifts"), (7, "gain step"), (8, "gain drift")):
        judged = assess_recording(kind, seed, make_study_recording(seed, 2, kind))
        assert "CalibrationSuspect" in {*judged.codes, *judged.warned}, kind


def test_fit_with_short_steps_converges() -> None:
    # rows at 4 kHz, samples at 500 Hz: the delay seemed known to some us, and was 600 us away
    (window,) = find_windows(make_study_recording(182, 1001, GOOD).recording)
    fit = fit_windows([window], SETTINGS)
    assert fit is not None
    assert fit.converged


def test_likeliest_delay_maximum_is_found() -> None:
    # 1.72 samples early, and a fit that stopped at a lower top of the likelihood, 0.8 samples early
    (window,) = find_windows(make_study_recording(1109, 7, "voltage late").recording)
    fit = fit_windows([window], SETTINGS)
    assert fit is not None
    assert fit.theta[6] == pytest.approx(-1.7155e-3 * 2.0, abs=2e-4)
    likelihood = LowRateLikelihood(fit.problem.motions, fit.problem.noises)
    sizes = maximum_likelihood.estimate_typical_sizes(fit.theta, likelihood.motions)
    for late_s in (-2.45e-3, -1.61e-3):
        theta, *_ = maximise_likelihood(likelihood, np.append(fit.theta[:6], late_s), range(6), sizes)
        better = find_likelier_delay(likelihood, theta, fit.information, 2e-3)
        assert better is not None
        assert better[6] == pytest.approx(fit.theta[6], abs=3e-4)
    assert find_likelier_delay(likelihood, fit.theta, fit.information, 2e-3) is None
