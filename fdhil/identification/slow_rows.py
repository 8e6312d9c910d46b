"""Tells what is not known of voltage and current within rows that are longer than a current regulator needs.

* A current that runs straight from reading to reading has, by [1], a voltage that rises over a row by R times the
  current's change and by L times the change of its slope, beside the back-EMF's. So it is where set-points are smooth;
  where they have a kink at every row, the current is ahead of that. All of the rise is one standard deviation.
* Where the speed that is fed forward steps at every SYNC, the current answers after the instant of its reading: its
  mean is higher while the table accelerates, and inertia seems smaller (5 % in rows of 1 ms, 17 % in rows of 2 ms).
* Where a drive draws straight lines between set-points, an accelerating table is ahead of the line between two of them,
  by a T^2 / 8 in the middle, and the regulators answer that anew in every row: readings at the rows' ends are off the
  mean of the current by a share of the accelerating one that grows with the square of the row.

Which it is depends on the drive, and is the same in all of its windows. Where the loops are known, the closed loop run
along the demand tells it: the mean of a row's current is what [2] needs for the speeds at its ends.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.kalman import CD, FT, JT, LOAD, VOLTAGE, K, L, R
from fdhil.identification.motion import Course, Motion, Within
from fdhil.identification.windows import RUN_SHARE
from fdhil.model.closed_loop import simulate
from fdhil.records import PARAMETERS, Float, Parameters, Window, rms

LEAST_ROW_S = 0.003  # in shorter rows the first two are less than a regulator's own doing
ROW_S, OFF_MEAN = 0.010, 0.08  # at such rows, with a speed loop of 40 Hz; a slower loop answers less
STEPPED_ROW_S, STEPPED = 0.0015, 0.08  # from such rows on, of the accelerating current, where set-points may step


LEFT_OPEN = 0.2  # of what known loops tell: they are known to a tenth or so
SAME_GRID = 1e-3  # of a row, by which it may differ from the cycle of the set-points


def with_open_course(motion: Motion, theta: Float, off_a: Float | None = None) -> Motion:
    """Return the motion with what is open within its rows for ``theta`` (k,), where they are long and means.

    Where set-points step is a doubt, unless ``off_a`` (n,) says how far readings of the current may be from its means.
    """
    if motion.voltage_sampling != "interval_mean" or motion.slow is not None:
        return motion
    accelerating = theta[JT] / theta[K] * np.gradient(motion.speed, motion.dt_s)
    still = np.zeros(motion.n)
    if motion.dt_s < LEAST_ROW_S:
        if off_a is None:
            off_a = (STEPPED if motion.dt_s >= STEPPED_ROW_S else 0.0) * accelerating
        return replace(motion, within=Within(still[None], off_a[None])) if off_a.any() else motion
    slope = np.gradient(motion.current, motion.dt_s)
    rise = theta[R] * np.diff(motion.current, append=motion.current[-1]) + theta[L] * np.diff(slope, append=slope[-1])
    off = OFF_MEAN * (motion.dt_s / ROW_S) ** 2 * accelerating
    steps = STEPPED * accelerating if off_a is None else off_a
    off = np.where(np.abs(steps) > np.abs(off), steps, off)
    return replace(motion, within=Within(np.stack([rise, still]), np.stack([still, off])))


def leaves_steps_open(window: Window) -> bool:
    """Return whether what is open in a window's rows is its set-points' steps alone: the same in all of a drive's."""
    means = window.voltage_sampling == "interval_mean" and window.slow_voltage is None
    return means and (window.current_off_a is not None or window.dt_s >= STEPPED_ROW_S) and window.dt_s < LEAST_ROW_S


def with_known_course(motion: Motion, theta: Float, axis: Axis, demand_mm: Float) -> Motion:
    """Return the motion with what the ``axis``' loops, run along the demand (n,), do within its rows.

    A row's current beyond the straight line between readings pulls the shaft, and its drop over R is no part of the
    voltage that changes the current.
    """
    beyond = beyond_line_a(theta, axis, demand_mm, motion.dt_s)
    pulls = Course("pull", LOAD, -theta[K] * beyond)
    drops = Course("drop", VOLTAGE, -theta[R] * beyond)
    at_rows = (beyond + np.concatenate([beyond[:1], beyond[:-1]])) / 2
    still = np.zeros(motion.n)
    open_rise = with_open_course(motion, theta).within
    assert open_rise is not None
    left = Within(np.stack([open_rise.rise_v[0], still]), np.stack([still, LEFT_OPEN * at_rows]))
    return replace(motion, known=(pulls, drops), within=left)


def beyond_line_a(theta: Float, axis: Axis, demand_mm: Float, row_s: float) -> Float:
    """Return by how much the mean current of each row (n,) is above that of its ends; 0 where friction is not known."""
    p = _moving_parameters(theta)
    response = simulate(p, axis, row_s, demand_mm)
    speed, current = response.speed_rad_s, response.current_a
    mean = (speed[1:] + speed[:-1]) / 2
    torque = p.Jt * np.diff(speed) / row_s + p.ft * mean + p.Cd * np.sign(mean)
    slow = np.minimum(np.abs(speed[1:]), np.abs(speed[:-1])) < RUN_SHARE * float(np.abs(speed).max())
    beyond = np.where(slow, 0.0, torque / p.K - (current[1:] + current[:-1]) / 2)
    return np.append(beyond, 0.0)


def left_at_the_table_mm(theta: Float, axis: Axis, window: Window) -> float:
    """Return the RMS by which the closed loop with ``theta`` (k,) misses the measured place."""
    response = simulate(_moving_parameters(theta), axis, window.dt_s, window.demand_mm)
    return rms(window.position_mm - response.position_mm)


def _moving_parameters(theta: Float) -> Parameters:
    friction = {"ft": max(float(theta[FT]), 0.0), "Cd": max(float(theta[CD]), 0.0)}
    return Parameters.of({**dict(zip(PARAMETERS, theta, strict=False)), **friction})


def told_by_loops(motion: Motion, sync_period_s: float | None) -> bool:
    """Return whether loops tell what happens within these rows: they are long, and one set-point is one row."""
    grid = sync_period_s if sync_period_s is not None else motion.dt_s
    long = motion.within is not None and motion.dt_s >= LEAST_ROW_S
    return long and abs(grid - motion.dt_s) < SAME_GRID * motion.dt_s
