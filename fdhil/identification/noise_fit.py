"""Fits the noise levels of voltage, current and speed for given parameters, by the likelihood of the innovations."""

from collections.abc import Callable

import numpy as np

from fdhil.identification.innovations import whiten_innovations
from fdhil.identification.prepared_motion import Motion, NoiseLevels
from fdhil.records import Float

ITERATIONS = 12
STEP = 0.05
LARGEST = 1.0
ENOUGH = 0.15  # smaller steps are below the data's resolution


def fit_noise(motion: Motion, theta: Float, start: NoiseLevels) -> NoiseLevels:
    """Return the most likely noise levels for ``theta`` (7,), by Newton steps on their logarithms."""
    lower = np.log(motion.noise.to_array()) + np.log(motion.noise_floor)
    x = np.log(start.to_array())

    def compute_costs(logs: Float) -> Float:
        # minus twice the log likelihood (q,), without its constant, for each row of logarithms (q, 3)
        e, logdet = whiten_innovations(motion, np.tile(theta, (len(logs), 1)), np.exp(2 * logs))
        values = logdet + np.einsum("mq,mq->q", e, e)
        return np.where(np.isfinite(values), values, np.inf)

    here = float(compute_costs(x[None])[0])
    for _ in range(ITERATIONS):
        gradient, curvature = _differentiate_costs(compute_costs, x, here)
        step = np.clip(-gradient / np.maximum(curvature, 0.05 * np.abs(gradient) + 1e-9), -LARGEST, LARGEST)
        scale, moved = 1.0, False
        while scale > 0.05 and not moved:
            trial = np.maximum(x + scale * step, lower)
            there = float(compute_costs(trial[None])[0])
            moved = there < here
            scale *= 0.5
        if not moved:
            break
        done = np.abs(trial - x).max() < ENOUGH
        x, here = trial, there
        if done:
            break
    return NoiseLevels(*np.exp(x))


def _differentiate_costs(costs: Callable[[Float], Float], x: Float, here: float) -> tuple[Float, Float]:
    steps = STEP * np.eye(3)
    around = costs(np.concatenate([x + steps, x - steps]))
    high, low = around[:3], around[3:]
    return (high - low) / (2 * STEP), (high + low - 2 * here) / STEP**2
