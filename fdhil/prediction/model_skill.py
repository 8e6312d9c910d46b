"""Assesses the skill of the closed-loop model: predicted against measured following error of one recorded move."""

from __future__ import annotations

import numpy as np

from fdhil.config import Axis
from fdhil.records import Float, Int, Parameters, Skill, Window, compute_rms
from fdhil.validation import replay_setpoints

LONGEST_DELAY = 8.0  # in SYNC cycles


def assess_model_skill(window: Window, parameters: Parameters, axis: Axis, sync_period_s: float) -> Skill | None:
    """Compare the predicted with the measured following error of a recorded move, like held-out moves in a file.

    Lost rows are not compared. ``delay_ms`` is the shift of the prediction (positive: the drive is later) that explains
    the difference best. None where the rows are not the drive's set-points, or too few can be compared.
    """
    replayed = replay_setpoints(window, parameters, axis, sync_period_s)
    if replayed is None:
        return None
    return Skill(
        axis=window.axis,
        tick=window.start_tick,
        rms_um=compute_rms(replayed.difference_um),
        max_um=float(np.abs(replayed.difference_um).max()),
        delay_ms=_estimate_delay_cycles(window.position_mm, replayed.predicted_mm, replayed.rows) * sync_period_s * 1e3,
        measured_rms_um=replayed.measured_um,
    )


def _estimate_delay_cycles(measured_mm: Float, predicted_mm: Float, rows: Int) -> float:
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
