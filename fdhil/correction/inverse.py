"""Plans the inverse correction: offsets that keep each table on r(t - tau), with one delay tau for all axes.

Aiming at the path, not at the clock, lets a drive that lags keep its lag: only where the axes lag by different times,
or where the lag changes, are offsets needed. The path is solved in blocks with a look-ahead, each from the final state
of the one before: memory stays constant, and the first offsets are available before the end of the path is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.correction import linear_loop
from fdhil.correction.block_solver import AxisLoop, BlockSolution, BlockState, solve_block
from fdhil.correction.correction_method import MethodPlan
from fdhil.correction.mirror import check_lag_limits, get_allowed_um
from fdhil.correction.plan_limits import PlanLimits
from fdhil.correction.stiction_hold import StictionHold
from fdhil.model import create_standstill_state, prepare_drive, run_per_axis
from fdhil.prediction import find_moving_axes
from fdhil.records import Float, Parameters, Prediction, Reason, Trajectory

BLOCK_S = 2.0
LOOK_AHEAD_S = 0.5
# a lag that needs less than this share of the largest offset is compensated; a larger one is left to the drive
SMALL_LAG_SHARE = 0.25


def compute_common_delay_s(
    speeds_mm_s: Mapping[str, float], models: Mapping[str, Parameters], config: MachineConfig
) -> tuple[float, tuple[Reason, ...]]:
    """Return tau, and ``LagTooLarge`` for axes whose own delay is too far from it for an offset.

    It is 0 if the offsets can compensate every axis' own delay at its speed, else the middle of their delays.
    """
    period = config.machine.sync_period_s
    delays = {axis: linear_loop.measure_delay_s(models[axis], config.axis[axis], period) for axis in speeds_mm_s}
    small_um = {axis: SMALL_LAG_SHARE * get_allowed_um(config, axis) for axis in delays}
    if all(abs(delay) * speeds_mm_s[axis] * 1e3 <= small_um[axis] for axis, delay in delays.items()):
        return 0.0, ()
    tau = 0.5 * (min(delays.values()) + max(delays.values()))
    needed_um = {axis: abs(delay - tau) * speeds_mm_s[axis] * 1e3 for axis, delay in delays.items()}
    return tau, check_lag_limits(needed_um, models, config)


def delay_path(path: Float, delay_rows: float) -> Float:
    """Return r(t - tau) on the rows of r, (n,): linear between rows, so every point lies on its polyline."""
    if delay_rows == 0.0:
        return path
    rows = np.arange(path.size) - delay_rows
    return np.asarray(np.interp(rows, np.arange(path.size), path))


def plan_inverse_offsets(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, _before: Prediction
) -> MethodPlan:
    """Return the offsets of the whole reference, block by block."""
    moving = find_moving_axes(reference)
    speeds = {axis: float(np.abs(np.diff(reference.position_mm[axis])).max()) / reference.dt_s for axis in moving}
    tau, refused = compute_common_delay_s(speeds, models, config)
    zero = np.zeros(reference.time_s.size)
    nothing = dict.fromkeys(reference.axes, zero)
    if refused:
        return MethodPlan(nothing, tau, refused)

    def plan_axis(axis: str) -> tuple[Float, float]:
        if axis not in moving:
            return zero, 0.0
        path = reference.position_mm[axis]
        walk = AxisInversePlanner.prepare(models[axis], config, axis, float(path[0]))
        return walk.solve_path(path, delay_path(path, tau / reference.dt_s))

    found = run_per_axis(plan_axis, reference.axes)
    refused = check_lag_limits({axis: needed for axis, (_, needed) in found.items()}, models, config)
    return MethodPlan(nothing if refused else {axis: offset for axis, (offset, _) in found.items()}, tau, refused)


@dataclass(slots=True)
class AxisInversePlanner:
    """The inverse of one axis, solved block by block; ``carry`` is the state after the last block."""

    loop: AxisLoop
    carry: BlockState

    @staticmethod
    def prepare(parameters: Parameters, config: MachineConfig, axis: str, start_mm: float) -> AxisInversePlanner:
        """Return it at rest at ``start_mm``, without an offset; ValueError if writing is off for the axis."""
        period, drive = config.machine.sync_period_s, config.axis[axis]
        limits = PlanLimits.derive(drive, period)
        loop = AxisLoop(
            parameters,
            drive,
            period,
            limits,
            prepare_drive(parameters, drive, period),
            linear_loop.invert_loop(parameters, drive, period, sum(count_block_rows(period))),
            StictionHold(parameters, drive, period, limits.um_per_increment * 1e-3),
        )
        return AxisInversePlanner(
            loop, BlockState(create_standstill_state(parameters, drive, start_mm), np.zeros(2), np.empty(0))
        )

    def solve_next_block(self, reference_mm: Float, target_mm: Float, rows: int, ends: bool) -> BlockSolution:
        """Solve the next ``rows`` with the known rows behind them, and advance.

        ``ends``: no rows follow.
        """
        loop, carry = self.loop, self.carry
        solution = solve_block(loop, reference_mm, target_mm, carry, ends)
        if not ends:
            state = loop.simulate_rows(reference_mm, solution.offset, carry.state, 0, rows).end
            self.carry = BlockState(state, solution.offset[rows : rows + 2], solution.guess[rows:])
        return solution

    def solve_path(self, reference_mm: Float, target_mm: Float) -> tuple[Float, float]:
        """Return the offsets (n,) in um of a path that is known to its end, and the largest one that it needs."""
        block, ahead = count_block_rows(self.loop.sync_period_s)
        offsets, needed, first, ends = [], 0.0, 0, False
        while not ends:
            stop = min(first + block + ahead, reference_mm.size)
            ends = stop == reference_mm.size
            rows = stop - first if ends else block
            solution = self.solve_next_block(reference_mm[first:stop], target_mm[first:stop], rows, ends)
            needed = max(needed, solution.needed_um)
            offsets.append(solution.offset[:rows])
            first += rows
        return np.concatenate(offsets) * self.loop.limits.um_per_increment, needed


def count_block_rows(sync_period_s: float) -> tuple[int, int]:
    """Return the rows of a block, and of its look-ahead."""
    return round(BLOCK_S / sync_period_s), round(LOOK_AHEAD_S / sync_period_s)
