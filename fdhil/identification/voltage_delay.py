"""Estimates the delay of the voltage against current and speed: whole samples from [1], fractions from innovations."""

from dataclasses import replace

import numpy as np

from fdhil.identification.candidate_terms import WHOLE_DEAD_TIME
from fdhil.identification.derivatives import differentiate_signal
from fdhil.identification.estimators.least_squares import AlignedSignals
from fdhil.identification.kalman import DELAY
from fdhil.identification.likelihood_fit import LikelihoodFit, compute_jacobian, estimate_typical_sizes
from fdhil.identification.normal_equations import invert_gram, solve_least_squares
from fdhil.records import Float

SPAN_S = 0.025
# factors by which the residual power must fall before a delay of whole samples is accepted: a voltage is never early,
# but unmodelled effects of inverter and winding look like it
LATER, EARLIER = 1.5, 9.0
MOST_DELAY = 2.5  # samples, two with rounding: a longer delay would be one of whole samples
LEAST_DELAY = 0.05  # of a sample; a smaller delay cannot be distinguished from the voltage's waveform
CHANCE = 2.0  # standard deviations of a delay due to chance


def estimate_coarse_delay(signals: AlignedSignals, dt_s: float) -> float:
    """Return the delay of the voltage in s, in whole samples (negative: early); 0 unless it is significant.

    [5], with a term for the inverter's dead time, is fitted with the voltage shifted by each number of samples; the
    best fit wins. Delays up to ``MOST_DELAY`` are left to the maximum-likelihood fit, because other effects resemble
    them.
    """
    reach = min(max(3, round(SPAN_S / dt_s)), signals.speed.size // 8)
    slope = differentiate_signal(signals.current, dt_s)
    inside = slice(reach, signals.speed.size - reach)
    kept = (signals.usable & np.isfinite(slope))[inside]
    if np.count_nonzero(kept) < 32:
        return 0.0
    lost = np.clip(signals.current / (WHOLE_DEAD_TIME * float(np.abs(signals.current).max())), -1.0, 1.0)
    phi = np.where(kept, np.stack([slope, signals.current, signals.speed, lost])[:, inside], 0.0)
    inverse, _ = invert_gram(phi.T)
    shifts = np.arange(-reach, reach + 1)
    pulls = np.stack([np.correlate(signals.voltage, column, "valid") for column in phi])
    power = np.correlate(signals.voltage**2, kept.astype(np.float64), "valid")
    costs = power - (pulls * (inverse @ pulls)).sum(axis=0)
    best = int(np.argmin(costs))
    near = costs[np.abs(shifts) <= MOST_DELAY].min()
    if not np.isfinite(costs).all() or near <= (LATER if best > reach else EARLIER) * max(costs[best], 0.0):
        return 0.0
    return float(shifts[best]) * dt_s


def score_delay(plain: LikelihoodFit) -> tuple[float, float]:
    """Return the delay (s) that one Newton step would add to a fit without delay, and its standard deviation."""
    d = differentiate_by_delay(plain)
    rest = d - plain.jacobian_without_delay @ solve_least_squares(plain.jacobian_without_delay, d)[0]
    weight = float(rest @ rest)
    return (float(rest @ plain.residuals) / weight, weight**-0.5) if weight > 0 else (0.0, np.inf)


def differentiate_by_delay(result: LikelihoodFit) -> Float:
    """Return minus the derivative (m,) of the innovations by the delay."""
    if DELAY in result.free:
        return result.jacobian[:, result.free.index(DELAY)]
    sizes = estimate_typical_sizes(result.theta, result.problem.motions)
    return compute_jacobian(result.problem, result.theta, result.residuals, [DELAY], sizes)[:, 0]


def add_delay_doubt(fitted: LikelihoodFit) -> LikelihoodFit:
    """Return the fit with its doubt about a delay of the voltage.

    Regulators act several times within a sample. That resembles a delay of a few per cent of it, but shifts L
    differently. A small delay is therefore not corrected: its effect counts as a doubt, and likewise the uncertainty of
    a larger one.
    """
    if DELAY in fitted.free:
        return replace(fitted, delay_doubt_s=LEAST_DELAY / 2 * min(m.dt_s for m in fitted.problem.motions))
    if not (fitted.converged and np.isfinite(fitted.residuals).all()):
        return fitted
    delay, std = score_delay(fitted)
    return replace(fitted, delay_doubt_s=float(np.sqrt(max(0.0, delay**2 - (CHANCE * std) ** 2))))
