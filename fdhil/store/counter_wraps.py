"""Counters that pass the end of the range of their bits, unwrapped where nothing else explains the jump."""

from __future__ import annotations

import numpy as np

from fdhil.records import Float

BITS = range(10, 33)
MOST_DECIMALS = 6
MOST_COUNTS = 2.0**32


def unwrap_counter(values: Float) -> tuple[Float, int | None]:
    """Return the values (n,) without the jumps of a counter that begins again, and its bits; None where it does not.

    It must count in whole numbers, or in a decimal fraction of them, within the range of its bits, signed or not, come
    within a step of that range's end where it jumps, and go on after the jump as before it. Lost ones may be ``nan``.
    """
    known = np.flatnonzero(np.isfinite(values))
    scale = _scale(values[known])
    if known.size < 3 or scale is None:
        return values, None
    counts = np.rint(values[known] * scale)
    jumps = np.abs(np.diff(counts))
    for bits in BITS:
        period = 2.0**bits
        low = -period / 2 if counts.min() < 0 else 0.0
        if counts.min() < low or counts.max() >= low + period or jumps.max() <= period / 2:
            continue
        whole = np.unwrap(counts, period=period)
        steps = np.abs(np.diff(whole))
        is_wrap = jumps > period / 2
        nearby = _nearby(np.where(is_wrap, 0.0, steps))
        if (steps[is_wrap] <= 2 * nearby[is_wrap] + 2).all() and steps.max() < period / 8:
            unwrapped = values.copy()
            unwrapped[known] = whole / scale
            return unwrapped, bits
    return values, None


def _scale(values: Float) -> float | None:
    """Return the power of ten that makes whole numbers of all values; None without one."""
    if not (np.abs(values) < MOST_COUNTS).all():
        return None
    for decimals in range(MOST_DECIMALS + 1):
        scaled = values * 10.0**decimals
        if (np.abs(scaled - np.rint(scaled)) <= 1e-6 + 1e-12 * np.abs(scaled)).all():
            return 10.0**decimals
    return None


def _nearby(steps: Float, reach: int = 3) -> Float:
    """Return the greatest of the steps (n,) about each one."""
    padded = np.pad(steps, reach)
    greatest: Float = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return greatest
