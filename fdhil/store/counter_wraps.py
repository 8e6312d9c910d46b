"""Counters of 16 or 32 bits that pass the end of their range, unwrapped where nothing else explains the jump."""

from __future__ import annotations

import numpy as np

from fdhil.records import Float

BITS = (16, 32)


def unwrap_counter(values: Float) -> tuple[Float, int | None]:
    """Return the counts (n,) without the jumps of a counter that begins again, and its bits; None where it does not.

    It must count in whole numbers within the range of its bits, signed or not, come within a step of that range's end
    where it jumps, and go on after the jump as before it. Lost values may be ``nan``.
    """
    known = np.flatnonzero(np.isfinite(values))
    counts = values[known]
    if counts.size < 3 or not np.array_equal(counts, np.rint(counts)):
        return values, None
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
            unwrapped[known] = whole
            return unwrapped, bits
    return values, None


def _nearby(steps: Float, reach: int = 3) -> Float:
    """Return the greatest of the steps (n,) about each one."""
    padded = np.pad(steps, reach)
    greatest: Float = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return greatest
