"""Verdicts: valid windows are accepted, each kind of fault is refused under its own code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fdhil import tables
from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import Float, Window, WindowOutcome, freeze_array
from fdhil.store.recording_csv import parse_recording
from fdhil.validation.signal_plausibility import collect_signal_warnings
from studies import bench
from tests.identification.bench_recordings import find_noisy_windows

SETTINGS = Identification()


def _list_codes(outcome: WindowOutcome) -> set[str]:
    return {reason.code for reason in outcome.verdict.reasons}


def _change_signals(window: Window, **signals: Callable[[Float], Float]) -> Window:
    assert window.voltage_v is not None
    arrays = {name: freeze_array(change(np.array(getattr(window, name)))) for name, change in signals.items()}
    return replace(window, **arrays)  # type: ignore[arg-type]  # the names are arrays of the record


@pytest.mark.parametrize("method", [None, *tables.ESTIMATORS])
@pytest.mark.parametrize("noise", [0.001, 0.005])
def test_valid_window_is_accepted(method: str | None, noise: float) -> None:
    settings = SETTINGS.model_copy(update={"method": method})
    outcomes = [analyse_window(window, settings) for window in find_noisy_windows(noise, moves=2)]
    for outcome in outcomes:
        assert outcome.verdict.accepted, outcome.verdict.reasons
        assert outcome.verdict.fit_percent is not None
        assert outcome.verdict.fit_percent > 98.0
    estimate, verdict = pool_windows(outcomes, settings)
    assert verdict.accepted
    assert estimate is not None


def _hold_reading(values: Float) -> Float:
    values[500:560] = values[500]
    return values


def _clip_signal(values: Float) -> Float:
    return np.clip(values, -60.0, 60.0)


def _delay_signal(values: Float) -> Float:
    return np.concatenate([np.full(8, values[0]), values[:-8]])


def _add_gain_step(values: Float) -> Float:
    values[550:] *= 1.15
    return values


@pytest.mark.parametrize(
    ("field", "change", "code"),
    [
        ("speed_rad_s", _hold_reading, "StuckValue"),
        ("current_a", _hold_reading, "StuckValue"),
        ("current_a", _clip_signal, "Saturated"),
        ("voltage_v", _delay_signal, "SampleTiming"),
        ("current_a", _add_gain_step, "CalibrationSuspect"),
    ],
)
@pytest.mark.fault("B11", "B12", "C1", "C8")
def test_sensor_fault_is_named(field: str, change: Callable[[Float], Float], code: str) -> None:
    outcome = analyse_window(_change_signals(find_noisy_windows(0.003)[0], **{field: change}), SETTINGS)
    assert not outcome.verdict.accepted
    assert code in _list_codes(outcome)


@pytest.mark.fault("C6")
def test_load_torque_is_named_with_amount() -> None:
    demand = bench.make_shuttle_demand()
    load = np.zeros(demand.size)
    load[400:600] = 8.0
    signals = bench.simulate_bench(bench.Plant(), demand, load=load)
    outcome = analyse_window(find_windows(parse_recording(bench.format_as_csv(signals, 0.003)))[0], SETTINGS)
    (reason,) = outcome.verdict.reasons
    assert reason.code == "LoadDetected"
    assert "+7." in reason.text or "+8." in reason.text


def test_stribeck_friction_is_term_or_reported() -> None:
    signals = bench.simulate_bench(bench.Plant(stribeck=12.0), bench.make_shuttle_demand())
    outcome = analyse_window(find_windows(parse_recording(bench.format_as_csv(signals, 0.003)))[0], SETTINGS)
    assert outcome.estimate is not None
    reported = [*outcome.verdict.reasons, *outcome.verdict.warnings]
    assert "stribeck" in outcome.estimate.terms or any("Stribeck" in reason.text for reason in reported)


def test_untraced_lost_frames_are_refused() -> None:
    whole = bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand())
    keep = np.r_[0:300, 360 : whole.speed.size]
    names = ("voltage", "voltage_instant", "current", "speed", "position", "demand")
    holed = replace(whole, **{name: getattr(whole, name)[keep] for name in names})
    outcome = analyse_window(find_windows(parse_recording(bench.format_as_csv(holed, 0.003)))[0], SETTINGS)
    assert "Implausible" in _list_codes(outcome)


def test_gap_is_refused_if_long_and_skipped_if_short() -> None:
    text = bench.format_as_csv(bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand()), 0.003).splitlines(
        keepends=True
    )
    head = next(k for k, line in enumerate(text) if line.startswith("time_s")) + 1
    for rows, accepted in ((2, True), (30, False)):
        cut = "".join(text[: head + 500] + text[head + 500 + rows :])
        outcome = analyse_window(find_windows(parse_recording(cut))[0], SETTINGS)
        assert outcome.verdict.accepted is accepted
        assert accepted or "StaleData" in _list_codes(outcome)


@pytest.mark.fault("C5")
def test_short_rapid_is_refused_for_missing_cruise() -> None:
    signals = bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand(distance=0.05))
    outcome = analyse_window(find_windows(parse_recording(bench.format_as_csv(signals, 0.003)))[0], SETTINGS)
    assert not outcome.verdict.accepted
    assert "MissingStage(cruise)" in _list_codes(outcome)
    assert outcome.estimate is not None


@pytest.mark.fault("D3")
def test_swapped_columns_are_refused_as_unphysical() -> None:
    window = find_noisy_windows(0.003)[0]
    assert window.voltage_v is not None
    swapped = replace(window, voltage_v=freeze_array(-window.voltage_v))
    assert "Unphysical" in _list_codes(analyse_window(swapped, SETTINGS))


@pytest.mark.fault("C2")
def test_non_finite_values_are_refused_before_fit() -> None:
    outcome = analyse_window(
        _change_signals(find_noisy_windows()[0], current_a=lambda v: np.where(v > 50, np.inf, v)), SETTINGS
    )
    assert _list_codes(outcome) == {"NotFinite"}
    assert outcome.estimate is not None
    assert np.isnan(outcome.estimate.values).all()


def test_window_without_voltage_is_refused() -> None:
    outcome = analyse_window(replace(find_noisy_windows()[0], voltage_v=None), SETTINGS)
    assert not outcome.verdict.accepted
    reported = outcome.estimate
    assert reported is not None
    for name, truth in (("Jt/K", 0.075 / 0.8), ("ft/K", 0.05 / 0.8), ("Cd/K", 5.0 / 0.8)):
        assert abs(reported.get_value(name) - truth) < 5 * reported.get_std(name) < 0.4 * truth
        assert np.isnan(reported.get_value(name.split("/")[0]))


def test_sensor_with_own_clock_is_aligned_by_data() -> None:
    shifted = []
    for window, share in zip(find_noisy_windows(0.001, moves=2), (0.3, -0.4), strict=True):
        assert window.voltage_v is not None
        rise = np.gradient(window.voltage_v)
        late_v = freeze_array(window.voltage_v - share * rise)
        shifted.append(replace(window, voltage_v=late_v, voltage_delay_s=0.0))
    outcomes = [analyse_window(window, SETTINGS) for window in shifted]
    for outcome, share in zip(outcomes, (0.3, -0.4), strict=True):
        assert outcome.estimate is not None
        assert outcome.estimate.delay_s == pytest.approx(share * 1e-3, abs=5e-5)
        assert abs(outcome.estimate.get_value("L") / 0.005 - 1) < 0.01
    estimate, verdict = pool_windows(outcomes, SETTINGS)
    assert verdict.accepted, verdict.reasons
    assert estimate is not None
    assert abs(estimate.get_value("L") / 0.005 - 1) < 0.01


@pytest.mark.fault("C3")
def test_coarse_quantisation_warns_and_widens_intervals() -> None:
    window = find_noisy_windows(0.001)[0]
    coarse = _change_signals(window, current_a=lambda values: np.round(values / 8.0) * 8.0)
    (warning,) = collect_signal_warnings(coarse)
    assert warning.code == "Quantised"
    assert "8 A" in warning.text
    assert collect_signal_warnings(window) == []
    fine_told, coarse_told = analyse_window(window, SETTINGS).estimate, analyse_window(coarse, SETTINGS).estimate
    assert fine_told is not None
    assert coarse_told is not None
    assert coarse_told.get_std("R") > 2 * fine_told.get_std("R")


def test_empty_pool_is_refused() -> None:
    estimate, verdict = pool_windows([], SETTINGS)
    assert estimate is None
    assert [reason.code for reason in verdict.reasons] == ["NoWindow"]
    refused = analyse_window(_change_signals(find_noisy_windows()[0], voltage_v=_delay_signal), SETTINGS)
    estimate, verdict = pool_windows([refused], SETTINGS)
    assert estimate is None
    assert not verdict.accepted
    assert verdict.reasons


def test_load_change_between_windows_is_reported() -> None:
    light = find_noisy_windows(0.003)[0]
    heavy = find_noisy_windows(0.003, plant=bench.Plant(Jt=0.085))[0]
    _, verdict = pool_windows([analyse_window(light, SETTINGS), analyse_window(heavy, SETTINGS)], SETTINGS)
    assert not verdict.accepted
    assert [reason.code for reason in verdict.reasons] == ["LoadChanged"]


@pytest.mark.fault("D6")
@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("singular"), FloatingPointError("overflow"), ValueError("infs or NaNs")]
)
def test_solver_error_refuses_only_its_window(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    good, bad = find_noisy_windows(0.003, moves=2)[:2]

    def raise_error(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr("fdhil.pipeline.window_analysis.fit_windows", raise_error)
        outcome = analyse_window(bad, SETTINGS)
    assert not outcome.verdict.accepted
    assert "SolverFailed" in _list_codes(outcome)
    assert outcome.estimate is not None
    assert np.isnan(outcome.estimate.values).all()
    assert analyse_window(good, SETTINGS).verdict.accepted


@pytest.mark.fault("C4")
def test_rapid_without_start_lacks_acceleration() -> None:
    signals = bench.simulate_bench(bench.Plant(), bench.make_shuttle_demand())
    rows = bench.format_as_csv(signals, 0.003).splitlines(keepends=True)
    head = next(k for k, line in enumerate(rows) if line.startswith("time_s")) + 1
    speed = np.abs(np.asarray(signals.speed))
    late = int(np.argmax(speed > 0.95 * speed.max()))
    windows_found = find_windows(parse_recording("".join(rows[:head] + rows[head + late :])))
    outcome = analyse_window(windows_found[0], SETTINGS)
    assert not outcome.verdict.accepted
    assert "MissingStage(accel)" in _list_codes(outcome)
