"""Corrects current readings to means where a drive feeds forward a speed that steps at every SYNC.

Such a speed set-point is a staircase half a cycle late, and the current responds to each step after it was read. The
difference between reading and mean follows from a simulation of the speed loop on the staircase.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification.demand_lead import align_demand_to_drive
from fdhil.identification.filtering import compute_moving_mean
from fdhil.identification.low_rate_voltage.within_sample import STEPPED_ROW_S
from fdhil.identification.rapid_windows import fill_forward, interpolate_gaps
from fdhil.identification.speed_alignment import align_speed_to_samples
from fdhil.model import simulate_axis
from fdhil.records import Float, Parameters, Window, compute_rms, make_read_only_view

SURELY = 0.6  # of the other replay's residual: largest of the right one
SAME_GRID = 1e-3  # of a sample: tolerance of the set-points' cycle
LEAST_ROWS = 50
LEFT_OPEN = 0.2  # of what known loops determine: they are known to about a tenth
SMOOTHING_S = 0.005
SETTLED, LEAST_CYCLES = 8.0, 16  # time constants of the speed loop, and cycles, until the cycles repeat


def correct_current_to_means(
    windows: Sequence[Window], settings: Identification, axis: Axis | None, sync_period_s: float | None
) -> Sequence[Window]:
    """Return the windows of one drive with mean currents, where a replay of the ``axis``' loops shows a stepping speed.

    The first window decides for all. Where the replay without steps is far better, readings serve as means. Where no
    loops are known, or the replay is inconclusive, the windows are returned unchanged.
    """
    if axis is None or not windows or windows[0].slow_voltage is not None or windows[0].current_off_a is not None:
        return windows
    plain, stepped = _compare_replays_mm(windows[0], settings, axis, sync_period_s)
    if plain < SURELY * stepped and windows[0].dt_s < STEPPED_ROW_S:
        return windows  # no doubt to remove
    if plain < SURELY * stepped:
        return [replace(w, current_off_a=make_read_only_view(np.zeros(w.n))) for w in windows]
    if not stepped < SURELY * plain:
        return windows
    lag = simulate_reading_lag(axis, windows[0].dt_s)
    return [_add_reading_lag(w, lag) for w in windows]


def _compare_replays_mm(
    window: Window, settings: Identification, axis: Axis, sync_period_s: float | None
) -> tuple[float, float]:
    """Return the RMS residuals (mm) of replays without and with steps; NaN where nothing can be compared."""
    unknown = (math.nan, math.nan)
    if abs((sync_period_s or window.dt_s) / window.dt_s - 1.0) > SAME_GRID:
        return unknown
    window = align_demand_to_drive(align_speed_to_samples(window, settings.speed_source), axis, sync_period_s)[0]
    known = np.isfinite(window.demand_mm) & np.isfinite(window.position_mm)
    if np.count_nonzero(known) < LEAST_ROWS or not np.ptp(window.demand_mm[known]) > 0.0:
        return unknown
    demand, position = interpolate_gaps(window.demand_mm), interpolate_gaps(window.position_mm)
    offset = None if window.offset_mm is None else np.nan_to_num(window.offset_mm)
    model = Parameters(**axis.nominal.model_dump())
    rate = np.gradient(demand, window.dt_s) * (2 * math.pi / axis.screw_pitch_mm)
    late = -axis.regulators.speed_feedforward * window.dt_s / 2 * np.gradient(rate, window.dt_s)

    def compute_residual_mm(speed_offset: Float | None) -> float:
        moved = simulate_axis(model, axis, window.dt_s, demand, offset, speed_offset_rad_s=speed_offset).position_mm
        return compute_rms((moved - moved[0] - position + position[0])[known])

    return compute_residual_mm(None), compute_residual_mm(late)


def _add_reading_lag(window: Window, lag: float) -> Window:
    """Return the window with ``lag`` (A per rad/s^2) times its acceleration added to its current readings."""
    width = 2 * round(SMOOTHING_S / window.dt_s / 2) + 1
    beyond = lag * np.gradient(compute_moving_mean(fill_forward(window.speed_rad_s), width), window.dt_s)
    return replace(
        window,
        current_a=make_read_only_view(window.current_a + beyond),
        current_off_a=make_read_only_view(LEFT_OPEN * np.abs(lag) * beyond / lag),
    )


def simulate_reading_lag(axis: Axis, sync_period_s: float) -> float:
    """Return by how much readings at SYNC are below the mean current, A per rad/s^2 of acceleration.

    Simulates the speed and current loops on a staircase of unit acceleration until the cycles repeat. The speed loop
    uses the mean speed of its last period; the current loop is a first-order lag of L over its gain.
    """
    g, p = axis.regulators, axis.nominal
    every = max(1, round(g.speed_period_s / g.current_period_s))
    steps = max(1, round(sync_period_s / g.speed_period_s)) * every
    h, accelerating = sync_period_s / steps, p.Jt / p.K
    cycles = max(LEAST_CYCLES, math.ceil(SETTLED * accelerating / (g.speed_kp * sync_period_s)))
    share = -math.expm1(-h * g.current_kp / p.L)
    current = wanted = accelerating
    speed = turned = turned_before = 0.0
    for cycle in range(cycles):
        reading, mean = current, 0.0
        for step in range(steps):
            if step % every == 0:
                seen, turned_before = (turned - turned_before) / (every * h), turned
                wanted = accelerating + g.speed_kp * (g.speed_feedforward * cycle * sync_period_s - seen)
            before, current = current, current + share * (wanted - current)
            rise = h * (before + current) / 2 / accelerating
            turned += h * (speed + rise / 2)
            speed += rise
            mean += (before + current) / 2 / steps
    return mean - reading
