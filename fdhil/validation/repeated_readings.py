"""Computes how likely equal readings are: of a quantised constant, and by the samples before and after them."""

from __future__ import annotations

import math

import numpy as np

from fdhil.identification import estimate_noise_std, find_resolution
from fdhil.records import Bool, Float
from fdhil.validation.false_alarm_budget import BUDGET

RESOLVED = 0.2  # of a step: noise below it hides in the resolution
INFORMATIVE_STEPS = 1.0  # of noise, beyond which two of three readings differ
LEAST_NOISE_ROWS = 20
SIDE = 3  # rows on either side of a run that are compared with it, in lengths of the run


def compute_repeat_probability(noise: float) -> float:
    """Return the probability that a constant in the middle of a step is read there; ``noise`` is in steps."""
    return math.erf(1.0 / (math.sqrt(8.0) * noise))


def is_beyond_chance(values: Float, start: int, end: int) -> bool:
    """Return whether the equal readings of rows ``start`` to ``end`` are more than the neighbouring rows explain.

    Either side may explain them: by how often it has that very reading (a constant read coarsely), or by how often it
    repeats its reading (a signal that creeps through the steps). Noise of several steps explains neither.
    """
    length = end - start + 1
    chance = 0.0
    same, step = np.diff(values) == 0.0, find_resolution(values[np.isfinite(values)])
    sides = (slice(max(0, start - SIDE * length), start), slice(end + 1, end + 1 + SIDE * length))
    for others in (values[sides[0]], values[sides[1]], np.concatenate([values[:start], values[end + 1 :]])):
        # the neighbouring rows may lie at the edge of a step, and the run in its middle
        chance = max(chance, estimate_repeat_probability(others, step) ** length)
    for side in sides:
        # with noise of several steps no reading is frequent: rows with this one were clipped as well
        if values[side].size >= length and estimate_noise_std(values[side]) < INFORMATIVE_STEPS * step:
            likely = (
                compute_run_probability(length, values[side] == values[start]),
                compute_run_probability(length - 1, same[side]),
            )
            chance = max(chance, *likely)
    return values.size * chance < BUDGET["saturated"].chance


def estimate_repeat_probability(values: Float, step: float) -> float:
    """Return the largest probability that a constant with the noise of ``values`` repeats its reading: mid-``step``."""
    third = np.diff(values, 3)
    third = third[np.isfinite(third)]
    if third.size < LEAST_NOISE_ROWS or step == 0.0:
        return 0.0
    # quantisation adds its own scatter
    variance = float(np.mean(third**2)) / 20.0 - step**2 / 12
    return compute_repeat_probability(math.sqrt(max(variance, (RESOLVED * step) ** 2)) / step)


def compute_run_probability(length: int, others: Bool) -> float:
    """Return the probability that ``length`` given rows have what these and ``others`` have as often as they do.

    Exact for rows that may be exchanged for each other (Fisher): no level of noise is needed.
    """
    having, every = int(np.count_nonzero(others)), others.size
    log = math.lgamma(length + having + 1) - math.lgamma(having + 1)
    log += math.lgamma(every + 1) - math.lgamma(length + every + 1)
    return math.exp(log)


def has_jump_after(part: Float, start: int, end: int) -> bool:
    """Return whether the signal resumes after a run of repeats by more than it ever changes otherwise."""
    change = np.abs(np.diff(part))
    if end >= change.size:
        return False
    others = np.concatenate([change[:start], change[end + 1 :]])
    others = others[np.isfinite(others)]
    return others.size > 0 and bool(change[end] > 2 * others.max(initial=0.0))
