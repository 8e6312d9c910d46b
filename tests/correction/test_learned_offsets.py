"""Iterative learning on a plant with effects that the model lacks, measured by its motor's encoder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import MachineConfig
from fdhil.correction.correction_planner import plan_correction
from fdhil.correction.learned_offsets import MOST_SHARE, LearnedOffset, learn_from_pass
from fdhil.correction.plan_limits import fit_all_axes
from fdhil.prediction import compute_contour_error_um
from fdhil.records import Float, Parameters, Trajectory, compute_rms
from studies.real_plant import Loops, Mechanics, compute_rest_state, simulate_axis
from tests.bench import bench_config
from tests.paths import build_bench_trajectory

pytestmark = pytest.mark.usefixtures("long_computation")

INCREMENT_MM = 20.0 / 65536
REAL = Mechanics(static=0.2, asymmetry=0.05, screw_ripple=0.05, motor_ripple_nm=0.4, load_nm=2.0)


def simulate_pass(
    mechanics: Mechanics, loops: Loops, reference: Trajectory, offset_um: Mapping[str, Float]
) -> dict[str, Float]:
    found = {}
    for axis, path in reference.position_mm.items():
        begin = compute_rest_state(mechanics, loops, float(path[0]) * 1e-3)
        moved = simulate_axis(mechanics, (path + offset_um[axis] * 1e-3) * 1e-3, loops, start=begin)
        found[axis] = np.round(moved.motor_m * 1e3 / INCREMENT_MM) * INCREMENT_MM
    return found


def run_passes(count: int, loops: Loops, wear: float = 0.0, disturbed: int = -1) -> tuple[list[float], list[float]]:
    """Return the RMS (um) of each pass with learning, and of the model alone on the same machine at that pass."""
    config, reference = bench_config(), build_bench_trajectory(10)
    models = dict.fromkeys(reference.axes, Parameters.from_mapping(REAL.truth()).replace_values(Cd=5.2))
    offset = plan_correction(reference, models, config).offset_um
    offsets, mechanics = LearnedOffset.make_empty(reference), REAL
    learned, alone = [], []
    for number in range(count):
        if number == disturbed:
            offsets = replace(offsets, offset_um={axis: u + 20.0 for axis, u in offsets.offset_um.items()})
        rough = {axis: offset[axis] + offsets.offset_um[axis] for axis in reference.axes}
        at = simulate_pass(mechanics, loops, reference, fit_all_axes(rough, config.axis, reference.dt_s))
        learned.append(compute_residual_um(reference, at))
        alone.append(compute_residual_um(reference, simulate_pass(mechanics, loops, reference, offset)))
        error_um = {axis: (reference.position_mm[axis] - at[axis]) * 1e3 for axis in reference.axes}
        offsets = learn_from_pass(offsets, error_um, learned[-1], models, config)
        make_bounded_config(offsets, config)
        mechanics = replace(mechanics, Cd=mechanics.Cd * (1 - wear))
    return learned, alone


def compute_residual_um(reference: Trajectory, at: Mapping[str, Float]) -> float:
    return compute_rms(compute_contour_error_um(reference.path_mm, np.column_stack(list(at.values())), reference.dt_s))


def make_bounded_config(learned: LearnedOffset, config: MachineConfig) -> None:
    for axis, offset in learned.offset_um.items():
        limits = config.axis[axis].correction
        assert limits is not None
        assert float(np.abs(offset).max()) <= MOST_SHARE * limits.max_offset_um


@pytest.mark.parametrize("loops", [Loops(), Loops(speed_filter_s=0.001)], ids=["as configured", "unknown filter"])
def test_three_passes_reduce_error_to_a_third(loops: Loops) -> None:
    learned, alone = run_passes(4, loops)
    assert learned[0] == pytest.approx(alone[0])
    assert learned[3] * 3 <= alone[3], (learned, alone)
    assert all(now <= 1.02 * then for now, then in zip(learned, alone, strict=True)), (learned, alone)


def test_drifting_friction_is_tracked() -> None:
    learned, alone = run_passes(5, Loops(), wear=0.03)
    assert all(now <= 1.02 * then for now, then in zip(learned, alone, strict=True)), (learned, alone)
    assert learned[4] * 2 <= alone[4], (learned, alone)


def test_worse_pass_discards_learned_offset() -> None:
    learned, alone = run_passes(5, Loops(), disturbed=2)
    assert learned[2] > alone[2], "the disturbance does not disturb"
    assert learned[3] == pytest.approx(alone[3], rel=0.01)
    assert learned[4] < alone[4]
