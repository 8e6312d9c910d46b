"""Noise levels of voltage, current and speed by maximum likelihood of the innovations, for given parameters."""

from __future__ import annotations

import numpy as np

from fdhil.identification.innovations import gains_of, innovations
from fdhil.identification.motion import Motion, Noise
from fdhil.records import Float

ITERATIONS = 12
STEP = 0.05
LARGEST = 1.0
ENOUGH = 0.05
FLOOR = 1e-3  # of a level's own start: below it a noise has no effect that could be seen


def noise_likelihood(motion: Motion, theta: Float, noise: Noise, delay_s: float = 0.0) -> float:
    """Return minus twice the log likelihood (without its constant) of the innovations."""
    gains = gains_of(motion, theta, noise)
    e = innovations(motion, theta, gains, delay_s)
    return gains.logdet + float((e * e).sum())


def fit_noise(motion: Motion, theta: Float, start: Noise, delay_s: float = 0.0) -> Noise:
    """Return the noise levels that make the innovations most likely, by Newton steps on their logarithms."""
    lower = np.log(motion.noise.vector()) + np.log(FLOOR)
    x = np.log(start.vector())

    def cost(logs: Float) -> float:
        value = noise_likelihood(motion, theta, Noise(*np.exp(logs)), delay_s)
        return value if np.isfinite(value) else np.inf

    here = cost(x)
    for _ in range(ITERATIONS):
        gradient, curvature = _differences(cost, x, here)
        step = np.clip(-gradient / np.maximum(curvature, 0.05 * np.abs(gradient) + 1e-9), -LARGEST, LARGEST)
        scale, moved = 1.0, False
        while scale > 0.05 and not moved:
            trial = np.maximum(x + scale * step, lower)
            there = cost(trial)
            moved = there < here
            scale *= 0.5
        if not moved:
            break
        done = np.abs(trial - x).max() < ENOUGH
        x, here = trial, there
        if done:
            break
    return Noise(*np.exp(x))


def _differences(cost: object, x: Float, here: float) -> tuple[Float, Float]:
    """Return gradient (3,) and diagonal curvature (3,) by central differences."""
    assert callable(cost)
    gradient, curvature = np.zeros(3), np.zeros(3)
    for j in range(3):
        up, down = x.copy(), x.copy()
        up[j] += STEP
        down[j] -= STEP
        high, low = cost(up), cost(down)
        gradient[j] = (high - low) / (2 * STEP)
        curvature[j] = (high + low - 2 * here) / STEP**2
    return gradient, curvature
