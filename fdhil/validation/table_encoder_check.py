"""Measures a move by an encoder at the table: its true error, and what of it the motor's encoder does not see."""

from __future__ import annotations

import numpy as np

from fdhil.config import Axis
from fdhil.identification import find_moving_range
from fdhil.model import simulate_axis
from fdhil.records import AtTable, Float, Parameters, Window, compute_rms

LEAST_ROWS = 20
LONGEST_MM = 1e6  # longer than any axis
STANDSTILL_S = 0.05  # before the move, in which the zero of the table's encoder is taken


def measure_table_error(
    window: Window, parameters: Parameters | None, axis: Axis | None, sync_period_s: float | None = None
) -> AtTable | None:
    """Return the table's error during a move; None without an encoder there, or if it covers little of the move.

    Its zero is the drive's at standstill before the move. With the ``axis`` the closed loop of ``parameters`` is
    simulated along the demand, which comes every ``sync_period_s``; a constant difference is removed, since friction
    holds the screw bent at standstill.
    """
    if window.table_mm is None:
        return None
    rows = np.isfinite(window.table_mm) & np.isfinite(window.demand_mm) & np.isfinite(window.position_mm)
    first, last = find_moving_range(window)
    rows[:first] = rows[last:] = False
    if np.count_nonzero(rows) < LEAST_ROWS or np.abs(window.table_mm[rows]).max() > LONGEST_MM:
        return None
    table = window.table_mm - _measure_encoder_offset(window)
    error, unseen = (1e3 * (table - other)[rows] for other in (window.demand_mm, window.position_mm))
    predicted = _predict_table_position(window, parameters, axis, sync_period_s or window.dt_s)
    left = None if predicted is None else float(np.std(1e3 * (table - predicted)[rows]))
    return AtTable(
        compute_rms(error), float(np.abs(error).max()), compute_rms(unseen), float(np.abs(unseen).max()), left
    )


def _measure_encoder_offset(window: Window) -> float:
    """Return the offset of the table's encoder from the drive's at standstill before the move, mm."""
    assert window.table_mm is not None
    apart = window.table_mm - window.position_mm
    first = find_moving_range(window)[0]
    known = apart[max(0, first - round(STANDSTILL_S / window.dt_s)) : first]
    known = known[np.isfinite(known)] if np.isfinite(known).any() else apart[np.isfinite(apart)][:1]
    return float(np.median(known))


def _predict_table_position(
    window: Window, parameters: Parameters | None, axis: Axis | None, sync_period_s: float
) -> Float | None:
    """Return the table position (n,) by the model, mm; None if model or loops are unknown."""
    complete = parameters is not None and np.isfinite(list(parameters.as_dict().values())).all()
    same_grid = abs(sync_period_s - window.dt_s) < 1e-3 * window.dt_s
    if parameters is None or axis is None or not complete or not same_grid or not np.isfinite(window.demand_mm).all():
        return None
    offset = None if window.offset_mm is None else np.nan_to_num(window.offset_mm)
    return simulate_axis(parameters, axis, sync_period_s, window.demand_mm, offset).table_mm
