"""Starts the search for a drive's loops without a usable configuration: a coarse grid.

In a well-tuned cascade each loop is slower than its inner loop by a factor of a few. The lag at constant speed
determines the feed-forward.
"""

import math
from dataclasses import replace
from itertools import product

import numpy as np

from fdhil.config import Axis, Nominal, Regulators
from fdhil.identification.drive_loops.loop_fit import LoopProblem, compute_loop_residuals, compute_scale
from fdhil.identification.drive_loops.loop_replay import Rapid, adjust_loop_periods, replace_regulators
from fdhil.records import Window

CASCADE = ("position_gain_per_s", "speed_feedforward", "speed_kp", "speed_ki")
CORNERS_HZ = (8.0, 16.0, 32.0, 64.0, 128.0)
SLOWER = (2.5, 5.0, 10.0)
CURRENT_CORNER_HZ = 400.0  # faster than samples of 1 ms resolve
NO_LIMIT = 1e5


def search_start_grid(problem: LoopProblem) -> LoopProblem:
    """Return the problem started at the best cascade of the grid for the longest rapid; limits and cycles stay."""
    longest = int(np.argmax([np.ptp(one.demand_mm) for one in problem.rapids]))
    rapid = problem.rapids[longest]
    plant = rapid.plant
    best, least = problem, math.inf
    for corner_hz, inner, outer in product(CORNERS_HZ, SLOWER, SLOWER):
        corner = 2 * math.pi * corner_hz
        start = replace_regulators(
            problem.axis,
            structure="p_pi_pi",
            position_gain_per_s=corner / outer,
            speed_feedforward=_estimate_feedforward(rapid, corner / outer),
            speed_kp=corner * plant.Jt / plant.K,
            speed_ki=corner * plant.Jt / plant.K * corner / inner,
            position_ki_per_s2=0.0,
            torque_feedforward=0.0,
            speed_filter_s=0.0,
            setpoint_filter_s=0.0,
            current_delay_cycles=0,
        )
        trial = LoopProblem((rapid,), start, CASCADE)
        residuals, _ = compute_loop_residuals(trial, trial.read_coordinates())
        cost = float(np.log(compute_scale(trial, residuals)).sum())
        if cost < least:
            best, least = replace(problem, axis=start, names=CASCADE), cost
    return best


def _estimate_feedforward(rapid: Rapid, gain: float) -> float:
    """Return the feed-forward share: at constant speed v the lag is v (1 - share) / Kv."""
    speed = np.gradient(rapid.demand_mm, rapid.dt_s)
    steady = np.abs(speed) > 0.95 * np.abs(speed).max()
    share = 1.0 - gain * float(np.median(rapid.lag_mm[steady] / speed[steady]))
    return float(np.clip(share, 0.0, 1.5))


def create_placeholder_axis(window: Window, rapid: Rapid) -> Axis:
    """Return an axis for a recording alone: a fast current loop, no limits, cycles that divide a sample."""
    plant, current = rapid.plant, 2 * math.pi * CURRENT_CORNER_HZ
    regulators = Regulators(
        position_gain_per_s=1.0,
        speed_kp=1.0,
        speed_ki=1.0,
        current_limit_a=NO_LIMIT,
        current_kp=current * plant.L,
        current_ki=current * plant.R,
        voltage_limit_v=NO_LIMIT,
    )
    speed_mm_s = window.rapid_speed_rad_s * window.pitch_mm / (2 * math.pi)
    axis = Axis(
        screw_pitch_mm=window.pitch_mm,
        rapid_speed_mm_s=speed_mm_s,
        max_acceleration_mm_s2=10.0 * speed_mm_s,
        nominal=Nominal(**{name: max(value, 0.0) for name, value in plant.as_dict().items()}),
        regulators=regulators,
    )
    return replace_regulators(axis, **adjust_loop_periods(regulators, rapid.dt_s))
