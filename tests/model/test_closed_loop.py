"""The closed-loop kernel against independent physics, and its own invariants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import parse_config
from fdhil.model import closed_loop, closed_loop_drive
from fdhil.records import PARAMETERS, Float, Parameters
from tests.bench import bench_config, bench_document
from tests.model.reference_drive import ReferenceDrive
from tests.paths import smooth_demand

AXIS = bench_config("X").axis["X"]
NOMINAL = Parameters(**AXIS.nominal.model_dump())
PERIOD = 0.001


def build_random_demand(seed: int, n: int = 450) -> Float:
    """Return moves, reversals and rests, smoothed as by an NC; within the limits."""
    random = np.random.default_rng(seed)
    speeds = np.repeat(random.choice([0.0, 1.0, -1.0], 10) * random.uniform(0, 90, 10), n // 10 + 1)[:n]
    speeds[-110:] = 0.0
    path = random.uniform(-5, 5) + np.cumsum(speeds) * PERIOD
    return smooth_demand(path[:, None], (0.060, 0.030), PERIOD)[:, 0]


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("seed", range(6))
def test_closed_loop_matches_independent_physics(seed: int) -> None:
    """Within 0.6 um of a drive with quantisation (dry friction keeps the rounding), 0.02 um of one without."""
    random = np.random.default_rng(100 + seed)
    scaled = [v * random.uniform(0.85, 1.15) for v in NOMINAL.as_dict().values()]
    parameters = Parameters.from_mapping(dict(zip(PARAMETERS, scaled, strict=True)))
    demand = build_random_demand(seed)
    response = closed_loop.simulate_axis(parameters, AXIS, PERIOD, demand)
    assert response.limited_s == 0.0
    fine = ReferenceDrive(parameters, AXIS, PERIOD, increments=65536 << 20).follow_demand(demand.tolist())
    assert np.abs(response.position_mm - fine).max() < 0.02e-3
    coarse = ReferenceDrive(parameters, AXIS, PERIOD).follow_demand(demand.tolist())
    assert np.abs(response.position_mm - coarse).max() < 0.6e-3
    assert np.sqrt(np.mean((response.position_mm - coarse) ** 2)) < 0.2e-3


def test_closed_loop_matches_while_limit_acts() -> None:
    """A step of the demand drives current and voltage into their limits."""
    demand = np.concatenate([np.zeros(5), np.full(250, 12.0)])
    response = closed_loop.simulate_axis(NOMINAL, AXIS, PERIOD, demand)
    assert response.limited_s > 0.005
    slow = ReferenceDrive(NOMINAL, AXIS, PERIOD, increments=65536 << 20).follow_demand(demand.tolist())
    assert np.abs(response.position_mm - slow).max() < 5e-3


def test_axis_starts_at_rest_and_follows_to_rest() -> None:
    """After the hold the table is at the reference within the band of dry friction."""
    demand = build_random_demand(3)
    response = closed_loop.simulate_axis(NOMINAL, AXIS, PERIOD, demand)
    assert response.position_mm[0] == demand[0]
    assert response.speed_rad_s[0] == response.current_a[0] == 0.0
    assert abs(response.position_mm[-1] - demand[-1]) < 0.05


def test_continued_run_is_bit_identical() -> None:
    demand = build_random_demand(4)
    whole = closed_loop.simulate_axis(NOMINAL, AXIS, PERIOD, demand)
    head = closed_loop.simulate_axis(NOMINAL, AXIS, PERIOD, demand, rows=200)
    tail = closed_loop.simulate_axis(NOMINAL, AXIS, PERIOD, demand, state=head.end, first=200)
    assert np.array_equal(np.concatenate([head.position_mm, tail.position_mm]), whole.position_mm)
    assert np.array_equal(tail.end, whole.end)


def test_offset_enters_feedforward() -> None:
    """The corrected path is the simulation of r + o."""
    demand = build_random_demand(5)
    offset = smooth_demand(np.random.default_rng(5).normal(0, 0.2, (demand.size, 1)), (0.05, 0.03), PERIOD)[:, 0]
    offset -= offset[0]
    together = closed_loop.simulate_axis(NOMINAL, AXIS, PERIOD, demand, offset)
    summed = closed_loop.simulate_axis(NOMINAL, AXIS, PERIOD, demand + offset)
    assert np.allclose(together.position_mm, summed.position_mm, atol=1e-9)


def test_parallel_axes_are_bit_identical() -> None:
    config = bench_config("XY")
    demands = {"X": build_random_demand(6), "Y": build_random_demand(7)}
    models = {"X": NOMINAL, "Y": Parameters(0.5, 0.005, 0.8, 0.085, 0.01, 1.0)}
    both = closed_loop.simulate_axes(models, config.axis, PERIOD, demands)
    for axis, demand in demands.items():
        alone = closed_loop.simulate_axis(models[axis], config.axis[axis], PERIOD, demand)
        assert np.array_equal(both[axis].position_mm, alone.position_mm)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("structure", ["p_pi_pi", "double_pi"])
def test_multi_cycle_steps_match_single_steps(structure: str, seed: int) -> None:
    """For moving, held, reversing, limited and frictionless cycles."""
    random = np.random.default_rng(seed)
    demand = build_random_demand(seed) + (np.arange(450) > 300) * random.choice([0.0, 3.0])  # a jump clips
    document = bench_document("X")
    document["axis"]["X"]["regulators"] |= {
        "structure": structure,
        "position_ki_per_s2": 200.0 * (structure == "double_pi"),
        "speed_filter_s": 0.0005 * (seed in (1, 4, 5)),
        "setpoint_filter_s": 0.001 * (seed in (2, 4, 6)),
        "torque_feedforward": 0.5 * (seed in (2, 3, 4)),
    }
    axis = parse_config(document).axis["X"]
    model = replace(NOMINAL, Cd=0.0 if seed == 7 else NOMINAL.Cd, Jt=NOMINAL.Jt * random.uniform(0.7, 1.4))
    drive = closed_loop.prepare_drive(model, axis, PERIOD)
    assert isinstance(drive, closed_loop_drive.DriveModel)
    stepping = replace(drive, leap=np.empty((0, drive.leap.shape[1])))
    commands = closed_loop.Commands(demand)
    one, other = (d.run(commands, closed_loop.create_zero_state(demand[0])) for d in (drive, stepping))
    # without friction the first step from rest counts as held when it is taken alone
    apart = 1.0 if model.Cd else 100.0
    assert np.abs(one.position_mm - other.position_mm).max() < 1e-9 * apart
    assert np.abs(one.current_a - other.current_a).max() < 1e-6 * apart
    assert np.array_equal(one.limited, other.limited)
    assert np.allclose(one.end, other.end, atol=1e-6 * apart)


@pytest.mark.parametrize("demand", [[], [0.0, np.nan], [[0.0, 1.0]], [0.0, np.inf]])
def test_invalid_reference_is_refused(demand: list[float]) -> None:
    """For an empty, two-dimensional or non-finite reference."""
    with pytest.raises(ValueError, match="finite positions"):
        closed_loop.simulate_axis(NOMINAL, AXIS, PERIOD, np.array(demand))
