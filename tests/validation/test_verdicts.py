"""Verdicts: valid windows are accepted, each kind of fault is refused under its own code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fdhil import tables
from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse, pool
from fdhil.records import Float, Window, WindowOutcome, freeze_array
from fdhil.store.recording_csv import parse_recording
from fdhil.validation.plausibility import warnings_of
from studies import bench
from tests.identification.bench_recordings import find_noisy_windows

SETTINGS = Identification()


def _codes(outcome: WindowOutcome) -> set[str]:
    return {reason.code for reason in outcome.verdict.reasons}


def _changed(window: Window, **signals: Callable[[Float], Float]) -> Window:
    assert window.voltage_v is not None
    arrays = {name: freeze_array(change(np.array(getattr(window, name)))) for name, change in signals.items()}
    return replace(window, **arrays)  # type: ignore[arg-type]  # the names are arrays of the record


@pytest.mark.parametrize("method", [None, *tables.ESTIMATORS])
@pytest.mark.parametrize("noise", [0.001, 0.005])
def test_good_windows_are_accepted(method: str | None, noise: float) -> None:
    settings = SETTINGS.model_copy(update={"method": method})
    outcomes = [analyse(window, settings) for window in find_noisy_windows(noise, moves=2)]
    for outcome in outcomes:
        assert outcome.verdict.accepted, outcome.verdict.reasons
        assert outcome.verdict.fit_percent is not None
        assert outcome.verdict.fit_percent > 98.0
    estimate, verdict = pool(outcomes, settings)
    assert verdict.accepted
    assert estimate is not None


def _stuck(values: Float) -> Float:
    values[500:560] = values[500]
    return values


def _clipped(values: Float) -> Float:
    return np.clip(values, -60.0, 60.0)


def _late(values: Float) -> Float:
    return np.concatenate([np.full(8, values[0]), values[:-8]])


def _gain_step(values: Float) -> Float:
    values[550:] *= 1.15
    return values


@pytest.mark.parametrize(
    ("field", "change", "code"),
    [
        ("speed_rad_s", _stuck, "StuckValue"),
        ("current_a", _stuck, "StuckValue"),
        ("current_a", _clipped, "Saturated"),
        ("voltage_v", _late, "SampleTiming"),
        ("current_a", _gain_step, "CalibrationSuspect"),
    ],
)
@pytest.mark.fault("B11", "B12", "C1", "C8")
def test_sensor_faults_are_named(field: str, change: Callable[[Float], Float], code: str) -> None:
    outcome = analyse(_changed(find_noisy_windows(0.003)[0], **{field: change}), SETTINGS)
    assert not outcome.verdict.accepted
    assert code in _codes(outcome)


@pytest.mark.fault("C6")
def test_a_load_torque_is_named_with_its_amount() -> None:
    demand = bench.shuttle()
    load = np.zeros(demand.size)
    load[400:600] = 8.0
    signals = bench.run(bench.Plant(), demand, load=load)
    outcome = analyse(find_windows(parse_recording(bench.as_csv(signals, 0.003)))[0], SETTINGS)
    (reason,) = outcome.verdict.reasons
    assert reason.code == "LoadDetected"
    assert "+7." in reason.text or "+8." in reason.text


def test_stribeck_friction_is_a_term_or_named() -> None:
    signals = bench.run(bench.Plant(stribeck=12.0), bench.shuttle())
    outcome = analyse(find_windows(parse_recording(bench.as_csv(signals, 0.003)))[0], SETTINGS)
    assert outcome.estimate is not None
    told = [*outcome.verdict.reasons, *outcome.verdict.warnings]
    assert "stribeck" in outcome.estimate.terms or any("Stribeck" in reason.text for reason in told)


def test_frames_lost_without_a_trace_in_the_time_column() -> None:
    whole = bench.run(bench.Plant(), bench.shuttle())
    keep = np.r_[0:300, 360 : whole.speed.size]
    names = ("voltage", "voltage_instant", "current", "speed", "position", "demand")
    holed = replace(whole, **{name: getattr(whole, name)[keep] for name in names})
    outcome = analyse(find_windows(parse_recording(bench.as_csv(holed, 0.003)))[0], SETTINGS)
    assert "Implausible" in _codes(outcome)


def test_a_counted_gap_is_refused_when_long_and_left_out_when_short() -> None:
    text = bench.as_csv(bench.run(bench.Plant(), bench.shuttle()), 0.003).splitlines(keepends=True)
    head = next(k for k, line in enumerate(text) if line.startswith("time_s")) + 1
    for rows, accepted in ((2, True), (30, False)):
        cut = "".join(text[: head + 500] + text[head + 500 + rows :])
        outcome = analyse(find_windows(parse_recording(cut))[0], SETTINGS)
        assert outcome.verdict.accepted is accepted
        assert accepted or "StaleData" in _codes(outcome)


@pytest.mark.fault("C5")
def test_a_short_rapid_lacks_its_cruise() -> None:
    signals = bench.run(bench.Plant(), bench.shuttle(distance=0.05))
    outcome = analyse(find_windows(parse_recording(bench.as_csv(signals, 0.003)))[0], SETTINGS)
    assert not outcome.verdict.accepted
    assert "MissingStage(cruise)" in _codes(outcome)
    assert outcome.estimate is not None


@pytest.mark.fault("D3")
def test_swapped_columns_are_unphysical() -> None:
    window = find_noisy_windows(0.003)[0]
    assert window.voltage_v is not None
    swapped = replace(window, voltage_v=freeze_array(-window.voltage_v))
    assert "Unphysical" in _codes(analyse(swapped, SETTINGS))


@pytest.mark.fault("C2")
def test_not_finite_values_never_enter_a_fit() -> None:
    outcome = analyse(_changed(find_noisy_windows()[0], current_a=lambda v: np.where(v > 50, np.inf, v)), SETTINGS)
    assert _codes(outcome) == {"NotFinite"}
    assert outcome.estimate is not None
    assert np.isnan(outcome.estimate.values).all()


def test_a_window_without_voltage_is_told() -> None:
    outcome = analyse(replace(find_noisy_windows()[0], voltage_v=None), SETTINGS)
    assert not outcome.verdict.accepted
    told = outcome.estimate
    assert told is not None
    for name, truth in (("Jt/K", 0.075 / 0.8), ("ft/K", 0.05 / 0.8), ("Cd/K", 5.0 / 0.8)):
        assert abs(told.get_value(name) - truth) < 5 * told.get_std(name) < 0.4 * truth
        assert np.isnan(told.get_value(name.split("/")[0]))


def test_a_sensor_with_its_own_clock_is_aligned_by_the_data() -> None:
    shifted = []
    for window, share in zip(find_noisy_windows(0.001, moves=2), (0.3, -0.4), strict=True):
        assert window.voltage_v is not None
        rise = np.gradient(window.voltage_v)
        late_v = freeze_array(window.voltage_v - share * rise)
        shifted.append(replace(window, voltage_v=late_v, voltage_delay_s=0.0))
    outcomes = [analyse(window, SETTINGS) for window in shifted]
    for outcome, share in zip(outcomes, (0.3, -0.4), strict=True):
        assert outcome.estimate is not None
        assert outcome.estimate.delay_s == pytest.approx(share * 1e-3, abs=5e-5)
        assert abs(outcome.estimate.get_value("L") / 0.005 - 1) < 0.01
    estimate, verdict = pool(outcomes, SETTINGS)
    assert verdict.accepted, verdict.reasons
    assert estimate is not None
    assert abs(estimate.get_value("L") / 0.005 - 1) < 0.01


@pytest.mark.fault("C3")
def test_coarse_steps_are_told_and_widen_the_intervals() -> None:
    window = find_noisy_windows(0.001)[0]
    coarse = _changed(window, current_a=lambda values: np.round(values / 8.0) * 8.0)
    (warning,) = warnings_of(coarse)
    assert warning.code == "Quantised"
    assert "8 A" in warning.text
    assert warnings_of(window) == []
    fine_told, coarse_told = analyse(window, SETTINGS).estimate, analyse(coarse, SETTINGS).estimate
    assert fine_told is not None
    assert coarse_told is not None
    assert coarse_told.get_std("R") > 2 * fine_told.get_std("R")


def test_nothing_pooled_from_nothing() -> None:
    estimate, verdict = pool([], SETTINGS)
    assert estimate is None
    assert [reason.code for reason in verdict.reasons] == ["NoWindow"]
    refused = analyse(_changed(find_noisy_windows()[0], voltage_v=_late), SETTINGS)
    estimate, verdict = pool([refused], SETTINGS)
    assert estimate is None
    assert not verdict.accepted
    assert verdict.reasons


def test_a_load_that_changed_between_the_windows_is_seen() -> None:
    light = find_noisy_windows(0.003)[0]
    heavy = find_noisy_windows(0.003, plant=bench.Plant(Jt=0.085))[0]
    _, verdict = pool([analyse(light, SETTINGS), analyse(heavy, SETTINGS)], SETTINGS)
    assert not verdict.accepted
    assert [reason.code for reason in verdict.reasons] == ["LoadChanged"]


@pytest.mark.fault("D6")
@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("singular"), FloatingPointError("overflow"), ValueError("infs or NaNs")]
)
def test_a_solver_that_raises_costs_the_window_alone(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    good, bad = find_noisy_windows(0.003, moves=2)[:2]

    def fail(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr("fdhil.pipeline.analysis.maximum_likelihood.fit_windows", fail)
        outcome = analyse(bad, SETTINGS)
    assert not outcome.verdict.accepted
    assert "SolverFailed" in _codes(outcome)
    assert outcome.estimate is not None
    assert np.isnan(outcome.estimate.values).all()
    assert analyse(good, SETTINGS).verdict.accepted


@pytest.mark.fault("C4")
def test_a_rapid_whose_beginning_was_missed_lacks_its_acceleration() -> None:
    signals = bench.run(bench.Plant(), bench.shuttle())
    rows = bench.as_csv(signals, 0.003).splitlines(keepends=True)
    head = next(k for k, line in enumerate(rows) if line.startswith("time_s")) + 1
    speed = np.abs(np.asarray(signals.speed))
    late = int(np.argmax(speed > 0.95 * speed.max()))
    windows_found = find_windows(parse_recording("".join(rows[:head] + rows[head + late :])))
    outcome = analyse(windows_found[0], SETTINGS)
    assert not outcome.verdict.accepted
    assert "MissingStage(accel)" in _codes(outcome)
