"""A voltage sensor slower than the drive: each sample enters the likelihood, and its delay is a parameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window
from fdhil.records import PARAMETERS, Float, Result, VoltageSampling, freeze_array
from studies import bench
from studies.judging import GOOD
from studies.slow_recordings import make_study_recording
from studies.slow_sensor import record_slow_windows
from tests.polled_voltage import build_polled_windows

SETTINGS = Identification()
TRUTH = np.array([bench.Plant().truth()[name] for name in PARAMETERS])
# largest error of one rapid at 0.1 % noise, %
MEANS = (0.2, 0.6, 0.03, 0.08, 3.0, 4.0)


def _compute_errors_percent(values: Float) -> Float:
    errors: Float = 100 * np.abs(values / TRUTH - 1)
    return errors


@pytest.mark.parametrize("period_s", [0.005, 0.010])
def test_low_rate_means_yield_six_parameters_and_the_delay(period_s: float) -> None:
    delay = 0.3 * period_s
    estimate = maximum_likelihood.estimate(record_slow_windows(period_s, delay_s=delay), SETTINGS)
    assert estimate.result is Result.OK
    assert (_compute_errors_percent(estimate.values) < MEANS).all()
    assert estimate.delay_s is not None
    assert estimate.delay_std_s is not None
    assert abs(estimate.delay_s - delay) < 0.01 * period_s
    assert 0 < estimate.delay_std_s < 0.01 * period_s


def test_low_rate_means_are_accepted_with_valid_intervals() -> None:
    outcome = analyse_window(record_slow_windows(0.010, delay_s=0.003, noise=0.005)[0], SETTINGS)
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert outcome.verdict.fit_percent is not None
    assert outcome.estimate is not None
    apart = np.abs(outcome.estimate.values - TRUTH) / np.sqrt(np.diag(outcome.estimate.covariance))
    assert (apart < 3.5).all()


def test_low_rate_instants_yield_a_wide_inductance_interval() -> None:
    sampling: VoltageSampling = "instant"
    estimate = maximum_likelihood.estimate(record_slow_windows(0.010, sampling, delay_s=0.003, noise=0.005), SETTINGS)
    assert not estimate.missing
    assert (_compute_errors_percent(estimate.values)[[0, 2, 3, 4, 5]] < (4.0, 0.4, 0.4, 6.0, 9.0)).all()
    assert estimate.get_std("L") > 0.15 * estimate.get_value("L")
    assert abs(estimate.get_value("L") - TRUTH[1]) < 2 * estimate.get_std("L")


@pytest.mark.parametrize("delay_s", [0.0065, -0.008])
def test_delay_longer_than_a_sample_is_refused_with_its_value(delay_s: float) -> None:
    outcome = analyse_window(record_slow_windows(0.005, delay_s=delay_s, noise=0.005)[0], SETTINGS)
    late = {r.code: r.text for r in outcome.verdict.reasons}["SampleTiming"]
    assert f"{1e3 * abs(delay_s):.0f}" in late or f"{1e3 * abs(delay_s):.1f}"[:3] in late
    assert "more than a sample of 5 ms" in late


def test_lost_voltage_samples_do_not_spoil_the_others() -> None:
    window = record_slow_windows(0.005)[0]
    assert window.slow_voltage is not None
    reported = np.array(window.slow_voltage.voltage_v)
    reported[60:66] = np.nan
    holed = replace(window, slow_voltage=replace(window.slow_voltage, voltage_v=freeze_array(reported)))
    estimate = maximum_likelihood.estimate([holed], SETTINGS)
    assert (_compute_errors_percent(estimate.values) < MEANS).all()


def test_windows_with_separate_voltage_clocks_are_pooled() -> None:
    two = [record_slow_windows(delay_s=delay, noise=0.005, seed=seed)[0] for seed, delay in ((1, 0.001), (2, -0.001))]
    estimate = maximum_likelihood.estimate(two, SETTINGS)
    assert (_compute_errors_percent(estimate.values)[:4] < (0.3, 1.2, 0.1, 0.2)).all()
    # one residual of [5] for each voltage sample, one of [6] for each drive sample, all of unit variance
    assert estimate.residuals["electrical"].size == sum(w.slow_voltage.voltage_v.size for w in two if w.slow_voltage)
    assert estimate.residuals["mechanical"].size == sum(w.n for w in two)
    assert all(0.8 < np.std(e[e != 0.0]) < 1.2 for e in estimate.residuals.values())


@pytest.mark.parametrize("seed", [61, 274])
def test_delay_mistaken_for_negative_inductance_is_found(seed: int) -> None:
    # a sensor of 100 Hz, 4 ms early or late: the fit once started at L = 0 and stayed there, 6 ms off the delay
    recording = make_study_recording(seed, 3, GOOD).recording
    estimate = maximum_likelihood.estimate(find_windows(recording), SETTINGS)
    assert estimate.result is Result.OK
    assert estimate.delay_s is not None
    assert estimate.get_value("L") / estimate.get_value("R") == pytest.approx(3.5e-3, rel=0.1)
    assert abs(estimate.delay_s) == pytest.approx(3.8e-3, rel=0.05)


def test_jittered_meter_samples_are_as_informative_as_regular_ones() -> None:
    """Each value counts at its own time; assigning all to the regular instants would bias the inductance."""
    on, off = (maximum_likelihood.estimate(build_polled_windows(timely=timely), SETTINGS) for timely in (True, False))
    for estimate in (on, off):
        assert not estimate.missing
        assert (_compute_errors_percent(estimate.values)[[0, 2, 3]] < (6.0, 0.6, 0.6)).all()
    assert off.get_std("R") == pytest.approx(on.get_std("R"), rel=0.5)
    window = build_polled_windows()[0]
    assert window.slow_voltage is not None
    assert analyse_window(window, SETTINGS).verdict.accepted
    blind = replace(window, slow_voltage=replace(window.slow_voltage, late_s=None))
    known, unknown = (maximum_likelihood.estimate([one], SETTINGS) for one in (window, blind))
    assert abs(unknown.get_value("L") / TRUTH[1] - 1) > 1.5 * abs(known.get_value("L") / TRUTH[1] - 1)
    assert unknown.get_std("L") / unknown.get_value("L") > 1.2 * known.get_std("L") / known.get_value("L")
