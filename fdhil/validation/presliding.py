"""Fits the distance over which dry friction builds up (presliding) to the replays of a drive's recorded moves.

The following error shows it around each start, stop and reversal: friction that acts at once holds the table until it
breaks loose, friction that builds up lets it creep. Nothing else of the model is changed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.config import Axis
from fdhil.records import Estimate, Float, Window, frozen
from fdhil.validation.replay import replay_setpoints

TERM = "presliding_um"
TRIALS_UM = (1.0, 2.5, 6.0, 15.0, 40.0)
MOST_WINDOWS = 4  # the newest: each has a start and a stop
LEAST_SHARE = 0.1  # of the residual's square that the term must explain
LEAST_UM = 0.05  # RMS that it must explain
INDEPENDENT_S = 0.025  # over which the residual of a position loop is correlated
STEP = 0.35  # of the logarithm, for the curvature


def with_presliding(estimate: Estimate, windows: Sequence[Window], axis: Axis, sync_period_s: float) -> Estimate:
    """Return the estimate with ``presliding_um`` if the recorded moves show it, else unchanged.

    The standard deviation is that of the replays' least squares, of samples ``INDEPENDENT_S`` apart.
    """
    chosen = list(windows)[-MOST_WINDOWS:]

    def left(um: float) -> float:
        """Return the mean square of the replays' residuals, um2; infinite where none can be run."""
        parameters = estimate.parameters()
        parameters = parameters.changed(**{TERM: um}) if um > 0.0 else parameters
        found = [replay_setpoints(window, parameters, axis, sync_period_s) for window in chosen]
        known = [each.unexplained_um**2 for each in found if each is not None]
        return float(np.mean(known)) if known else math.inf

    sharp = left(0.0)
    trials = [left(um) for um in TRIALS_UM] if math.isfinite(sharp) else []
    if not trials or not min(trials) < sharp:
        return estimate
    near = math.log(TRIALS_UM[int(np.argmin(trials))])
    from scipy.optimize import minimize_scalar  # slow to import

    reach = (near - 1.0, near + 1.0)
    found = minimize_scalar(lambda log: left(math.exp(log)), bounds=reach, method="bounded", options={"xatol": 0.05})
    best = float(found.fun)
    if sharp - best < max(LEAST_SHARE * sharp, LEAST_UM**2):
        return estimate
    value = math.exp(float(found.x))
    around = left(value * math.exp(STEP)) + left(value * math.exp(-STEP)) - 2.0 * best
    seconds = sum(window.n * window.dt_s for window in chosen)
    variance = 2.0 * best * STEP**2 / (max(around, 1e-12) * max(1.0, seconds / INDEPENDENT_S))
    return _with_term(estimate, value, value * min(math.sqrt(variance), 1.0))


def _with_term(estimate: Estimate, value: float, std: float) -> Estimate:
    n = len(estimate.names)
    covariance: Float = np.zeros((n + 1, n + 1))
    covariance[:n, :n] = estimate.covariance
    covariance[n, n] = std**2
    values, shared = frozen(np.append(estimate.values, value)), estimate.systematic
    if shared is not None:
        shared = frozen(np.vstack([shared, np.zeros((1, shared.shape[1]))]))
    names = (*estimate.names, TERM)
    return replace(estimate, names=names, values=values, covariance=frozen(covariance), systematic=shared)
