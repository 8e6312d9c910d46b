"""Splits a ripple's amplitude and phase into additive sine and cosine parts, and combines them again.

A sin(k a + phase) = A cos(phase) sin(k a) + A sin(phase) cos(k a): amplitudes of several windows cannot be averaged,
their parts can. The parts take the positions of amplitude and phase.
"""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from fdhil.records import Float

_AMPLITUDE = re.compile(r"ripple_(screw|motor)_[0-9]+")


def split_ripples(names: Sequence[str], values: Float, covariance: Float, doubts: Float) -> tuple[Float, Float, Float]:
    """Return values (k,), covariance (k, k) and doubts (k, q) with each ripple split into its parts."""
    converted, slopes = values.copy(), np.eye(values.size)
    for a, p in _find_ripple_pairs(names):
        size, sine, cosine = values[a], np.sin(values[p]), np.cos(values[p])
        converted[[a, p]] = size * cosine, size * sine
        slopes[np.ix_([a, p], [a, p])] = [[cosine, -size * sine], [sine, size * cosine]]
    return converted, slopes @ covariance @ slopes.T, slopes @ doubts


def combine_ripples(
    names: Sequence[str], values: Float, covariance: Float, doubts: Float
) -> tuple[Float, Float, Float]:
    """Return the same with the parts combined into amplitude and phase."""
    converted, slopes = values.copy(), np.eye(values.size)
    for a, p in _find_ripple_pairs(names):
        size = max(float(np.hypot(values[a], values[p])), 1e-300)
        sine, cosine = values[p] / size, values[a] / size
        converted[[a, p]] = size, np.arctan2(values[p], values[a])
        slopes[np.ix_([a, p], [a, p])] = [[cosine, sine], [-sine / size, cosine / size]]
    return converted, slopes @ covariance @ slopes.T, slopes @ doubts


def _find_ripple_pairs(names: Sequence[str]) -> Iterator[tuple[int, int]]:
    for k, name in enumerate(names):
        if _AMPLITUDE.fullmatch(name) and f"{name}_phase" in names:
            yield k, names.index(f"{name}_phase")
