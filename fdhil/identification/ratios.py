"""Fits [6] alone where there is no voltage: K stays open, and Jt/K, ft/K and Cd/K are told."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fdhil.config import Identification
from fdhil.identification.covariance import coloured_meat, residual_gammas
from fdhil.identification.estimators.least_squares import mechanical_signals, noise_through
from fdhil.identification.identifiability import empty_estimate
from fdhil.identification.normal import inverse_gram
from fdhil.records import PARAMETERS, RATIOS, Estimate, Reason, Result, Window

METHOD = "least_squares"


def estimate_ratios(windows: Sequence[Window], settings: Identification) -> Estimate:
    """Return an estimate whose six parameters are missing and whose ``RATIOS`` are known with their covariance.

    ``names`` are those of ``PARAMETERS`` followed by ``RATIOS``.
    """
    reason = Reason("LowExcitation", "there is no voltage, so [5] gives no R, L and K", "connect the voltage sensor")
    parts = [mechanical_signals(w, settings) for w in windows]
    phi, y = np.vstack([p[:, 1:] for p in parts]), np.concatenate([p[:, 0] for p in parts])
    if y.size < 8 or not (np.isfinite(phi).all() and np.isfinite(y).all()):
        return empty_estimate(METHOD, Result.UNDER_EXCITED, reason)
    inverse, _ = inverse_gram(phi)
    theta = inverse @ (phi.T @ y)
    residual = y - phi @ theta
    # [6] divided by K: the residual is the noise of current and speed, filtered
    noise, impulse, slope = noise_through(windows, settings)
    gamma = residual_gammas(np.array([0.0, 0.0, 1.0, *theta]), impulse, slope, noise)[1][1]
    excess = max(1.0, float(np.mean(residual**2)) / float(gamma.max()))
    covariance = inverse @ coloured_meat([phi], [[gamma * excess]], [p.shape[0] for p in parts]) @ inverse
    known, k = len(RATIOS), len(PARAMETERS)
    whole = np.full((k + known, k + known), np.nan)
    whole[k:, k:] = covariance
    return Estimate(
        method=METHOD,
        names=(*PARAMETERS, *RATIOS),
        values=np.concatenate([np.full(k, np.nan), theta]),
        covariance=whole,
        residuals={"mechanical": residual},
        result=Result.UNDER_EXCITED,
        missing=dict.fromkeys(PARAMETERS, reason),
    )
