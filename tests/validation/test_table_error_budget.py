"""A model is assessed in micrometres at the table, on drives from another simulation than the model's."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from fdhil.config import Axis, Identification
from fdhil.config.axis_section import Nominal
from fdhil.config.regulators import Regulators
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window
from fdhil.pipeline.window_analysis import select_matching_axis
from fdhil.records import PARAMETERS, Parameters, Window, WindowOutcome, compute_rms
from fdhil.validation.move_replay import replay_with_load_search
from fdhil.validation.table_error_budget import TorqueToTableError
from studies import bench, real_plant
from studies.real_plant import Loops, Mechanics, Sensors

SETTINGS = Identification()
PERIOD_S = 0.001
PLAIN, LOOPS, SENSORS = Mechanics(), Loops(), Sensors()


def make_axis(mechanics: Mechanics, loops: Loops) -> Axis:
    return Axis(
        screw_pitch_mm=1e3 * mechanics.pitch_m,
        rapid_speed_mm_s=500.0,
        max_acceleration_mm_s2=4000.0,
        nominal=Nominal(**mechanics.truth()),
        regulators=Regulators(
            position_gain_per_s=loops.position_gain_per_s,
            speed_feedforward=loops.speed_feedforward,
            speed_kp=loops.speed_kp,
            speed_ki=loops.speed_ki,
            current_limit_a=loops.current_limit_a,
            current_kp=loops.current_kp,
            current_ki=loops.current_ki,
            voltage_limit_v=loops.voltage_limit_v,
        ),
    )


AXIS = make_axis(Mechanics(), Loops())


@lru_cache(maxsize=16)
def record_rapids(mechanics: Mechanics = PLAIN, loops: Loops = LOOPS, sensors: Sensors = SENSORS) -> list[Window]:
    run = real_plant.simulate_axis(mechanics, bench.make_shuttle_demand(moves=2), loops)
    return find_windows(real_plant.make_recording(run, mechanics, sensors, 0.5))


def analyse_windows(windows: list[Window], axis: Axis | None = AXIS) -> list[WindowOutcome]:
    return [analyse_window(window, SETTINGS, axis, PERIOD_S) for window in windows]


@pytest.mark.parametrize(
    ("mechanics", "loops", "sensors"),
    [
        (Mechanics(), Loops(), Sensors()),
        (Mechanics(load_nm=2.5, asymmetry=0.1), Loops(), Sensors()),
        (Mechanics(static=0.3), Loops(), Sensors()),
        (Mechanics(screw_ripple=0.1), Loops(), Sensors()),
        (Mechanics(), Loops(dead_time_v=2.0), Sensors(command=True)),
        (
            replace(real_plant.ORDINARY_MECHANICS, resonance_hz=200.0),
            real_plant.ORDINARY_LOOPS,
            replace(real_plant.ORDINARY_SENSORS, speed="middle"),
        ),
    ],
    ids=["plain", "load", "stribeck", "ripple", "dead time", "all together"],
)
def test_simulated_real_machine_is_accepted_in_both_directions(
    mechanics: Mechanics, loops: Loops, sensors: Sensors
) -> None:
    for outcome in analyse_windows(record_rapids(mechanics, loops, sensors)):
        assert outcome.verdict.accepted, outcome.verdict.reasons
        assert outcome.verdict.unexplained_um is not None
        assert outcome.verdict.unexplained_um < 1.5  # of 38 um


@pytest.mark.parametrize("loops", [Loops(speed_filter_s=0.001), Loops(speed_kp=0.8 * 23.562)])
def test_wrong_loop_settings_are_reported_as_loops_not_mechanics(loops: Loops) -> None:
    (first, _) = analyse_windows(record_rapids(loops=loops))
    assert not first.verdict.accepted
    (reason,) = first.verdict.reasons
    assert "loops" in reason.advice
    assert first.verdict.unexplained_um is not None
    assert f"{first.verdict.unexplained_um:.3g} um" in reason.text


def test_share_of_torque_is_assessed_without_regulators() -> None:
    for outcome in analyse_windows(record_rapids(Mechanics(static=0.1, screw_ripple=0.05)), axis=None):
        assert outcome.verdict.accepted, outcome.verdict.reasons
        assert outcome.verdict.unexplained_um is None
    (lost, *_) = analyse_windows(record_rapids(Mechanics(resonance_hz=40.0, table_share=0.7)), axis=None)
    assert not lost.verdict.accepted


def test_configured_tolerance_is_used() -> None:
    windows = record_rapids(Mechanics(resonance_hz=100.0))
    assert all(outcome.verdict.accepted for outcome in analyse_windows(windows))
    strict = SETTINGS.model_copy(update={"tolerance_um": 0.2})
    assert not any(analyse_window(window, strict, AXIS, PERIOD_S).verdict.accepted for window in windows)


def test_model_deficiency_warns_with_cost_and_widens_intervals() -> None:
    warm = analyse_windows(record_rapids(Mechanics(warming=0.1)))[1]
    assert warm.verdict.accepted
    (warning,) = (w for w in warm.verdict.warnings if "winding warms" in w.text)
    assert " at the table 0." in warning.text
    assert warm.estimate is not None
    plain = analyse_windows(record_rapids())[1].estimate
    assert plain is not None
    assert warm.estimate.get_std("R") > 3 * plain.get_std("R")
    middle = 0.5 * (1.0 + 0.5 * 0.1) + 0.5 * 0.25 * 0.1  # the second half's, of a rise by a tenth over both
    assert abs(warm.estimate.get_value("R") - middle) < 3 * warm.estimate.get_std("R")


def test_dead_time_is_reported_in_volts() -> None:
    settings = SETTINGS.model_copy(update={"voltage_source": "terminals"})
    for window in record_rapids(Mechanics(), Loops(dead_time_v=2.0), Sensors(command=True)):
        outcome = analyse_window(window, settings, AXIS, PERIOD_S)
        assert outcome.estimate is not None
        if "dead_time" in outcome.estimate.terms:
            continue
        reported = [*outcome.verdict.reasons, *outcome.verdict.warnings]
        assert any("+2.0" in reason.text and "dead time" in reason.text for reason in reported)
        for name, true in Mechanics().truth().items():
            assert abs(outcome.estimate.get_value(name) - true) < 3 * outcome.estimate.get_std(name)


def test_window_of_other_machine_is_not_replayed() -> None:
    (window, _) = record_rapids()
    assert select_matching_axis(window, AXIS) is AXIS
    assert select_matching_axis(replace(window, pitch_mm=10.0), AXIS) is None
    assert select_matching_axis(replace(window, rapid_speed_rad_s=0.3 * window.rapid_speed_rad_s), AXIS) is None
    assert select_matching_axis(window, None) is None


def test_rows_between_set_points_are_not_replayed() -> None:
    (window, _) = record_rapids()
    truth = Parameters.from_mapping(Mechanics().truth())
    assert replay_with_load_search(window, truth, AXIS, PERIOD_S) is not None
    assert replay_with_load_search(window, truth, AXIS, 0.004) is None
    assert replay_with_load_search(replace(window, demand_mm=np.zeros(window.n)), truth, AXIS, PERIOD_S) is None


def test_torque_to_table_error_matches_simulated_drive() -> None:
    mechanics, rows = Mechanics(Cd=1e-6), 1500
    loop = TorqueToTableError.derive(Parameters.from_mapping(mechanics.truth()), 20.0, AXIS)
    load = np.where(np.arange(rows) >= 500, 1.0, 0.0)
    reported = loop.convert_momentum_to_um(np.cumsum(load)[None] * PERIOD_S, PERIOD_S)[0]
    plant = bench.Plant(Cd=1e-6)
    moved = 1e6 * bench.simulate_bench(plant, np.zeros(rows), load=load).position
    assert compute_rms(reported + moved) < 0.05 * compute_rms(moved)


def test_noise_adds_no_unexplained_torque() -> None:
    loop = TorqueToTableError.derive(Parameters.from_mapping(Mechanics().truth()), 20.0, None)
    rng = np.random.default_rng(1)
    white, walk = 0.01 * rng.standard_normal((40, 1200)), np.cumsum(0.001 * rng.standard_normal((40, 1200)), axis=1)
    seen = compute_rms(loop.convert_momentum_to_um(white + walk, PERIOD_S)[:, 200:].ravel())
    assert loop.compute_noise_um(0.01, 0.001, 1200, PERIOD_S) == pytest.approx(seen, rel=0.15)


def test_plain_drive_keeps_parameter_intervals() -> None:
    for outcome in analyse_windows(record_rapids()):
        assert outcome.estimate is not None
        assert outcome.estimate.names == PARAMETERS
        assert outcome.verdict.warnings == ()
