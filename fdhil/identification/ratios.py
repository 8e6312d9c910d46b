"""Without voltage [5] cannot be fitted, and K stays open; [6] alone still gives Jt/K, ft/K and Cd/K."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fdhil.config import Identification
from fdhil.identification.covariance import coloured_meat
from fdhil.identification.derivatives import derivative
from fdhil.identification.estimators.least_squares import mechanical_signals
from fdhil.identification.filtering import impulse_response
from fdhil.identification.identifiability import empty_estimate
from fdhil.identification.motion import noise_levels
from fdhil.identification.normal import inverse_gram
from fdhil.records import PARAMETERS, RATIOS, Estimate, Float, Reason, Result, Window

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
    covariance = inverse @ _meat(phi, residual, theta, [p.shape[0] for p in parts], windows, settings) @ inverse
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


def _meat(
    phi: Float, residual: Float, theta: Float, lengths: list[int], windows: Sequence[Window], settings: Identification
) -> Float:
    """Return the covariance (3, 3) of the scores; the residual is the noise of current and speed, filtered."""
    dt = windows[0].dt_s
    impulse = impulse_response(settings.lowpass_hz, dt)
    slope = np.nan_to_num(derivative(impulse, dt))
    noise = np.mean([noise_levels(w).vector() ** 2 for w in windows], axis=0)
    from_speed = theta[0] * slope + theta[1] * impulse
    gamma = noise[1] * np.correlate(impulse, impulse, "full") + noise[2] * np.correlate(from_speed, from_speed, "full")
    excess = max(1.0, float(np.mean(residual**2)) / float(gamma.max()))
    return coloured_meat([phi], [[gamma * excess]], lengths)
