"""How likely are equal readings? A smooth signal with white noise, read in steps, by maximum likelihood.

A reading says no more than that signal and noise together lay within half a step of it. The signal is a polynomial over
the rows about a run of equal readings; its coefficients and the noise are what makes the rows beside the run most
likely, and then those rows and the run together. The ratio of both is how likely the run was, given the rows beside it
(Laplace's approximation: with the share of the parameters' volume that is left). Everything is in steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit

from fdhil.records import Float

ITERATIONS = 25
ENOUGH = 1e-3  # of the log likelihood
RIDGE = 1e-9
LEAST_NOISE = 0.15  # below it a row more or less tells nothing new of the noise
_ROOT_2, _ROOT_2PI = math.sqrt(2.0), math.sqrt(2.0 * math.pi)
_FAR = -25.0  # standard deviations beyond which the normal integral is its asymptote


def alike(noise: float) -> float:
    """Return how likely a constant in the middle of a step is read there; its ``noise`` is in steps."""
    return math.erf(1.0 / (math.sqrt(8.0) * noise))


def _within_plain(low: float, high: float) -> tuple[float, float, float]:
    """Return log p of a standard normal number between ``low`` and ``high``, and the density over p at both."""
    # the mirror image keeps the difference of two tails exact
    far, near = (-high, -low) if low > 0.0 else (low, high)
    if near < _FAR:
        log, at_near = -0.5 * near * near - math.log(-near * _ROOT_2PI), -near - 1.0 / near
        at_far = at_near * math.exp(max(-0.5 * (far * far - near * near), -700.0))
    else:
        p = 0.5 * (math.erfc(-near / _ROOT_2) - math.erfc(-far / _ROOT_2))
        log = math.log(p)
        at_near = math.exp(-0.5 * near * near) / _ROOT_2PI / p
        at_far = math.exp(-0.5 * far * far) / _ROOT_2PI / p
    return (log, at_near, at_far) if low > 0.0 else (log, at_far, at_near)


_within: Callable[[float, float], tuple[float, float, float]] = njit(cache=True, nogil=True)(_within_plain)


def _likelihood_plain(rows: Float, powers: Float, q: Float, slope: Float, bend: Float) -> float:
    """Return the log likelihood of ``rows`` (n,) for ``q`` (k,): coefficients of ``powers`` (n, k - 1), and precision.

    Coefficients are in units of the noise, whose inverse is the last entry: so the likelihood is concave. ``slope``
    (k,) and minus the second derivatives, ``bend`` (k, k), are filled unless they are empty.
    """
    k = q.size
    slope[:] = 0.0
    bend[:] = 0.0
    up, down = np.empty(k), np.empty(k)
    total = 0.0
    for n in range(rows.size):
        level = 0.0
        for j in range(k - 1):
            level += q[j] * powers[n, j]
        high, low = q[k - 1] * (rows[n] + 0.5) - level, q[k - 1] * (rows[n] - 0.5) - level
        log, at_low, at_high = _within(low, high)
        total += log
        if slope.size == 0:
            continue
        for j in range(k - 1):
            up[j] = down[j] = -powers[n, j]
        up[k - 1], down[k - 1] = rows[n] + 0.5, rows[n] - 0.5
        hh, ll, hl = high * at_high + at_high * at_high, at_low * at_low - low * at_low, at_high * at_low
        for i in range(k):
            slope[i] += at_high * up[i] - at_low * down[i]
            for j in range(i + 1):
                bend[i, j] += hh * up[i] * up[j] + ll * down[i] * down[j] - hl * (up[i] * down[j] + down[i] * up[j])
    return total


_likelihood: Callable[..., float] = njit(cache=True, nogil=True)(_likelihood_plain)


def _step_plain(bend: Float, slope: Float, size: int, step: Float) -> float:
    """Fill ``step`` with bend^-1 slope over its first ``size`` entries (0 beyond).

    Return log det of all but the last row and column of ``bend`` (of ``size`` where that is less).
    """
    root = np.zeros((size, size))
    log = 0.0
    step[:] = 0.0
    for i in range(size):
        for j in range(i + 1):
            s = bend[i, j]
            for m in range(j):
                s -= root[i, m] * root[j, m]
            root[i, j] = math.sqrt(max(s, RIDGE * bend[i, i] + 1e-300)) if i == j else s / root[j, j]
        if i < bend.shape[0] - 1:
            log += 2.0 * math.log(root[i, i])
        s = slope[i]
        for m in range(i):
            s -= root[i, m] * step[m]
        step[i] = s / root[i, i]
    for i in range(size - 1, -1, -1):
        s = step[i]
        for m in range(i + 1, size):
            s -= root[m, i] * step[m]
        step[i] = s / root[i, i]
    return log


_step: Callable[[Float, Float, int, Float], float] = njit(cache=True, nogil=True)(_step_plain)


def _fit_plain(rows: Float, powers: Float, q: Float, least: float, most: float) -> tuple[float, float]:
    """Move ``q`` to the most likely values; return the log likelihood and log det of the coefficients' information.

    The precision of the noise is kept between ``least`` and ``most``.
    """
    k = q.size
    slope, bend, step, trial = np.zeros(k), np.zeros((k, k)), np.zeros(k), np.zeros(k)
    none, no_bend = np.zeros(0), np.zeros((0, 0))
    here = _likelihood(rows, powers, q, slope, bend)
    volume = 0.0
    for _ in range(ITERATIONS):
        at_end = (q[k - 1] >= most and slope[k - 1] > 0.0) or (q[k - 1] <= least and slope[k - 1] < 0.0)
        volume = _step(bend, slope, k - 1 if at_end else k, step)
        gain = 0.0
        for j in range(k):
            gain += slope[j] * step[j]
        if gain < ENOUGH:
            break
        share, moved = 1.0, False
        while share > 1e-3 and not moved:
            for j in range(k):
                trial[j] = q[j] + share * step[j]
            trial[k - 1] = min(max(trial[k - 1], least), most)
            moved = _likelihood(rows, powers, trial, none, no_bend) > here
            share *= 0.5
        if not moved:
            break
        q[:] = trial
        here = _likelihood(rows, powers, q, slope, bend)
    return here, volume


_fit: Callable[..., tuple[float, float]] = njit(cache=True, nogil=True)(_fit_plain)


def _log_chance_plain(values: Float, start: int, end: int, left: int, right: int, degree: int, noise: float) -> float:
    """Return log p that rows ``start`` to ``end`` of ``values`` (in steps) all read as the first of them does.

    The signal is a polynomial of ``degree`` over ``left`` rows before and ``right`` rows after them; its noise is at
    most ``noise`` steps.
    """
    beside, inside = left + right, end - start
    rows, powers = np.empty(beside + inside), np.ones((beside + inside, degree + 1))
    middle, reach = 0.5 * (start + end), 0.5 * (inside + 1) + max(left, right)
    for n in range(beside + inside):
        k = start - left + n if n < left else end + 1 + n - left if n < beside else start + 1 + n - beside
        rows[n] = values[k] - values[start]
        for j in range(degree):
            powers[n, j + 1] = powers[n, j] * (k - middle) / reach
    size = degree + 1
    gram, pull, q = np.zeros((size, size)), np.zeros(size), np.zeros(size + 1)
    for n in range(beside):
        for i in range(size):
            pull[i] += powers[n, i] * rows[n]
            for j in range(i + 1):
                gram[i, j] += powers[n, i] * powers[n, j]
    _step(gram, pull, size, q)
    least, most = 1.0 / max(noise, 2.0 * LEAST_NOISE), 1.0 / LEAST_NOISE
    for j in range(size):
        q[j] *= least
    q[size] = least
    alone, volume = _fit(rows[:beside], powers[:beside], q, least, most)
    together, volume_left = _fit(rows, powers, q, least, most)
    return min(together - alone + 0.5 * (volume - volume_left), 0.0)


log_chance: Callable[[Float, int, int, int, int, int, float], float] = njit(cache=True, nogil=True)(_log_chance_plain)
