"""Estimates by how many whole cycles a recorded set-point leads the one that the drive follows.

An NC's trace shows the NC's own set-point, some cycles before the drive's. Taken for the drive's, it yields wrong gains
and filters that do not exist.
"""

from dataclasses import replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.rapid_windows import interpolate_gaps
from fdhil.model import simulate_axis
from fdhil.records import Float, Parameters, Window, compute_rms, make_read_only_view

LEAST_FEEDFORWARD = 0.5  # with less, the lag at constant speed is the position loop's
WHOLE = 0.3  # of a cycle: tolerance of a whole lead
EXPLAINED = 0.003  # largest share of the residual that remains without the lead; more with a filter
MOST = 32  # cycles
LEAST_ROWS, SAME_GRID = 50, 1e-3


def align_demand_to_drive(window: Window, axis: Axis | None, sync_period_s: float | None) -> tuple[Window, int]:
    """Return the window with the demand that the drive follows, and the lead of the recorded one in cycles.

    The lead is estimated with the closed loop of the ``axis``' section; without a lead the window is returned with 0.
    """
    if axis is None or axis.regulators.speed_feedforward < LEAST_FEEDFORWARD:
        return window, 0
    lead, left = _estimate_lead(window, axis, sync_period_s)
    cycles = round(lead)
    if not (1 <= cycles <= MOST and abs(lead - cycles) < WHOLE):
        return window, 0
    offset = None if window.offset_mm is None else make_read_only_view(_delay_samples(window.offset_mm, cycles))
    moved = replace(window, demand_mm=make_read_only_view(_delay_samples(window.demand_mm, cycles)), offset_mm=offset)
    return (moved, cycles) if _estimate_lead(moved, axis, sync_period_s)[1] < EXPLAINED * left else (window, 0)


def _estimate_lead(window: Window, axis: Axis, sync_period_s: float | None) -> tuple[float, float]:
    """Return the lead of the demand in cycles and the RMS residual (mm) of the closed loop; 0 where unknown."""
    known = np.isfinite(window.demand_mm) & np.isfinite(window.position_mm)
    off_grid = abs((sync_period_s or window.dt_s) / window.dt_s - 1.0) > SAME_GRID
    if off_grid or np.count_nonzero(known) < LEAST_ROWS or not np.ptp(window.demand_mm[known]) > 0.0:
        return 0.0, 0.0
    demand, position = interpolate_gaps(window.demand_mm), interpolate_gaps(window.position_mm)
    offset = None if window.offset_mm is None else np.nan_to_num(window.offset_mm)
    moved = simulate_axis(Parameters(**axis.nominal.model_dump()), axis, window.dt_s, demand, offset).position_mm
    ahead = (moved - moved[0] - position + position[0])[known]
    way = np.gradient(position)[known]  # travel in a cycle
    power = float(way @ way)
    if not (power > 0.0 and np.isfinite(ahead).all()):
        return 0.0, 0.0
    return float(ahead @ way) / power, compute_rms(ahead)


def _delay_samples(values: Float, rows: int) -> Float:
    return np.concatenate([np.full(rows, values[0]), values[:-rows]])
