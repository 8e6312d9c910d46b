"""A mixed model of sisters that one or two wrong ones among them cannot bend: temperature, age, axis, chance.

In its own sets an axis shows what temperature and age do, whatever else it is; that is what all of them share. Between
axes the same two are told apart from what is the axis' own, a normal deviation whose variance is found by restricted
maximum likelihood (REML). Both are taken together; where neither tells, a weak expectation stands in, with its doubt.
Axes that fit badly lose their say, those that are far off lose all of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.records import Float

COVARIATES = 2  # temperature in K, age in months
USUAL = np.array([0.02, 0.02])  # by what part a parameter may move per K and per month, before anything is known
MOST_SETS = 10  # an axis has no more say than with so many: it tells its own slope, not that of all
CHANCE = 1e-3  # of a value, at least: what sets cannot show better
LEAST_SPREAD = 1e-9  # of what differs between axes
ROUNDS = 12
SETTLED = 1e-3  # of the spread, from one round to the next
FAR = 4.7  # deviations from which on an axis has no say (Tukey's biweight)


@dataclass(frozen=True, slots=True)
class Fit:
    """``slopes`` (2,) per K and per month with ``slope_stds`` (2,); each axis' deviation ``off`` (n,) from what is
    expected at its temperature and age, the ``doubts`` (n,) of it, and the ``spread`` of axes that are as others.
    """

    slopes: Float
    slope_stds: Float
    off: Float
    doubts: Float
    spread: float


def shared_slopes(axes: Sequence[tuple[Float, Float]]) -> tuple[Float, Float]:
    """Return what axes show together by their own sets: slopes (2,) and the information of them (2, 2).

    An axis is values (n,), as parts of its median, and covariates (n, 2) that are all known. The information is what
    axes that differ in their slopes, and sets that follow each other, leave of it (a sandwich over the axes).
    """
    known = [_normal(*axis) for axis in axes if len(axis[0]) > 1]
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


def _normal(values: Float, covariates: Float) -> tuple[Float, Float]:
    """Return an axis' normal equations, about its own means."""
    share = min(1.0, MOST_SETS / len(values))
    x = covariates - covariates.mean(0)
    return share * x.T @ x, share * x.T @ (values - values.mean())


def fit(levels: Float, covariates: Float, own: Float, shared: tuple[Float, Float]) -> Fit:
    """Fit levels (n,), as parts of their median, with covariates (n, 2) and own variances (n,) of axes.

    ``shared`` is what :func:`shared_slopes` returned.
    """
    x = np.column_stack([np.ones(len(levels)), covariates - np.median(covariates, axis=0)])
    slopes, information = shared
    beforehand = np.zeros((1 + COVARIATES, 1 + COVARIATES))
    beforehand[1:, 1:] = information + np.diag(USUAL**-2.0)
    told = np.concatenate([[0.0], information @ slopes])
    start = np.linalg.solve(beforehand[1:, 1:], told[1:])
    off = levels - x[:, 1:] @ start
    off = off - np.median(off)
    spread = robust_spread(off)
    theta, covariance = np.zeros(1 + COVARIATES), np.zeros_like(beforehand)
    for _ in range(ROUNDS):
        before = spread
        weights = np.clip(1 - (off / (FAR * np.sqrt(spread**2 + own + LEAST_SPREAD**2))) ** 2, 0, 1) ** 2
        spread, theta, covariance = _reml(levels, x, own, weights, beforehand, told)
        off = levels - x @ theta
        if abs(spread - before) <= SETTLED * before:
            break
    doubts = np.sqrt(np.einsum("ij,jk,ik->i", x, covariance, x))
    return Fit(theta[1:], np.sqrt(np.diag(covariance)[1:]), off, doubts, spread)


def robust_spread(values: Float) -> float:
    """Return a standard deviation that nearly half of the values cannot make too large, whatever they are.

    It is the larger of what pairs tell (Qn) and what the median absolute deviation does. Pairs alone might take the
    axes with one of three kinds of screws for all, the others for wrong; the median alone trembles with few of them.
    """
    half = len(values) // 2 + 1
    first, second = np.triu_indices(len(values), 1)
    of_pairs = np.partition(np.abs(values[first] - values[second]), half * (half - 1) // 2 - 1)
    of_median = np.median(np.abs(values - np.median(values)))
    return max(2.2219 * float(of_pairs[half * (half - 1) // 2 - 1]), 1.4826 * float(of_median))


def _reml(y: Float, x: Float, own: Float, weights: Float, beforehand: Float, told: Float) -> tuple[float, Float, Float]:
    """Return the standard deviation between axes that is the likeliest, with coefficients and their covariance."""
    largest = max(float(np.ptp(y[weights > 0])), LEAST_SPREAD)
    low, high = np.log(LEAST_SPREAD), np.log(largest) + 0.7
    for count in (25, 9, 9):  # finer and finer
        trial = np.linspace(low, high, count)
        loss, theta, covariance = _losses(np.exp(2 * trial), y, x, own, weights, beforehand, told)
        best, step = int(loss.argmin()), trial[1] - trial[0]
        low, high = trial[best] - step, trial[best] + step
    return float(np.exp(trial[best])), theta[best], covariance[best]


def _losses(
    between: Float, y: Float, x: Float, own: Float, weights: Float, beforehand: Float, told: Float
) -> tuple[Float, Float, Float]:
    """Return the restricted likelihood's loss for variances ``between`` (k,), coefficients (k, 3) and (k, 3, 3)."""
    variance = between[:, None] + own
    shares = weights / variance
    gram = np.einsum("ki,ia,ib->kab", shares, x, x) + beforehand
    covariance = np.linalg.inv(gram)
    theta = np.einsum("kab,kb->ka", covariance, shares @ (x * y[:, None]) + told)
    left = y - theta @ x.T
    prior = np.einsum("ka,ab,kb->k", theta, beforehand, theta) - 2 * theta @ told
    loss = (weights * np.log(variance)).sum(1) + (shares * left**2).sum(1) + prior + np.linalg.slogdet(gram)[1]
    return loss, theta, covariance
