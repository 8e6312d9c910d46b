"""Judges the skill of the closed-loop model: predicted against measured following error of one recorded move."""

from __future__ import annotations

import numpy as np

from fdhil.config import Axis
from fdhil.model import closed_loop
from fdhil.records import Float, Parameters, Skill, rms

LONGEST_DELAY = 8.0  # in SYNC cycles
_EDGE = 8  # rows at either end that a shifted comparison leaves out


def skill(
    axis_name: str,
    tick: int,
    demand_mm: Float,
    position_mm: Float,
    parameters: Parameters,
    axis: Axis,
    sync_period_s: float,
    offset_mm: Float | None = None,
) -> Skill:
    """Compare the predicted with the measured following error of a move from rest, rows (n,) on the SYNC grid.

    ``demand_mm`` is r[k], what the drive follows at row k; lost rows are NaN and not compared. ``delay_ms`` is the
    shift of the prediction (positive: the drive is later) that explains the difference best. ValueError when fewer
    than 20 rows can be compared.
    """
    demand = _filled(demand_mm, "demand")
    offset = None if offset_mm is None else np.nan_to_num(offset_mm)
    start = closed_loop.start(float(_filled(position_mm, "position")[0]))
    response = closed_loop.simulate(parameters, axis, sync_period_s, demand, offset, state=start)
    rows = np.flatnonzero(np.isfinite(demand_mm) & np.isfinite(position_mm))
    rows = rows[(rows >= _EDGE) & (rows < demand.size - _EDGE)]
    if rows.size < 20:
        raise ValueError(f"a move with {rows.size} whole rows is too short to judge the model")
    difference = (position_mm - response.position_mm)[rows] * 1e3
    measured = (position_mm - demand_mm)[rows] * 1e3
    delay = _delay(position_mm, response.position_mm, rows)
    return Skill(
        axis=axis_name,
        tick=tick,
        rms_um=rms(difference),
        max_um=float(np.abs(difference).max()),
        delay_ms=delay * sync_period_s * 1e3,
        measured_rms_um=rms(measured),
    )


def _filled(values: Float, what: str) -> Float:
    """Return the values with lost rows bridged: the demand is smooth, and what it drives there is not compared."""
    good = np.isfinite(values)
    if not good.any():
        raise ValueError(f"the move has no {what}")
    rows = np.arange(values.size)
    return np.asarray(np.interp(rows, rows[good], values[good]))


def _delay(measured_mm: Float, predicted_mm: Float, rows: np.ndarray[tuple[int], np.dtype[np.int64]]) -> float:
    """Return the shift in cycles that minimises the difference: Gauss-Newton on the prediction's slope."""
    grid = np.arange(predicted_mm.size, dtype=np.float64)
    slope = np.gradient(predicted_mm)
    delay = 0.0
    for _ in range(6):
        at = rows - delay
        gap = measured_mm[rows] - np.interp(at, grid, predicted_mm)
        gain = np.interp(at, grid, slope)
        power = float(gain @ gain)
        if power <= 0.0:
            return 0.0
        delay = float(np.clip(delay - (gap @ gain) / power, -LONGEST_DELAY, LONGEST_DELAY))
    return delay
