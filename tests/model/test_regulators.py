"""The contract of every regulator structure with every option, against an independent drive."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil import tables
from fdhil.config import Axis
from fdhil.correction import plan_correction
from fdhil.errors import ConfigError
from fdhil.model import closed_loop
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Float, Parameters
from tests.bench import bench_document
from tests.model.reference_drive import EventReferenceDrive, ReferenceDrive
from tests.paths import build_bench_demand, build_bench_trajectory, compute_rms, smooth_demand
from tests.tiers import sampled

PERIOD = 0.001
# gains that make each structure as stiff as the bench's own
GAINS: dict[str, dict[str, Any]] = {
    "p_pi_pi": {},
    "double_pi": {"position_ki_per_s2": 300.0},
    "pid": {"position_gain_per_s": 100.0, "position_ki_per_s2": 2500.0, "speed_ki": 0.0},
    "linuxcnc_pid": {"position_ki_per_s2": 300.0, "position_derivative": 0.1, "acceleration_feedforward_s": 0.001},
}
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "torque": {"torque_feedforward": 0.9},
    "filter": {"setpoint_filter_s": 0.002},
    "second order": {"setpoint_filter_s": 0.001, "setpoint_filter_order": 2},
    "speed filter": {"speed_filter_s": 0.0005},
    "delay": {"current_delay_cycles": 2},
    "long delay": {"current_delay_cycles": 32, "current_kp": 1.5, "current_ki": 150.0},
    "all": {
        "speed_feedforward": 0.95,
        "torque_feedforward": 0.5,
        "setpoint_filter_s": 0.001,
        "setpoint_filter_order": 2,
        "speed_filter_s": 0.0003,
        "current_delay_cycles": 1,
    },
}
NOT_OF_LINUXCNC = ("torque_feedforward", "setpoint_filter_s", "setpoint_filter_order")
CASES = list(product(tables.REGULATORS, OPTIONS))


def build_bench_axis(structure: str, **regulators: Any) -> configuration.MachineConfig:
    document = bench_document()
    for axis in document["axis"].values():
        given = GAINS[structure] | regulators
        lacks = NOT_OF_LINUXCNC if structure == "linuxcnc_pid" else ()
        axis["regulators"] |= {"structure": structure} | {k: v for k, v in given.items() if k not in lacks}
    return configuration.parse_config(document)


def simulate_nominal(axis: Axis, demand: Float, **more: Any) -> closed_loop.Response:
    return closed_loop.simulate_axis(Parameters(**axis.nominal.model_dump()), axis, PERIOD, demand, **more)


def build_reversal(n: int) -> Float:
    speed = np.concatenate([np.zeros(5), np.full(n // 3, 30.0), np.full(n // 3, -20.0), np.zeros(n - n // 3 * 2 - 5)])
    return smooth_demand(np.cumsum(speed * PERIOD)[:, None], (0.020, 0.010), PERIOD)[:, 0]


@pytest.mark.parametrize(("structure", "option"), CASES)
def test_every_structure_fulfils_the_contract(structure: str, option: str) -> None:
    """Starts at the given position, follows to rest, respects limits, and continues from any sample bit-identically."""
    axis = build_bench_axis(structure, **OPTIONS[option]).axis["X"]
    demand = build_bench_demand(5)[:, 1] + 7.0
    whole = simulate_nominal(axis, demand)
    assert whole.position_mm[0] == demand[0]
    assert whole.speed_rad_s[0] == whole.current_a[0] == 0.0
    assert np.abs(whole.position_mm - demand).max() < 3.0
    assert abs(whole.position_mm[-1] - demand[-1]) < 0.06
    assert np.abs(whole.current_a).max() < 1.05 * axis.regulators.current_limit_a
    row = 700
    tail = simulate_nominal(axis, demand, state=whole.extract_state(row), first=row)
    assert np.array_equal(tail.position_mm, whole.position_mm[row:])
    used = len(whole.states)
    assert np.array_equal(tail.end[:used], whole.end[:used])


@pytest.mark.parametrize(("structure", "option"), sampled(CASES, every=4))
def test_structure_matches_independent_physics(structure: str, option: str) -> None:
    """For a move, a reversal and rest."""
    axis = build_bench_axis(structure, **OPTIONS[option]).axis["X"]
    parameters = Parameters(0.53, 0.0047, 0.82, 0.081, 0.04, 4.2)
    demand = build_reversal(120)
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, demand)
    assert response.limited_s == 0.0
    slow = ReferenceDrive(parameters, axis, PERIOD, increments=65536 << 20).follow_demand(demand.tolist())
    assert np.abs(response.position_mm - slow).max() < 0.05e-3


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(("structure", "option"), CASES)
def test_structure_matches_adaptive_solver(structure: str, option: str) -> None:
    """Within 0.05 um of ``solve_ivp`` with standstill as an event, reversal and rest included."""
    axis = build_bench_axis(structure, **OPTIONS[option]).axis["X"]
    parameters = Parameters(0.53, 0.0047, 0.82, 0.081, 0.04, 4.2)
    demand = build_reversal(40)
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, demand)
    exact = EventReferenceDrive(parameters, axis, PERIOD, 65536 << 20).follow_demand(demand.tolist())
    assert np.abs(response.position_mm - exact).max() < 0.05e-3


def build_limit_steps() -> Float:
    """Return demand steps up and down, in mm, that reach current and voltage limits."""
    return np.concatenate([np.zeros(5), np.full(40, 12.0), np.full(30, 4.0)])


@pytest.mark.parametrize(("structure", "option"), sampled(CASES, every=4))
def test_structure_matches_while_limit_acts(structure: str, option: str) -> None:
    """Within 0.05 um, also while both limits act."""
    axis = build_bench_axis(structure, **OPTIONS[option]).axis["X"]
    response = simulate_nominal(axis, build_limit_steps())
    assert response.limited_s > 0.005
    nominal = Parameters(**axis.nominal.model_dump())
    slow = ReferenceDrive(nominal, axis, PERIOD, 65536 << 20).follow_demand(build_limit_steps().tolist())
    assert np.abs(response.position_mm - slow).max() < 0.05e-3


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("structure", tables.REGULATORS)
def test_structure_matches_adaptive_solver_while_limit_acts(structure: str) -> None:
    """The same within 0.05 um of ``solve_ivp``, all options on."""
    axis = build_bench_axis(structure, **OPTIONS["all"]).axis["X"]
    nominal = Parameters(**axis.nominal.model_dump())
    exact = EventReferenceDrive(nominal, axis, PERIOD, 65536 << 20).follow_demand(build_limit_steps().tolist())
    assert np.abs(simulate_nominal(axis, build_limit_steps()).position_mm - exact).max() < 0.05e-3


@pytest.mark.parametrize(
    "regulators",
    [
        {"pid_output": "current", "speed_ki": 0.0, "position_derivative": 1.0, "position_gain_per_s": 100.0},
        {"error_previous_target": False, "deadband_mm": 0.002, "jerk_feedforward_s2": 2e-6},
        {"output_limit_mm_s": 8.0},
    ],
    ids=["current", "deadband", "limit"],
)
def test_linuxcnc_pid_matches_independent_physics(regulators: dict[str, Any]) -> None:
    axis = build_bench_axis("linuxcnc_pid", **regulators).axis["X"]
    parameters = Parameters(0.53, 0.0047, 0.82, 0.081, 0.04, 4.2)
    demand = build_reversal(120)
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, demand)
    slow = ReferenceDrive(parameters, axis, PERIOD, increments=65536 << 20).follow_demand(demand.tolist())
    assert np.abs(response.position_mm - slow).max() < 0.05e-3


@pytest.mark.parametrize(
    ("structure", "regulators"),
    [
        ("linuxcnc_pid", {"pid_output": "current", "position_derivative": 1.0, "position_ki_per_s2": 0.0}),
        ("p_pi_pi", {"speed_feedforward": 0.95, "setpoint_filter_s": 0.001}),
    ],
)
def test_axis_held_by_friction_stays_off_setpoint(structure: str, regulators: dict[str, Any]) -> None:
    """After a long standstill no derivative, feed-forward or filter causes a step."""
    axis = build_bench_axis(structure, **regulators, speed_ki=0.0).axis["X"]
    parameters, off_mm = Parameters(**axis.nominal.model_dump()), 0.002
    state = closed_loop.create_standstill_state(parameters, axis, off_mm, 0.0, 0.0)
    response = closed_loop.simulate_axis(parameters, axis, PERIOD, np.zeros(200), state=state)
    assert np.abs(response.position_mm - off_mm).max() < 1e-6


def test_pid_equals_cascade_with_full_feedforward() -> None:
    """With full feed-forward a P and PI cascade is a PID, apart from the timing of the speed demand."""
    demand = build_bench_demand(10)[:, 0]
    cascade = simulate_nominal(build_bench_axis("p_pi_pi").axis["X"], demand)
    kv, kp, ki = 50.0, 23.562, 1184.35
    gains = {"position_gain_per_s": kv + ki / kp, "position_ki_per_s2": kv * ki / kp}
    both = cascade.position_mm - simulate_nominal(build_bench_axis("pid", **gains).axis["X"], demand).position_mm
    assert np.abs(both).max() < 0.4 * np.abs(cascade.position_mm - demand).max()


def compute_largest_error(structure: str = "p_pi_pi", **regulators: Any) -> float:
    """Return the largest following error of the bench path's Y axis in um."""
    demand = build_bench_demand(10)[:, 1]
    response = simulate_nominal(build_bench_axis(structure, **regulators).axis["Y"], demand)
    return float(np.abs(response.position_mm - demand).max()) * 1e3


def test_options_change_following_error_as_intended() -> None:
    """Torque feed-forward and a position integral reduce errors; filters increase them."""
    plain = compute_largest_error()
    assert compute_largest_error(torque_feedforward=1.0) < 0.5 * plain
    assert compute_largest_error(setpoint_filter_order=2) == plain
    assert (
        2 * plain
        < compute_largest_error(setpoint_filter_s=0.002)
        < compute_largest_error(setpoint_filter_s=0.002, setpoint_filter_order=2)
    )
    assert compute_largest_error(current_delay_cycles=4) != plain
    assert compute_largest_error("double_pi", speed_feedforward=0.0, position_ki_per_s2=400.0) < compute_largest_error(
        speed_feedforward=0.0
    )


@pytest.mark.parametrize(
    ("structure", "more", "advice"),
    [
        ("p_pi_pi", {"position_ki_per_s2": 10.0}, "double_pi"),
        ("double_pi", {"position_ki_per_s2": 0.0}, "needs position_ki_per_s2"),
        ("pid", {"speed_ki": 10.0}, "no speed_ki"),
    ],
)
def test_structure_refuses_unsupported_options(structure: str, more: dict[str, float], advice: str) -> None:
    """Otherwise the option would be ignored silently, or change the structure."""
    with pytest.raises(ConfigError, match=advice):
        build_bench_axis(structure, **more)


@pytest.mark.parametrize("option", ["plain", "torque", "second order", "all"])
@pytest.mark.parametrize("structure", tables.REGULATORS)
def test_inverse_works_for_every_structure(structure: str, option: str) -> None:
    """Its linear part and its standstill state come from simulated impulses, for any regulators.

    The gain is smallest where a position integral works against an incomplete feed-forward.
    """
    config = build_bench_axis(structure, **OPTIONS[option])
    correction = plan_correction(build_bench_trajectory(10), build_nominal_models(config), config, "inverse")
    assert correction.refused == ()
    gain = compute_rms(correction.before.contour_um) / compute_rms(correction.after.contour_um)
    assert gain > (3 if structure in ("double_pi", "linuxcnc_pid") and option == "all" else 10)


def test_flatness_does_not_duplicate_torque_feedforward() -> None:
    """A drive with its own torque feed-forward gets no second one."""
    config = build_bench_axis("p_pi_pi", **OPTIONS["torque"])
    correction = plan_correction(build_bench_trajectory(10), build_nominal_models(config), config, "flatness")
    assert correction.refused == ()
    assert compute_rms(correction.before.contour_um) > 5 * compute_rms(correction.after.contour_um)
