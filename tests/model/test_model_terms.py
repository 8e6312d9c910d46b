"""The optional terms: the closed loop with terms against independent physics, and their own invariants."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from fdhil.config import Axis, parse_config
from fdhil.model import closed_loop, closed_loop_drive, model_terms
from fdhil.records import Float, Parameters
from studies import real_plant
from tests.bench import bench_document
from tests.model.reference_drive import EventReferenceDrive, ReferenceDrive, TwoMassReferenceDrive
from tests.paths import smooth_demand
from tests.tiers import sampled

PERIOD = 0.001
PLAIN = Parameters(0.53, 0.0047, 0.82, 0.081, 0.04, 4.2)
TERMS: dict[str, dict[str, float]] = {
    "load": {"load": 2.3},
    "load above friction": {"load": -9.0},
    "dry by direction": {"coulomb_positive": 5.0, "coulomb_negative": 3.1},
    "viscous by direction": {"viscous_positive": 0.06, "viscous_negative": 0.02},
    "stribeck": {"stribeck": 1.2, "stribeck_speed": 6.0},
    "rising": {"stribeck": -1.1, "stribeck_speed": 15.0},
    "ripples": {"ripple_screw_1": 0.5, "ripple_screw_1_phase": 0.7, "ripple_motor_24": 0.4},
    "dead time": {"dead_time": 3.0},
    "all": {
        "load": -1.5,
        "viscous_positive": 0.05,
        "stribeck": 0.8,
        "stribeck_speed": 10.0,
        "ripple_screw_1": 0.3,
        "ripple_motor_12": 0.2,
        "ripple_motor_12_phase": -1.0,
        "dead_time": 1.5,
        "speed_delay": 0.0005,
    },
}


def build_bench_axis(**regulators: Any) -> Axis:
    document = bench_document("X")
    document["axis"]["X"]["regulators"] |= regulators
    return parse_config(document).axis["X"]


def build_reversal(n: int, smoothed_s: tuple[float, float] = (0.020, 0.010)) -> Float:
    speed = np.concatenate([np.zeros(5), np.full(n // 3, 60.0), np.full(n // 3, -40.0), np.zeros(n - n // 3 * 2 - 5)])
    return 3.0 + smooth_demand(np.cumsum(speed * PERIOD)[:, None], smoothed_s, PERIOD)[:, 0]


def create_loaded_drive(slow: ReferenceDrive, axis: Axis, demand: Float) -> ReferenceDrive:
    """Return the reference drive settled at rest in the middle of the friction band."""
    slow.start = float(demand[0])
    pull = slow._compute_smooth_torque(0.0, 0.0, 1.0)
    slow.i = slow.speed_sum = pull / slow.p.K
    slow.current_sum = slow.p.R * slow.i
    slow.current_sum -= slow._compute_motor_voltage(0.0)
    slow.pipeline = [slow.current_sum] * axis.regulators.current_delay_cycles
    return slow


@pytest.mark.parametrize(("joined", "delay"), sampled(product(TERMS, [0, 3]), every=3))
def test_terms_match_independent_physics(joined: str, delay: int) -> None:
    """For a move, a reversal and rest."""
    axis, parameters = build_bench_axis(current_delay_cycles=delay), PLAIN.replace_values(**TERMS[joined])
    demand = build_reversal(150)
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, demand)
    slow = create_loaded_drive(
        ReferenceDrive(parameters, axis, PERIOD, increments=65536 << 20), axis, demand
    ).follow_demand(demand.tolist())
    assert response.limited_s == 0.0
    assert np.abs(response.position_mm - slow).max() < 0.1e-3


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("joined", TERMS)
def test_terms_match_adaptive_solver(joined: str) -> None:
    """Against ``solve_ivp`` with standstill as an event."""
    axis, parameters = build_bench_axis(), PLAIN.replace_values(**TERMS[joined])
    demand = build_reversal(60)
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, demand)
    exact = create_loaded_drive(EventReferenceDrive(parameters, axis, PERIOD, 65536 << 20), axis, demand).follow_demand(
        demand.tolist()
    )
    assert np.abs(response.position_mm - exact).max() < 0.1e-3


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_two_mass_model_matches_independent_physics(share: float) -> None:
    """The remaining difference is the instant within a step at which the table stops."""
    axis = build_bench_axis(current_delay_cycles=1)
    parameters = PLAIN.replace_values(
        resonance=70.0, resonance_damping=0.03, resonance_share=share, stribeck=0.5, stribeck_speed=8.0
    )
    demand = build_reversal(240, (0.060, 0.030))
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, demand)
    slow = TwoMassReferenceDrive(parameters, axis, PERIOD, 65536 << 20)
    assert np.abs(response.position_mm - slow.follow_demand(demand.tolist())).max() < 0.1e-3
    assert np.abs(response.table_mm - slow.tables_mm[::4]).max() < 0.2e-3
    assert np.abs(response.table_mm - response.position_mm).max() > 20e-3


def test_stiff_spring_equals_rigid_screw() -> None:
    """At a resonance far beyond the drive's bandwidth."""
    demand, axis = build_reversal(150), build_bench_axis()
    stiff = closed_loop.simulate_axis(
        PLAIN.replace_values(resonance=3000.0, resonance_damping=0.1), axis, PERIOD, demand
    )
    one = closed_loop.simulate_axis(PLAIN, axis, PERIOD, demand)
    assert np.abs(stiff.table_mm - one.table_mm).max() < 0.1e-3


def name_terms(m: real_plant.Mechanics, loops_: real_plant.Loops) -> Parameters:
    """Return the same machine by the names of the terms."""
    return Parameters.from_mapping(m.truth()).replace_values(
        load=m.load_nm,
        coulomb_positive=(1 + m.asymmetry) * m.Cd,
        coulomb_negative=(1 - m.asymmetry) * m.Cd,
        stribeck=m.static * m.Cd,
        stribeck_speed=m.static_speed_rad_s,
        ripple_screw_1=m.screw_ripple * m.Cd,
        ripple_screw_1_phase=m.screw_phase,
        resonance=m.resonance_hz,
        resonance_damping=m.damping,
        resonance_share=m.table_share,
        dead_time=loops_.dead_time_v,
        **{f"ripple_motor_{m.motor_order}": m.motor_ripple_nm, f"ripple_motor_{m.motor_order}_phase": m.motor_phase},
    )


def draw_ordinary_machine(seed: int) -> tuple[real_plant.Mechanics, real_plant.Loops]:
    """Return an ordinary machine: the bench at seed 0, else a random one, also with dominant friction."""
    if seed == 0:
        return real_plant.ORDINARY_MECHANICS, real_plant.Loops(dead_time_v=2.0)
    base = real_plant.SLOW if seed % 2 else real_plant.Mechanics()
    mechanics, loops_, _ = real_plant.draw_machine(np.random.default_rng(seed), base)
    return replace(mechanics, warming=0.0), replace(loops_, bus_sag=0.0)


@pytest.mark.parametrize("seed", range(6))
def test_terms_match_study_plant(seed: int) -> None:
    """All effects at once, from a settled state: within 0.1 um."""
    mechanics, real = draw_ordinary_machine(seed)
    real = replace(real, speed_filter_s=0.0005, delay_s=2 * real_plant.STEP_S)
    gains = {name: getattr(real, name) for name in ("speed_kp", "speed_ki", "current_kp", "current_ki")}
    axis = build_bench_axis(speed_filter_s=0.0005, current_delay_cycles=2, **gains)
    demand, parameters = build_reversal(300, (0.060, 0.030)), name_terms(mechanics, real)
    truth = real_plant.simulate_axis(mechanics, demand * 1e-3, real)
    state = closed_loop.create_standstill_state(parameters, axis, float(demand[0]), truth.standstill_a)
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, demand, state=state)
    assert np.abs(response.position_mm - truth.motor_m * 1e3).max() < 0.1e-3
    assert np.ptp(truth.table_m * 1e3 - response.table_mm) < 0.1e-3  # but for what the load bends
    assert np.abs(response.current_a - truth.current).max() < 0.1


@pytest.mark.parametrize("structure", ["p_pi_pi", "double_pi", "pid"])
@pytest.mark.parametrize("share", [-0.9, 0.0, 0.9])
def test_axis_at_standstill_does_not_move(structure: str, share: float) -> None:
    """For any holding current within the friction band."""
    more = {"double_pi": {"position_ki_per_s2": 300.0}, "pid": {"position_ki_per_s2": 2500.0, "speed_ki": 0.0}}
    axis = build_bench_axis(
        structure=structure, current_delay_cycles=2, speed_filter_s=0.0005, **more.get(structure, {})
    )
    parameters = PLAIN.replace_values(**TERMS["all"], resonance=90.0)
    pull = float(
        model_terms.compute_friction_torque(parameters, np.zeros(1), np.array([7.0 * model_terms.rad_per_mm(axis)]))[0]
    )
    current = (pull + share * parameters.Cd) / parameters.K
    state = closed_loop.create_standstill_state(parameters, axis, 7.0, current)
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, np.full(300, 7.0), state=state)
    assert np.abs(response.current_a - current).max() < 1e-6
    assert np.abs(response.position_mm - 7.0).max() < 1e-6
    assert np.ptp(response.table_mm) < 1e-6


@pytest.mark.parametrize("joined", [*TERMS, "resonance"])
def test_continued_run_with_terms_is_bit_identical(joined: str) -> None:
    axis = build_bench_axis(current_delay_cycles=5, speed_filter_s=0.0004)
    parameters = PLAIN.replace_values(**TERMS.get(joined, {"resonance": 80.0}))
    demand = build_reversal(90)
    whole = closed_loop.simulate_axis(parameters, axis, PERIOD, demand)
    tail = closed_loop.simulate_axis(parameters, axis, PERIOD, demand, state=whole.extract_state(41), first=41)
    assert np.array_equal(whole.states[:, 41:], tail.states)


def test_zero_terms_equal_plain_drive() -> None:
    demand, axis = build_reversal(150), build_bench_axis()
    start, found = closed_loop.create_zero_state(float(demand[0])), []
    for parameters in (PLAIN, PLAIN.replace_values(load=0.0)):
        drive = closed_loop.prepare_drive(parameters, axis, PERIOD)
        assert isinstance(drive, closed_loop_drive.DriveModel)
        found.append(replace(drive, leap=drive.leap[:0]).run(closed_loop.Commands(demand), start))
    plain, nil = found
    assert np.array_equal(nil.position_mm, plain.position_mm)
    assert np.array_equal(nil.current_a, plain.current_a)


def test_speed_delay_does_not_change_motion() -> None:
    demand, axis = build_reversal(90), build_bench_axis()
    late = closed_loop.simulate_axis(PLAIN.replace_values(speed_delay=0.002), axis, PERIOD, demand)
    assert np.array_equal(late.position_mm, closed_loop.simulate_axis(PLAIN, axis, PERIOD, demand).position_mm)


def test_torque_matches_formula() -> None:
    """Term by term, also at rest, where dry friction has no sign."""
    p = PLAIN.replace_values(**TERMS["all"], coulomb_negative=3.0)
    speed, angle = np.array([-20.0, 0.0, 5.0]), np.array([1.0, 2.0, 3.0])
    ripple = 0.3 * np.sin(angle) + 0.2 * np.sin(12 * angle - 1.0)
    dry = np.array([-3.0 - 0.8 * np.exp(-4.0), 0.0, 4.2 + 0.8 * np.exp(-0.25)])
    expected = -1.5 + dry + np.array([0.04, 0.0, 0.05]) * speed + ripple
    assert np.allclose(model_terms.compute_friction_torque(p, speed, angle), expected, rtol=1e-14)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("joined", TERMS)
def test_multi_cycle_steps_with_terms_match_single_steps(joined: str, seed: int) -> None:
    """With the mean of the terms over a speed cycle."""
    random = np.random.default_rng(seed)
    axis = build_bench_axis(speed_filter_s=0.0005 * (seed == 1), setpoint_filter_s=0.001 * (seed == 2))
    parameters = PLAIN.replace_values(**TERMS[joined], Jt=PLAIN.Jt * random.uniform(0.7, 1.4))
    demand = build_reversal(300) + (np.arange(300) > 200) * 3.0 * (seed == 3)  # a jump clips
    drive = closed_loop.prepare_drive(parameters, axis, PERIOD)
    assert isinstance(drive, closed_loop_drive.DriveModel)
    stepping = replace(drive, leap=drive.leap[:0])
    start = closed_loop.create_standstill_state(parameters, axis, float(demand[0]))
    one, other = (d.run(closed_loop.Commands(demand), start) for d in (drive, stepping))
    assert np.abs(one.position_mm - other.position_mm).max() < 0.02e-3
    assert np.abs(one.current_a - other.current_a).max() < 0.05
    assert np.abs(one.limited - other.limited).max() <= 1 / 16
