"""A voltage or current that is late by some rows is refused with its delay, also with fine rows."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window
from fdhil.records import VoltageSampling, Window
from fdhil.validation.score_tests import compute_expected_autocorrelation
from fdhil.validation.signal_delays import SignalDelay, estimate_delays
from fdhil.validation.timing_checks import check_signal_delays, search_voltage_delay
from fdhil.validation.window_fit import WindowFit
from fdhil.validation.window_signals import WindowSignals
from studies import drives, faults
from studies.scenes import demand_of, make_recording, measure_run
from tests.validation.test_interruptions import SCENE

FINE_S = 2.5e-4
SETTINGS = Identification()


def _make_window(late: dict[str, int], sampling: VoltageSampling = "interval_mean", dt_s: float = FINE_S) -> Window:
    drive = replace(SCENE.drive, L=SCENE.drive.R * 0.0045)
    scene = replace(SCENE, drive=drive, dt_s=dt_s, noise=0.0045, sampling=sampling, steps=(2e-3, 1e-5, 1e-4))
    rows = measure_run(np.random.default_rng(5), scene, drives.simulate_loop(drive, demand_of(scene), dt_s))
    moved = {name: np.roll(rows.signals[name], k) for name, k in late.items()}  # it begins and ends at rest
    return find_windows(make_recording(scene, rows.replace_signals(**moved)))[0]


@pytest.mark.parametrize("sampling", ["interval_mean", "instant"])
@pytest.mark.parametrize(("name", "rows"), [("voltage", 3), ("voltage", 6), ("current", 2)])
def test_late_signal_is_refused_with_delay(sampling: VoltageSampling, name: str, rows: int) -> None:
    reasons = analyse_window(_make_window({name: rows}, sampling), SETTINGS).verdict.reasons
    reported = [reason.text for reason in reasons if reason.code == "SampleTiming"]
    assert reported, reasons
    late = "late" in reported[0] if name in reported[0].split()[0] else "early" in reported[0]  # of the other signal
    assert late, reported
    shown = float(re.findall(r"is [+-]?([\d.]+) (?:ms|samples)", reported[0])[0])
    ms = shown if " ms " in reported[0] else 1e3 * FINE_S * shown
    # what a regulator does within a sample makes an instant seem early
    assert ms == pytest.approx(1e3 * FINE_S * rows, abs=1e3 * FINE_S * (0.6 if sampling == "interval_mean" else 1.6))


def test_delay_hidden_by_other_parameters_is_found() -> None:
    late = faults.KINDS["voltage late"].make(np.random.default_rng([81, 2, 1557]))  # a shorter winding imitates it
    (window,) = find_windows(late.recording)
    fit = maximum_likelihood.fit_windows([window], SETTINGS)
    assert fit is not None
    assert abs(estimate_delays(fit)[0].samples) < 0.5
    assert not analyse_window(window, SETTINGS).verdict.accepted
    (reason,) = check_signal_delays(WindowFit(WindowSignals(window, SETTINGS), fit=fit))
    assert float(re.findall(r"is ([\d.]+) ms", reason.text)[0]) == pytest.approx(late.severity * 0.25, abs=0.2)


@pytest.mark.parametrize("sampling", ["interval_mean", "instant"])
def test_synchronous_signals_are_accepted(sampling: VoltageSampling) -> None:
    verdict = analyse_window(_make_window({}, sampling), SETTINGS).verdict
    assert verdict.accepted, verdict.reasons


def test_delay_without_likelihood_gain_is_rejected() -> None:
    fit = maximum_likelihood.fit_windows([_make_window({})], SETTINGS)
    assert fit is not None
    voltage, current = estimate_delays(fit)
    assert not voltage.is_significant
    assert not current.is_significant
    found = search_voltage_delay(fit, SignalDelay(1.2, 0.1))  # as if the innovations had shown it
    assert found is None or abs(found) < 1.0


@pytest.mark.parametrize("seed", [7, 714])
def test_instants_share_voltage_noise_between_intervals(seed: int) -> None:
    (window,) = find_windows(faults.make_good_recording(np.random.default_rng([7, 1, seed])).recording)
    fit = maximum_likelihood.fit_windows([window], SETTINGS)
    assert fit is not None
    moving = np.abs(fit.problem.motions[0].mode) == 1
    e = fit.residuals.reshape(-1, 2)[moving, 0]
    seen = float(e[1:] @ e[:-1] / (e @ e))
    assert seen > 0.3
    assert compute_expected_autocorrelation(fit)[0] == pytest.approx(seen, abs=0.15)
    assert analyse_window(window, SETTINGS).verdict.accepted


def test_late_voltage_like_short_winding_is_refused() -> None:
    late = faults.KINDS["voltage late"].make(np.random.default_rng([31, 2, 357]))
    (window,) = find_windows(late.recording)
    (reason,) = analyse_window(window, SETTINGS).verdict.reasons
    assert reason.code == "SampleTiming"
    assert "a winding of 0.54 ms" in reason.text


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_short_winding_is_accepted_if_likelier(seed: int) -> None:
    scene = replace(SCENE, drive=replace(SCENE.drive, L=SCENE.drive.R * 0.0007), dt_s=1e-3, noise=0.002)
    rng = np.random.default_rng(seed)
    rows = measure_run(rng, scene, drives.simulate_loop(scene.drive, demand_of(scene), scene.dt_s))
    verdict = analyse_window(find_windows(make_recording(scene, rows))[0], SETTINGS).verdict
    assert "SampleTiming" not in {reason.code for reason in verdict.reasons}
