"""Windows without a voltage: accepted if valid, refused for faults that current and position show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fdhil import config
from fdhil.config import Axis, Identification
from fdhil.pipeline import AxisPipeline, analyse_window, pool_windows
from fdhil.records import ParameterSet, Skill, Window, WindowOutcome, freeze_array
from studies import real_plant
from tests.bench import bench_axis
from tests.identification.no_voltage_recordings import (
    LOOPS,
    RAPID_M_S,
    SCREW,
    SECTION,
    SENSORS,
    build_shuttle_demand,
    find_screw_windows,
)

SETTINGS = Identification()


def analyse_moves(moves: int = 4) -> list[WindowOutcome]:
    return [analyse_window(window, SETTINGS) for window in find_screw_windows(moves)]


def test_screw_rapids_and_pool_are_accepted_without_voltage() -> None:
    outcomes = analyse_moves()
    assert [o.verdict.reasons for o in outcomes] == [()] * 4
    estimate, verdict = pool_windows(outcomes, SETTINGS)
    assert verdict.accepted
    assert estimate is not None
    for name, tolerance in (("Jt", 0.01), ("ft", 0.06), ("Cd", 0.06)):
        assert estimate.get_value(name) == pytest.approx(SCREW.truth()[name], rel=tolerance)


@pytest.mark.parametrize("direction", [1, -1])
def test_single_direction_pool_is_accepted(direction: int) -> None:
    outcomes = [o for o in analyse_moves() if o.window.direction == direction]
    estimate, verdict = pool_windows(outcomes, SETTINGS)
    assert verdict.accepted
    assert estimate is not None
    effective = SCREW.Cd + direction * SCREW.load_nm
    assert estimate.get_value("Cd") == pytest.approx(effective, rel=0.06)


def test_missing_torque_constant_is_refused_with_advice() -> None:
    outcome = analyse_window(replace(find_screw_windows()[0], torque_constant_nm_per_a=None), SETTINGS)
    (reason,) = outcome.verdict.reasons
    assert reason.code == "LowExcitation"
    assert "torque_constant_nm_per_a" in reason.advice


def _make_axis(source: str) -> Axis:
    document = {"machine": {"name": "screw", "sync_period_s": 0.001}, "axis": {"X": bench_axis(**SECTION)}}
    axis = config.parse_config(document).axis["X"]
    return axis.model_copy(update={"voltage": axis.voltage.model_copy(update={"source": source})})


def test_data_sheet_replaces_voltage_of_drive_not_of_failed_sensor() -> None:
    window = replace(find_screw_windows()[0], torque_constant_nm_per_a=None)
    outcome = analyse_window(window, SETTINGS, _make_axis("drive"))
    assert outcome.verdict.accepted
    assert outcome.verdict.unexplained_um is not None
    assert 0.0 < outcome.verdict.unexplained_um < 20.0  # of a following error of 800 um
    reported = outcome.estimate
    assert reported is not None
    assert reported.given == ("R", "L", "K")
    assert reported.get_value("K") == 0.33
    (reason,) = analyse_window(window, SETTINGS, _make_axis("modbus")).verdict.reasons
    assert str(reason) == "SampleTiming: the window has no voltage"


def _delay_current(window: Window) -> Window:
    return replace(window, current_a=freeze_array(np.concatenate([np.zeros(4), window.current_a[:-4]])))


def _clip_current(window: Window) -> Window:
    top = 0.8 * float(np.abs(window.current_a).max())
    return replace(window, current_a=freeze_array(np.clip(window.current_a, -top, top)))


def _hold_current(window: Window) -> Window:
    current = window.current_a.copy()
    current[500:600] = current[500]
    return replace(window, current_a=freeze_array(current))


def _add_load(window: Window) -> Window:
    current = window.current_a.copy()
    current[500:800] += 0.1 * np.abs(current).max()
    return replace(window, current_a=freeze_array(current))


def _scale_current(window: Window) -> Window:
    current = window.current_a.copy()
    current[window.n // 2 :] *= 1.2
    return replace(window, current_a=freeze_array(current))


def _quantise_signals(window: Window) -> Window:
    rng = np.random.default_rng(1)
    noise = 0.3 * np.abs(window.current_a).max() * rng.standard_normal(window.n // 20 + 1).repeat(20)[: window.n]
    return replace(window, current_a=freeze_array(window.current_a + noise))


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        (_delay_current, "SampleTiming"),
        (_clip_current, "Saturated"),
        (_hold_current, "StuckValue"),
        (_add_load, "LoadDetected"),
        (_scale_current, "LoadDetected"),
        (_quantise_signals, "ValidationFailed"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
@pytest.mark.fault("D5", "B11", "B12", "C1", "C6")
def test_each_fault_is_refused(fault: Callable[[Window], Window], code: str) -> None:
    outcome = analyse_window(fault(find_screw_windows()[0]), SETTINGS)
    assert code in [reason.code for reason in outcome.verdict.reasons]


def test_aborted_move_is_refused() -> None:
    whole = build_shuttle_demand(1)
    cut = np.minimum(whole, 0.1)
    run = real_plant.simulate_axis(SCREW, cut, LOOPS)
    read = real_plant.make_recording(run, SCREW, SENSORS, RAPID_M_S, voltage=False)
    from fdhil.identification.rapid_windows import find_windows

    (window,) = find_windows(replace(read, torque_constant_nm_per_a=SCREW.K))
    reasons = analyse_window(window, SETTINGS).verdict.reasons
    assert "EpisodeAborted" in [reason.code for reason in reasons]


def test_triangular_move_is_listed_but_refused() -> None:
    ramp = np.concatenate([np.linspace(0.0, 0.15, 400), np.linspace(0.15, 0.0, 400)])
    demand = np.concatenate([np.zeros(300), np.cumsum(ramp) * 1e-3, np.full(300, ramp.sum() * 1e-3)])
    run = real_plant.simulate_axis(SCREW, demand, LOOPS)
    read = real_plant.make_recording(run, SCREW, SENSORS, RAPID_M_S, voltage=False)
    from fdhil.identification.rapid_windows import find_windows

    (window,) = find_windows(replace(read, torque_constant_nm_per_a=SCREW.K))
    outcome = analyse_window(window, SETTINGS)
    assert outcome.estimate is not None
    assert outcome.estimate.get_value("Jt") == pytest.approx(SCREW.Jt, rel=0.01)
    assert [reason.code for reason in outcome.verdict.reasons] == ["MissingStage(cruise)"]


def test_drive_without_feedforward_is_assessed_by_following_error() -> None:
    window = find_screw_windows()[0]
    rng = np.random.default_rng(3)
    waves = 0.04 * np.abs(window.current_a).max() * np.sin(np.arange(window.n) / 15.0 + rng.uniform(0, 6))
    rough = replace(window, current_a=freeze_array(window.current_a + waves))
    assert analyse_window(rough, SETTINGS).verdict.accepted
    unled = replace(rough, demand_mm=freeze_array(np.full(window.n, np.nan)))
    assert "ValidationFailed" in [reason.code for reason in analyse_window(unled, SETTINGS).verdict.reasons]


def test_machine_without_voltage_publishes_predictive_sets() -> None:
    nominal = {**SECTION["nominal"], "K": SCREW.K}
    document = {
        "machine": {"name": "screw", "sync_period_s": 0.001},
        "axis": {"X": bench_axis(**{**SECTION, "nominal": nominal})},
    }
    pipeline = AxisPipeline("X", config.parse_config(document))
    outcomes = [
        outcome
        for window in find_screw_windows()
        for outcome in pipeline.process_record(replace(window, torque_constant_nm_per_a=None))
    ]
    assert sum(isinstance(outcome, ParameterSet) for outcome in outcomes) == 4
    published = pipeline.published
    assert published is not None
    assert published.parameters.Cd == pytest.approx(SCREW.Cd, rel=0.03)
    assert published.parameters.get_term("load") == pytest.approx(SCREW.load_nm, rel=0.05)
    assert np.isfinite(published.covariance).all()
    skills = [outcome for outcome in outcomes if isinstance(outcome, Skill)]
    assert skills[-1].rms_um < 0.005 * skills[-1].measured_rms_um
