"""Finds by how many whole cycles a recorded set-point is ahead of the one that the drive follows.

What an NC's trace shows is its own set-point, some cycles before the drive's. Taken for the drive's, it gives wrong
gains and filters that are not there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.loop_replay import rapid_of, replay
from fdhil.records import Float, Parameters, Window, read_only, rms

LEAST_FEEDFORWARD = 0.5  # with less, a lag at constant speed is that of the position loop
WHOLE = 0.3  # of a cycle, by which a lead may miss a whole number
EXPLAINED = 0.25  # of what was left, at most, when the lead is taken out
MOST = 32  # cycles


def with_demand_on_time(window: Window, axis: Axis | None, sync_period_s: float | None) -> tuple[Window, int]:
    """Return the window with the demand that the drive follows, and by how many cycles the recorded one is ahead.

    The closed loop of the ``axis``' section tells it; the window itself and 0 where there is no lead.
    """
    if axis is None or axis.regulators.speed_feedforward < LEAST_FEEDFORWARD:
        return window, 0
    lead, left = _lead(window, axis, sync_period_s)
    cycles = round(lead)
    if not (1 <= cycles <= MOST and abs(lead - cycles) < WHOLE):
        return window, 0
    rows = cycles * max(1, round((sync_period_s or window.dt_s) / window.dt_s))
    offset = None if window.offset_mm is None else read_only(_later(window.offset_mm, rows))
    moved = replace(window, demand_mm=read_only(_later(window.demand_mm, rows)), offset_mm=offset)
    return (moved, cycles) if _lead(moved, axis, sync_period_s)[1] < EXPLAINED * left else (window, 0)


def _lead(window: Window, axis: Axis, sync_period_s: float | None) -> tuple[float, float]:
    """Return by how many cycles the demand is ahead, and the RMS (mm) that the closed loop leaves; 0 where unknown."""
    rapid = rapid_of(window, Parameters(**axis.nominal.model_dump()), sync_period_s)
    if rapid is None:
        return 0.0, 0.0
    ahead = (replay(rapid, axis, axis.regulators.current_delay_cycles)[0] - rapid.position_mm)[rapid.known]
    way = np.gradient(rapid.position_mm)[rapid.known]  # in a cycle
    power = float(way @ way)
    if not (power > 0.0 and np.isfinite(ahead).all()):
        return 0.0, 0.0
    return float(ahead @ way) / power, rms(ahead)


def _later(values: Float, rows: int) -> Float:
    return np.concatenate([np.full(rows, values[0]), values[:-rows]])
