"""What standstill tells: sensors must read zero speed and u = R i, and friction must hold no more than it drags."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.motion import noise_levels
from fdhil.identification.windows import carried, smooth
from fdhil.records import Reason, Window
from fdhil.validation.plausibility import at_rest

ROWS = 12
SURE = 5.5
LEAST_SPEED = 0.004  # of the rapid speed
LEAST_VOLTAGE = 0.01  # of the peak voltage
HOLDING_SHARE = 1.15  # a drive at rest may hold as much as dry friction drags, and no more
LEAST_TORQUE = 0.01


def rest_faults(window: Window, fit: Fit) -> Iterator[Reason]:
    """Yield what the rows at standstill contradict."""
    rows = np.flatnonzero(at_rest(window))
    if rows.size < ROWS or window.voltage_v is None:
        return
    noise = noise_levels(window)
    speed = float(np.mean(window.speed_rad_s[rows]))
    limit = max(SURE * noise.speed_rad_s / np.sqrt(rows.size), LEAST_SPEED * window.rapid_speed_rad_s)
    if abs(speed) > limit:
        text = f"speed reads {speed:+.3g} rad/s at standstill, limit {limit:.2g}"
        yield Reason("CalibrationSuspect", text, "set the zero of the speed sensor at standstill")
    yield from _holding(window, fit, rows)


def _holding(window: Window, fit: Fit, rows: np.ndarray[tuple[int], np.dtype[np.intp]]) -> Iterator[Reason]:
    """A shaft that sticks although K i exceeds Cd has friction that the model does not have."""
    current = smooth(carried(window.current_a), window.dt_s)[rows]
    torque = abs(fit.theta[2]) * float(np.median(np.abs(current)))
    peak = abs(fit.theta[2]) * float(np.nanmax(np.abs(window.current_a)))
    spread = float(np.sqrt(np.linalg.pinv(fit.information)[5, 5]))
    limit = HOLDING_SHARE * max(fit.theta[5], 0.0) + SURE * spread + LEAST_TORQUE * peak
    if torque > limit:
        text = f"the shaft rests under {torque:.3g} N.m, though dry friction is {fit.theta[5]:.3g} N.m (Stribeck)"
        yield Reason("ValidationFailed", text, "lubricate the slide-way, or check for a clamped axis")
