"""Verdicts on windows with a slow voltage: undetermined values are null and no fault, contradictions are faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.identification.identifiability import list_missing_reasons
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import Reason, Result, WindowOutcome, freeze_array
from fdhil.validation.slow_voltage_checks import check_slow_voltage_readings
from studies.judging import GOOD
from studies.slow_recordings import make_study_recording
from studies.slow_sensor import SETTINGS, record_slow_windows


def _analyse_slow_window(seed: int, kind: str) -> WindowOutcome:
    (window,) = find_windows(make_study_recording(seed, 2, kind).recording)
    return analyse_window(window, SETTINGS)


@pytest.mark.parametrize(("seed", "names"), [(59, {"L"}), (75, {"R"}), (198, {"R", "L"})])
def test_undetermined_parameters_are_null_and_window_is_accepted(seed: int, names: set[str]) -> None:
    outcome = _analyse_slow_window(seed, GOOD)
    assert outcome.verdict.accepted
    assert outcome.verdict.fit_percent is not None
    assert outcome.verdict.fit_percent > 80.0
    assert outcome.estimate is not None
    assert set(outcome.estimate.missing) == names
    assert {reason.code for reason in outcome.estimate.missing.values()} == {"LowExcitation"}
    assert all(np.isnan(outcome.estimate.get_value(name)) for name in names)
    assert all(np.isfinite(outcome.estimate.get_value(name)) for name in ("K", "Jt", "ft", "Cd"))


@pytest.mark.usefixtures("long_computation")
def test_pool_without_l_is_validated() -> None:
    outcome = _analyse_slow_window(59, GOOD)
    for refit in (True, False):
        estimate, verdict = pool_windows([outcome, outcome, outcome], SETTINGS, refit=refit)
        assert verdict.accepted, verdict.reasons
        assert estimate is not None
        assert estimate.get_value("K") == pytest.approx(0.3130582, rel=0.01)


def test_only_r_and_l_may_be_undetermined_with_slow_sensor() -> None:
    outcome = _analyse_slow_window(59, GOOD)
    assert outcome.estimate is not None
    reason = Reason("LowExcitation", "no")
    assert list_missing_reasons(outcome.estimate, slow=False) != []
    assert list_missing_reasons(replace(outcome.estimate, missing={"L": reason, "Jt": reason}), slow=True) == [reason]
    assert list_missing_reasons(replace(outcome.estimate, result=Result.NOT_FINITE), slow=True) != []


@pytest.mark.parametrize("seed", [147, 403])
def test_constant_slow_sensor_with_creeping_voltage_is_stuck(seed: int) -> None:
    # at full speed, where the speed changes too little and a coarse reading hides the noise: the model tells
    recording = make_study_recording(seed, 2, "voltage stuck").recording
    (window,) = find_windows(recording)
    assert list(check_slow_voltage_readings(window)) == []
    texts = [reason.text for reason in analyse_window(window, SETTINGS).verdict.reasons if reason.code == "StuckValue"]
    assert len(texts) == 1
    assert "voltage repeats" in texts[0]


@pytest.mark.parametrize("step", [0.03, 0.3, 1.0])
def test_coarse_slow_sensor_at_steady_voltage_is_accepted(step: float) -> None:
    window = record_slow_windows(0.010)[0]
    assert window.slow_voltage is not None
    coarse = freeze_array(np.round(window.slow_voltage.voltage_v / step) * step)
    read = replace(window, slow_voltage=replace(window.slow_voltage, voltage_v=coarse))
    assert "StuckValue" not in [reason.code for reason in analyse_window(read, SETTINGS).verdict.reasons]


def test_current_offset_is_detected_at_standstill() -> None:
    # 2.5 % of the peak: friction imitates it in [2], and R and K in [1] but at standstill
    codes = {reason.code for reason in _analyse_slow_window(297, "offset").verdict.reasons}
    assert codes == {"CalibrationSuspect"}


@pytest.mark.parametrize("kind", ["voltage turned", "wrong sign"])
def test_inverted_signal_is_refused_as_unphysical(kind: str) -> None:
    for seed in (0, 1):
        outcome = _analyse_slow_window(seed, kind)
        codes = {reason.code for reason in outcome.verdict.reasons}
        assert "Unphysical" in codes
        assert "LowExcitation" not in codes
        assert outcome.estimate is not None
        values = outcome.estimate.build_parameters()
        assert min(values.R, values.K) < 0.0


def test_too_few_samples_of_move_yield_no_estimate() -> None:
    (window,) = record_slow_windows(0.010)
    assert window.slow_voltage is not None
    none = freeze_array(np.full(window.slow_voltage.voltage_v.size, np.nan))
    outcome = analyse_window(replace(window, slow_voltage=replace(window.slow_voltage, voltage_v=none)), SETTINGS)
    assert "LowExcitation" in {reason.code for reason in outcome.verdict.reasons}
