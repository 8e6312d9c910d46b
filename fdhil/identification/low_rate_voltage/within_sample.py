"""Models what is unknown of voltage and current within samples longer than a current regulator needs.

* A current interpolated between readings requires, by [1], a voltage that rises over a sample by R times the current's
  change and by L times the change of its slope; with a kink at every sample, the current is ahead of that.
* Where the speed feed-forward steps at every SYNC, the mean current is higher than its reading while the table
  accelerates, and inertia seems smaller (5 % at 1 ms, 17 % at 2 ms).
* Where a drive interpolates set-points linearly, an accelerating table is ahead of the line by a T^2 / 8 in the middle,
  and readings deviate from the mean current by a share that grows with the square of the sample.

The case is the same in all windows of a drive; a simulation of known loops along the demand decides it.
"""

from dataclasses import replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.kalman import CD, FT, JT, LOAD, VOLTAGE, K, L, R
from fdhil.identification.prepared_motion import Motion, TermRegressor, WithinSampleDoubt
from fdhil.identification.rapid_windows import RUN_SHARE
from fdhil.model import simulate_axis
from fdhil.records import PARAMETERS, Float, Parameters, Window, compute_rms

LEAST_ROW_S = 0.003  # in shorter samples the first two are less than the regulator's own effect
ROW_S, OFF_MEAN = 0.010, 0.08  # at such samples, with a speed loop of 40 Hz; a slower loop responds less
STEPPED_ROW_S, STEPPED = (
    0.0015,
    0.08,
)  # from such samples on, share of the accelerating current where set-points may step
LEFT_OPEN = 0.2  # of what known loops determine: they are known to about a tenth
SAME_GRID = 1e-3  # of a sample: tolerance of the set-points' cycle


def add_within_sample_doubt(motion: Motion, theta: Float, off_a: Float | None = None) -> Motion:
    """Return the motion with the unknowns within its samples for ``theta`` (k,), where these are long and means.

    Stepping set-points count as a doubt, unless ``off_a`` (n,) gives the deviation of current readings from means.
    """
    if motion.voltage_sampling != "interval_mean" or motion.slow is not None:
        return motion
    accelerating = theta[JT] / theta[K] * np.gradient(motion.speed, motion.dt_s)
    still = np.zeros(motion.n)
    if motion.dt_s < LEAST_ROW_S:
        if off_a is None:
            off_a = (STEPPED if motion.dt_s >= STEPPED_ROW_S else 0.0) * accelerating
        return replace(motion, within=WithinSampleDoubt(still[None], off_a[None])) if off_a.any() else motion
    slope = np.gradient(motion.current, motion.dt_s)
    rise = theta[R] * np.diff(motion.current, append=motion.current[-1]) + theta[L] * np.diff(slope, append=slope[-1])
    off = OFF_MEAN * (motion.dt_s / ROW_S) ** 2 * accelerating
    steps = STEPPED * accelerating if off_a is None else off_a
    off = np.where(np.abs(steps) > np.abs(off), steps, off)
    return replace(motion, within=WithinSampleDoubt(np.stack([rise, still]), np.stack([still, off])))


def has_unknown_setpoint_steps(window: Window) -> bool:
    """Return whether the set-points' steps, common to all windows of a drive, are the only unknown within samples."""
    means = window.voltage_sampling == "interval_mean" and window.slow_voltage is None
    return means and (window.current_off_a is not None or window.dt_s >= STEPPED_ROW_S) and window.dt_s < LEAST_ROW_S


def add_simulated_current(motion: Motion, theta: Float, axis: Axis, demand_mm: Float) -> Motion:
    """Return the motion with the current within its samples as simulated by the ``axis``' loops along the demand (n,).

    Current beyond the straight line between readings pulls the shaft, and its drop over R does not change the current.
    """
    beyond = compute_current_above_line_a(theta, axis, demand_mm, motion.dt_s)
    pulls = TermRegressor("pull", LOAD, -theta[K] * beyond)
    drops = TermRegressor("drop", VOLTAGE, -theta[R] * beyond)
    at_rows = (beyond + np.concatenate([beyond[:1], beyond[:-1]])) / 2
    still = np.zeros(motion.n)
    open_rise = add_within_sample_doubt(motion, theta).within
    assert open_rise is not None
    left = WithinSampleDoubt(np.stack([open_rise.rise_v[0], still]), np.stack([still, LEFT_OPEN * at_rows]))
    return replace(motion, known=(pulls, drops), within=left)


def compute_current_above_line_a(theta: Float, axis: Axis, demand_mm: Float, row_s: float) -> Float:
    """Return by how much each sample's mean current (n,) exceeds that of its ends; 0 where friction is unknown."""
    p = _clip_friction(theta)
    response = simulate_axis(p, axis, row_s, demand_mm)
    speed, current = response.speed_rad_s, response.current_a
    mean = (speed[1:] + speed[:-1]) / 2
    torque = p.Jt * np.diff(speed) / row_s + p.ft * mean + p.Cd * np.sign(mean)
    slow = np.minimum(np.abs(speed[1:]), np.abs(speed[:-1])) < RUN_SHARE * float(np.abs(speed).max())
    beyond = np.where(slow, 0.0, torque / p.K - (current[1:] + current[:-1]) / 2)
    return np.append(beyond, 0.0)


def compute_table_residual_mm(theta: Float, axis: Axis, window: Window) -> float:
    """Return the RMS difference between measured position and the closed loop with ``theta`` (k,)."""
    response = simulate_axis(_clip_friction(theta), axis, window.dt_s, window.demand_mm)
    return compute_rms(window.position_mm - response.position_mm)


def _clip_friction(theta: Float) -> Parameters:
    friction = {"ft": max(float(theta[FT]), 0.0), "Cd": max(float(theta[CD]), 0.0)}
    return Parameters.from_mapping({**dict(zip(PARAMETERS, theta, strict=False)), **friction})


def is_determined_by_loops(motion: Motion, sync_period_s: float | None) -> bool:
    """Return whether known loops determine the signals within these samples: long ones, with one set-point each."""
    grid = sync_period_s if sync_period_s is not None else motion.dt_s
    long = motion.within is not None and motion.dt_s >= LEAST_ROW_S
    return long and abs(grid - motion.dt_s) < SAME_GRID * motion.dt_s
