"""Fits a mixed model to comparable axes, robust against one or two outliers: temperature, age, axis, noise.

Within its own sets an axis shows the effects of temperature and age independent of its level; these slopes are shared.
Between axes the same effects are separated from the axis' own deviation, which is normal with a variance estimated by
restricted maximum likelihood (REML). Both sources are combined; where neither is informative, a weak prior with its
uncertainty is used. Axes that fit badly are down-weighted; those far off get no weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.records import Float

COVARIATES = 2  # temperature in K, age in months
USUAL = np.array([0.02, 0.02])  # prior standard deviation of the relative slopes per K and per month
MOST_SETS = 10  # limit of an axis' weight: its own slope is not that of all
CHANCE = 1e-3  # least relative noise of a value
LEAST_SPREAD = 1e-9  # between axes
ROUNDS = 12
SETTLED = 1e-3  # relative change of the spread between rounds
FAR = 4.7  # deviations beyond which an axis has no weight (Tukey's biweight)


@dataclass(frozen=True, slots=True)
class MixedModelFit:
    """Result of a fit.

    ``slopes`` (2,) per K and per month with ``slope_stds`` (2,); each axis' relative deviation ``off`` (n,) from the
    value expected at its temperature and age, the standard deviations ``doubts`` (n,) of that expectation, and the
    ``spread`` of regular axes.
    """

    slopes: Float
    slope_stds: Float
    deviations: Float
    deviation_stds: Float
    spread: float


def estimate_shared_slopes(axes: Sequence[tuple[Float, Float]]) -> tuple[Float, Float]:
    """Estimate the slopes (2,) that axes share, from their own sets, and the information about them (2, 2).

    An axis is values (n,), relative to its median, and covariates (n, 2), all finite. The information allows for axes
    with different slopes and for correlated sets (a sandwich estimate over the axes).
    """
    known = [_build_normal_equations(*axis) for axis in axes if len(axis[0]) > 1]
    if not known:
        return np.zeros(COVARIATES), np.zeros((COVARIATES, COVARIATES))
    grams = np.array([gram for gram, _ in known])
    moments = np.array([moment for _, moment in known])
    prior = np.diag(USUAL**-2.0) * CHANCE**2
    scale = grams.trace(axis1=1, axis2=2)[:, None, None] * 1e-6 * np.eye(COVARIATES) + prior
    weights = np.ones(len(known))
    slopes = np.zeros(COVARIATES)
    for _ in range(ROUNDS):
        slopes = np.linalg.solve((weights[:, None, None] * grams).sum(0) + prior, weights @ moments)
        wrong = moments - grams @ slopes
        size = np.sqrt(np.einsum("ij,ij->i", wrong, np.linalg.solve(grams + scale, wrong[:, :, None])[:, :, 0]))
        usual = max(float(np.median(size)), CHANCE)
        weights = np.minimum(1.0, 1.5 * usual / np.maximum(size, 1e-300))
    bread = (weights[:, None, None] * grams).sum(0)
    shown = weights[:, None] * wrong
    meat = shown.T @ shown * len(known) / max(1, len(known) - COVARIATES) + CHANCE**2 * bread
    return slopes, bread @ np.linalg.pinv(meat) @ bread


def _build_normal_equations(values: Float, covariates: Float) -> tuple[Float, Float]:
    """Return the normal equations of an axis about its own means; long histories are limited to MOST_SETS."""
    share = min(1.0, MOST_SETS / len(values))
    x = covariates - covariates.mean(0)
    return share * x.T @ x, share * x.T @ (values - values.mean())


def fit_mixed_model(levels: Float, covariates: Float, own: Float, shared: tuple[Float, Float]) -> MixedModelFit:
    """Fit levels (n,), relative to their median, with covariates (n, 2) and own variances (n,) of axes.

    ``shared`` is the result of :func:`shared_slopes`.
    """
    x = np.column_stack([np.ones(len(levels)), covariates - np.median(covariates, axis=0)])
    slopes, information = shared
    prior = np.zeros((1 + COVARIATES, 1 + COVARIATES))
    prior[1:, 1:] = information + np.diag(USUAL**-2.0)
    prior_moment = np.concatenate([[0.0], information @ slopes])
    start = np.linalg.solve(prior[1:, 1:], prior_moment[1:])
    off = levels - x[:, 1:] @ start
    off = off - np.median(off)
    spread = estimate_robust_spread(off)
    theta, covariance = np.zeros(1 + COVARIATES), np.zeros_like(prior)
    for _ in range(ROUNDS):
        before = spread
        weights = np.clip(1 - (off / (FAR * np.sqrt(spread**2 + own + LEAST_SPREAD**2))) ** 2, 0, 1) ** 2
        spread, theta, covariance = _maximise_restricted_likelihood(levels, x, own, weights, prior, prior_moment)
        off = levels - x @ theta
        if abs(spread - before) <= SETTLED * before:
            break
    doubts = np.sqrt(np.einsum("ij,jk,ik->i", x, covariance, x))
    return MixedModelFit(theta[1:], np.sqrt(np.diag(covariance)[1:]), off, doubts, spread)


def estimate_robust_spread(values: Float) -> float:
    """Return a standard deviation that nearly half of the values, whatever they are, cannot inflate.

    It is the larger of a pairwise estimate (Qn) and the scaled median absolute deviation. With three kinds of screws,
    pairs alone could take one kind for all and the others for outliers; the median alone is noisy for few values.
    """
    half = len(values) // 2 + 1
    first, second = np.triu_indices(len(values), 1)
    of_pairs = np.partition(np.abs(values[first] - values[second]), half * (half - 1) // 2 - 1)
    of_median = np.median(np.abs(values - np.median(values)))
    return max(2.2219 * float(of_pairs[half * (half - 1) // 2 - 1]), 1.4826 * float(of_median))


def _maximise_restricted_likelihood(
    y: Float, x: Float, own: Float, weights: Float, prior: Float, prior_moment: Float
) -> tuple[float, Float, Float]:
    """Return the most likely standard deviation between axes, with coefficients and their covariance."""
    largest = max(float(np.ptp(y[weights > 0])), LEAST_SPREAD)
    low, high = np.log(LEAST_SPREAD), np.log(largest) + 0.7
    for count in (25, 9, 9):  # successively finer grids
        trial = np.linspace(low, high, count)
        loss, theta, covariance = _evaluate_losses(np.exp(2 * trial), y, x, own, weights, prior, prior_moment)
        best, step = int(loss.argmin()), trial[1] - trial[0]
        low, high = trial[best] - step, trial[best] + step
    return float(np.exp(trial[best])), theta[best], covariance[best]


def _evaluate_losses(
    between: Float, y: Float, x: Float, own: Float, weights: Float, prior: Float, prior_moment: Float
) -> tuple[Float, Float, Float]:
    """Return the restricted likelihood's loss for variances ``between`` (k,), coefficients (k, 3) and (k, 3, 3)."""
    variance = between[:, None] + own
    shares = weights / variance
    gram = np.einsum("ki,ia,ib->kab", shares, x, x) + prior
    covariance = np.linalg.inv(gram)
    theta = np.einsum("kab,kb->ka", covariance, shares @ (x * y[:, None]) + prior_moment)
    residual = y - theta @ x.T
    penalty = np.einsum("ka,ab,kb->k", theta, prior, theta) - 2 * theta @ prior_moment
    loss = (weights * np.log(variance)).sum(1) + (shares * residual**2).sum(1) + penalty + np.linalg.slogdet(gram)[1]
    return loss, theta, covariance
