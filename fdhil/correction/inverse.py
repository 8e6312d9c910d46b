"""Inverse correction: offsets that keep each table on r(t - tau), with one delay tau for all axes.

Aiming at the path, not at the clock, lets a drive that lags keep its lag: only where the axes lag by different times,
or where the lag changes, are offsets needed. The path is worked through in blocks with a look-ahead, each from the
state that the block before it left: memory stays flat, and the first offsets are there before the path is known to its
end.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fdhil.config import MachineConfig
from fdhil.correction import linear
from fdhil.correction.block import AxisLoop, Carry, Solution, solve
from fdhil.correction.limits import PlanLimits
from fdhil.correction.method import Plan
from fdhil.correction.mirror import lag_reason
from fdhil.correction.resting import Resting
from fdhil.model import closed_loop
from fdhil.model.closed_loop import Commands
from fdhil.records import Float, Parameters, Prediction, Reason, Trajectory

BLOCK_S = 2.0
LOOK_AHEAD_S = 0.5
# a lag that costs less than this share of the largest offset is made up for; a larger one is left to the drive
SMALL_LAG_SHARE = 0.25


def common_delay_s(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig
) -> tuple[float, tuple[Reason, ...]]:
    """Return tau, and ``LagTooLarge`` for axes whose own delay is so far from it that no offset may bridge it."""
    delays, speeds = {}, {}
    for axis in reference.axes:
        path = reference.position_mm[axis]
        if np.ptp(path) > 0.0:
            delays[axis] = linear.delay_s(models[axis], config.axis[axis], reference.dt_s)
            speeds[axis] = float(np.abs(np.diff(path)).max()) / reference.dt_s
    tau = choose_delay_s(delays, speeds, config)
    refused = []
    for axis, delay in delays.items() if tau else ():
        needed, room = abs(delay - tau) * speeds[axis] * 1e3, _allowed_um(config, axis)
        if needed > room:
            refused.append(lag_reason(axis, needed, room, config.axis[axis].regulators.speed_feedforward))
    return tau, tuple(refused)


def choose_delay_s(delays: Mapping[str, float], speeds_mm_s: Mapping[str, float], config: MachineConfig) -> float:
    """Return tau: 0 where the offsets can make up for every axis' own delay at its speed, else amid their delays."""
    small = (
        abs(delay) * speeds_mm_s[axis] * 1e3 <= SMALL_LAG_SHARE * _allowed_um(config, axis)
        for axis, delay in delays.items()
    )
    return 0.0 if all(small) else 0.5 * (min(delays.values()) + max(delays.values()))


def _allowed_um(config: MachineConfig, axis: str) -> float:
    limits = config.axis[axis].correction
    return limits.max_offset_um if limits is not None else 0.0


def delayed(path: Float, delay_rows: float) -> Float:
    """Return r(t - tau) on the rows of r, (n,): linear between rows, so every point lies on its polyline."""
    if delay_rows == 0.0:
        return path
    rows = np.arange(path.size) - delay_rows
    return np.asarray(np.interp(rows, np.arange(path.size), path))


def plan(reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, _before: Prediction) -> Plan:
    """Return the offsets of the whole reference, block by block."""
    tau, refused = common_delay_s(reference, models, config)
    zero = np.zeros(reference.time_s.size)
    if refused:
        return Plan(dict.fromkeys(reference.axes, zero), tau, refused)

    def one(axis: str) -> tuple[Float, float]:
        path = reference.position_mm[axis]
        if np.ptp(path) == 0.0:
            return zero, 0.0
        return solve_axis(axis_loop(models[axis], config, axis), path, delayed(path, tau / reference.dt_s))

    with ThreadPoolExecutor(max(1, len(reference.axes))) as pool:
        found = dict(zip(reference.axes, pool.map(one, reference.axes), strict=True))
    refused = tuple(
        lag_reason(axis, needed, _allowed_um(config, axis), config.axis[axis].regulators.speed_feedforward)
        for axis, (_, needed) in found.items()
        if needed > _allowed_um(config, axis)
    )
    if refused:
        return Plan(dict.fromkeys(reference.axes, zero), tau, refused)
    return Plan({axis: offset for axis, (offset, _) in found.items()}, tau)


def axis_loop(parameters: Parameters, config: MachineConfig, axis: str) -> AxisLoop:
    """Return what the blocks of one axis share; ValueError when writing is off for it."""
    period = config.machine.sync_period_s
    rows = round((BLOCK_S + LOOK_AHEAD_S) / period)
    limits, drive = PlanLimits.of(config.axis[axis], period), config.axis[axis]
    return AxisLoop(
        parameters,
        drive,
        period,
        limits,
        closed_loop.prepare(parameters, drive, period),
        linear.inverse(parameters, drive, period, rows),
        Resting(parameters, drive, period, limits.um_per_increment * 1e-3),
    )


def solve_axis(loop: AxisLoop, reference_mm: Float, target_mm: Float) -> tuple[Float, float]:
    """Return the offsets (n,) in um of one axis along its whole reference, and the largest one it needs."""
    block, ahead = round(BLOCK_S / loop.sync_period_s), round(LOOK_AHEAD_S / loop.sync_period_s)
    carry = first_carry(float(reference_mm[0]))
    pieces = []
    needed = 0.0
    for start in range(0, reference_mm.size, block):
        stop = min(start + block + ahead, reference_mm.size)
        ends = stop == reference_mm.size
        solution = solve(loop, reference_mm[start:stop], target_mm[start:stop], carry, ends)
        needed = max(needed, solution.needed_um)
        pieces.append((solution.offset if ends else solution.offset[:block]) * loop.limits.um_per_increment)
        if ends:
            break
        carry = following(loop, reference_mm[start:stop], solution, carry, block)
    return np.concatenate(pieces), needed


def first_carry(position_mm: float) -> Carry:
    """Return what the first block starts from: an axis at rest on its reference, without an offset."""
    return Carry(closed_loop.start(position_mm), np.zeros(2), np.empty(0))


def following(loop: AxisLoop, reference_mm: Float, solution: Solution, carry: Carry, block: int) -> Carry:
    """Return what the block after the first ``block`` rows of this one starts from."""
    ahead = min(block + 2, reference_mm.size)
    commanded = reference_mm[:ahead] + solution.offset[:ahead] * loop.increment_mm
    head = loop.drive.run(Commands(commanded), carry.state, 0, block)
    return Carry(head.end, solution.offset[block : block + 2], solution.guess[block:])
