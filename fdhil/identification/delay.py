"""The delay of the voltage against current and speed, in whole samples, from the electrical equation alone."""

from __future__ import annotations

import numpy as np

from fdhil.identification.derivatives import derivative
from fdhil.identification.estimators.least_squares import Signals
from fdhil.identification.normal import inverse_gram

SPAN_S = 0.025
IMPROVEMENT = 1.5  # the residual's power must fall by this factor before another whole sample is believed


def coarse_delay(signals: Signals, dt_s: float) -> float:
    """Return by how many seconds, in whole samples, the voltage is late (early: negative); 0 unless it surely is.

    [5] is fitted with the voltage moved by each number of samples; the best fit tells. Finer than a sample is the
    business of the maximum-likelihood fit that starts here.
    """
    reach = min(max(3, round(SPAN_S / dt_s)), signals.speed.size // 8)
    rows = np.flatnonzero(signals.usable & np.isfinite(derivative(signals.current, dt_s)))
    rows = rows[(rows >= reach) & (rows < signals.speed.size - reach)]
    if rows.size < 32:
        return 0.0
    slope = derivative(signals.current, dt_s)
    phi = np.column_stack([slope, signals.current, signals.speed])[rows]
    inverse, _ = inverse_gram(phi)
    shifts = np.arange(-reach, reach + 1)
    costs = np.empty(shifts.size)
    for k, shift in enumerate(shifts):
        u = signals.voltage[rows + shift]
        pull = phi.T @ u
        costs[k] = u @ u - pull @ inverse @ pull
    best = int(np.argmin(costs))
    if not np.isfinite(costs).all() or costs[reach] <= IMPROVEMENT * max(costs[best], 0.0) or abs(shifts[best]) < 1:
        return 0.0
    return float(shifts[best]) * dt_s
