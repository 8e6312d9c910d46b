"""Finds the delay of the voltage against current and speed, in whole samples, from the electrical equation alone."""

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
    slope = derivative(signals.current, dt_s)
    inside = slice(reach, signals.speed.size - reach)
    kept = (signals.usable & np.isfinite(slope))[inside]
    if np.count_nonzero(kept) < 32:
        return 0.0
    phi = np.where(kept, np.stack([slope, signals.current, signals.speed])[:, inside], 0.0)
    inverse, _ = inverse_gram(phi.T)
    shifts = np.arange(-reach, reach + 1)
    pulls = np.stack([np.correlate(signals.voltage, column, "valid") for column in phi])
    power = np.correlate(signals.voltage**2, kept.astype(np.float64), "valid")
    costs = power - (pulls * (inverse @ pulls)).sum(axis=0)
    best = int(np.argmin(costs))
    if not np.isfinite(costs).all() or costs[reach] <= IMPROVEMENT * max(costs[best], 0.0) or abs(shifts[best]) < 1:
        return 0.0
    return float(shifts[best]) * dt_s
