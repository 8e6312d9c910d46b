"""A resonance between motor and table is fitted, or found, on machines of another simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Axis, Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.kalman import LOAD
from fdhil.identification.prepared_motion import TermRegressor, prepare_window
from fdhil.identification.rapid_windows import find_windows
from fdhil.identification.spring_fit import RESONANCE, SHARE, fit_with_compliance
from fdhil.identification.spring_torques import Spring, SpringTorques
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.pipeline.identified_loops import LoopTracker, search_resonance
from fdhil.records import PARAMETERS, Window, WindowOutcome
from studies.bench import make_shuttle_demand
from studies.real_plant import (
    ORDINARY_LOOPS,
    ORDINARY_MECHANICS,
    ORDINARY_SENSORS,
    SLOW,
    SLOW_LOOPS,
    Mechanics,
    Sensors,
    make_recording,
    simulate_axis,
)
from studies.reality import BASES, Machine, draw_machines, make_config
from tests.identification.realistic_rapids import simulate_rapids

SETTINGS = Identification()
PERIOD_S = 1e-3


def build_axis_with_resonance(mechanics: Mechanics, base: str, told_hz: float = 0.0) -> Axis:
    """Return the section of a base's axis, with a configured resonance."""
    loops = SLOW_LOOPS if base == "slow" else BASES[base][1]
    return make_config(Machine("", base, mechanics, loops, Sensors(), loops, told_hz)).axis["X"]


def simulate_slow_rapids(mechanics: Mechanics, seed: int = 1) -> list[Window]:
    """Return one rapid in each direction of the axis with dominant friction."""
    _, _, rapid_m_s, acceleration_m_s2, _ = BASES["slow"]
    moved = simulate_axis(mechanics, make_shuttle_demand(0.4, rapid_m_s, acceleration_m_s2, 2), SLOW_LOOPS)
    return find_windows(make_recording(moved, mechanics, Sensors(), rapid_m_s, seed))


def analyse_rapids(windows: list[Window], axis: Axis) -> list[WindowOutcome]:
    """Return the windows analysed through the axis pipeline."""
    return [analyse_window(window, SETTINGS, axis, PERIOD_S) for window in windows]


def test_spring_without_table_inertia_adds_no_torque() -> None:
    (window,) = simulate_rapids()
    motion = prepare_window(window)
    torques = SpringTorques.from_motion(motion, np.array([0.5, 0.005, 0.8, 0.075, 0.05, 5.0, 0.0]))
    stiff = torques.compute_response(Spring(100.0, 0.0, 0.03))
    ripple = TermRegressor("ripple_screw_1", LOAD, np.sin(motion.angle_rad))
    assert np.allclose(torques.apply_response(ripple, stiff).values, ripple.values, atol=1e-12)
    # its friction reaches the motor through the spring
    assert np.abs(torques.compute_felt_torque(torques.compute_response(Spring(5000.0, 0.5, 0.03)))).max() < 0.05


@pytest.mark.usefixtures("long_computation")
def test_configured_resonance_removes_the_bias_of_the_six() -> None:
    """With a good encoder the table's share is determined too, and inertia and inductance are unbiased."""
    mechanics = replace(ORDINARY_MECHANICS, load_nm=0.0)
    windows = simulate_rapids(mechanics, ORDINARY_SENSORS, ORDINARY_LOOPS, moves=2)
    truth = np.array(list(mechanics.truth().values())) * np.array([1 / 1.01, 1 / 1.01, 1.0, 1.01, 1.01, 1.01])
    for reported, stiff in zip(
        analyse_rapids(windows, build_axis_with_resonance(mechanics, "bench", 125.0)),
        analyse_rapids(windows, build_axis_with_resonance(mechanics, "bench")),
        strict=True,
    ):
        assert reported.verdict.accepted
        assert reported.estimate is not None
        assert stiff.estimate is not None
        assert reported.estimate.get_value(RESONANCE) == pytest.approx(120.0, rel=0.03)
        assert reported.estimate.get_value(SHARE) == pytest.approx(0.6, abs=0.06)
        errors = (
            np.array([[e.get_value(n) for n in PARAMETERS] for e in (reported.estimate, stiff.estimate)]) / truth - 1.0
        )
        assert abs(errors[0, 3]) < 0.001  # of the inertia
        assert abs(errors[0, 1]) < min(0.003, 0.5 * abs(errors[1, 1]))  # of the inductance


def test_configured_prior_counts_once_over_all_windows() -> None:
    """Eight windows with the same prior of the table's share determine it no better than one."""
    windows = simulate_slow_rapids(replace(SLOW, resonance_hz=150.0))
    outcomes = analyse_rapids(windows, build_axis_with_resonance(SLOW, "slow", 150.0))
    for outcome in outcomes:
        assert outcome.estimate is not None
        assert outcome.estimate.get_std(SHARE) > 0.05
    estimate, _ = pool_windows(outcomes, SETTINGS)
    assert estimate is not None
    assert estimate.get_std(SHARE) > 0.7 * min(o.estimate.get_std(SHARE) for o in outcomes if o.estimate is not None)


def test_configured_resonance_is_replayed_at_dominant_friction() -> None:
    windows = simulate_slow_rapids(replace(SLOW, resonance_hz=80.0))
    assert not any(o.verdict.accepted for o in analyse_rapids(windows, build_axis_with_resonance(SLOW, "slow")))
    for outcome in analyse_rapids(windows, build_axis_with_resonance(SLOW, "slow", 80.0)):
        assert outcome.verdict.accepted, outcome.verdict.reasons
        assert outcome.verdict.unexplained_um is not None
        assert outcome.verdict.unexplained_um < 0.3


def test_absent_configured_resonance_is_reported() -> None:
    reasons = [
        r
        for o in analyse_rapids(simulate_slow_rapids(SLOW, seed=2), build_axis_with_resonance(SLOW, "slow", 50.0))
        for r in o.verdict.reasons
    ]
    assert reasons
    assert all("resonance_hz" in reason.advice for reason in reasons)


@pytest.mark.usefixtures("long_computation")
def test_unconfigured_resonance_is_found_by_the_replay() -> None:
    axis = build_axis_with_resonance(SLOW, "slow")
    windows = simulate_slow_rapids(replace(SLOW, resonance_hz=80.0))
    softer = search_resonance(analyse_rapids(windows, axis), axis, PERIOD_S)
    assert softer is not None
    again = analyse_rapids(windows, softer)
    for outcome in again:
        assert outcome.verdict.accepted
        assert outcome.estimate is not None
        # seen from the motor, frequency and share compensate each other: the table's motion is determined
        hertz, share = outcome.estimate.get_value(RESONANCE), outcome.estimate.get_value(SHARE)
        assert hertz * (1 - share) ** 0.5 == pytest.approx(80.0 * 0.4**0.5, rel=0.15)


@pytest.mark.usefixtures("long_computation")
def test_running_machine_keeps_its_identified_resonance() -> None:
    windows = simulate_slow_rapids(replace(SLOW, resonance_hz=80.0))
    loops = LoopTracker(build_axis_with_resonance(SLOW, "slow"), SETTINGS, PERIOD_S)
    first, _ = loops.analyse_rapid(windows[0])
    assert first.verdict.accepted
    assert loops.axis is not None
    assert loops.axis.resonance_hz is not None
    second, _ = loops.analyse_rapid(windows[1])
    assert second.verdict.accepted
    assert second.estimate is not None
    assert RESONANCE in second.estimate.terms


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    "mechanics", [SLOW, replace(SLOW, static=-0.25, static_speed_rad_s=20.0)], ids=["stiff", "friction"]
)
def test_rigid_machine_yields_no_resonance(mechanics: Mechanics) -> None:
    axis = build_axis_with_resonance(SLOW, "slow")
    assert search_resonance(analyse_rapids(simulate_slow_rapids(mechanics), axis), axis, PERIOD_S) is None


def test_significant_resonance_is_added_without_regulators() -> None:
    (window,) = simulate_rapids(replace(Mechanics(), resonance_hz=60.0), Sensors(noise=0.0005, speed="difference"))
    base = maximum_likelihood.fit_windows([window], SETTINGS)
    assert base is not None
    found = fit_with_compliance(base, None)
    assert found is not None
    names = [course.name for course in found.problem.motions[0].courses]
    assert names[-2:] == [RESONANCE, SHARE]
    (plain,) = simulate_rapids(Mechanics(), Sensors(noise=0.0005, speed="difference"))
    stiff = maximum_likelihood.fit_windows([plain], SETTINGS)
    assert stiff is not None
    assert fit_with_compliance(stiff, None) is None


def test_holding_load_explains_the_start_of_a_move() -> None:
    """After a move the other way the drive still pulls that way, as far as friction and load hold it."""
    mechanics = replace(SLOW, load_nm=0.96, asymmetry=-0.09, static=0.08, static_speed_rad_s=17.0)
    _, _, rapid_m_s, acceleration_m_s2, _ = BASES["slow"]
    moved = simulate_axis(mechanics, make_shuttle_demand(0.4, rapid_m_s, acceleration_m_s2, 3), SLOW_LOOPS)
    last = find_windows(make_recording(moved, mechanics, Sensors(), rapid_m_s, 1))[-1]
    (outcome,) = analyse_rapids([last], build_axis_with_resonance(SLOW, "slow"))
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert outcome.verdict.unexplained_um is not None
    assert outcome.verdict.unexplained_um < 0.4


def test_stribeck_speed_stays_within_the_observed_speeds() -> None:
    """Below all observed speeds any amplitude would fit: this machine's fourth rapid once got 5e17 N.m."""
    machine = draw_machines(12, 1)[11]
    _, _, rapid_m_s, acceleration_m_s2, _ = BASES["slow"]
    moved = simulate_axis(machine.mechanics, make_shuttle_demand(0.4, rapid_m_s, acceleration_m_s2, 4), machine.loops)
    last = find_windows(make_recording(moved, machine.mechanics, machine.sensors, rapid_m_s, 65000))[-1]
    (outcome,) = analyse_rapids([last], make_config(machine).axis["X"])
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert outcome.estimate is not None
    for name in {"stribeck"} & set(outcome.estimate.terms):
        assert abs(outcome.estimate.get_value(name)) < 10.0
