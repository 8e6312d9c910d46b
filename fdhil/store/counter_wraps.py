"""Unwraps counters that overflow the range of their bits, if nothing else explains the jump."""

import numpy as np

from fdhil.records import Float, Int

BITS = range(10, 33)
MOST_DECIMALS = 6
MOST_COUNTS = 2.0**32


def unwrap_counter(values: Float) -> tuple[Float, int | None]:
    """Return the values (n,) without the jumps of an overflowing counter, and its bits; None without overflow.

    The counter must count in whole numbers or a decimal fraction of them, within the range of its bits (signed or not),
    jump within a step of the end of that range, and continue after the jump as before. Lost samples may be ``nan``.
    """
    known = np.flatnonzero(np.isfinite(values))
    scale = _find_scale(values[known])
    if known.size < 3 or scale is None:
        return values, None
    counts = np.rint(values[known] * scale)
    for bits in BITS:
        whole = _remove_jumps(counts, 2.0**bits, 2.0)
        if whole is not None:
            return _fill_finite(values, known, whole / scale), bits
    return values, None


def unwrap_turns(values: Float, turn: float) -> tuple[Float, bool]:
    """Return the values (n,) of a position within one ``turn``, unwrapped, and whether there were such jumps."""
    known = np.flatnonzero(np.isfinite(values))
    whole = _remove_jumps(values[known], turn, 1e-3 * turn) if known.size > 2 else None
    return (values, False) if whole is None else (_fill_finite(values, known, whole), True)


def jump_of_reading(values: Float) -> float | None:
    """Return the jump of a moving position from one end of its range to the other; None without one.

    A position at standstill there is the end of a recording and the beginning of the next.
    """
    known = values[np.isfinite(values)]
    steps = np.diff(known)
    reach = np.ptp(known) if known.size else 0.0
    is_jump = np.abs(steps) > 0.8 * reach
    if reach == 0 or not is_jump.any() or np.count_nonzero(is_jump) > steps.size / 8:
        return None
    others = np.where(is_jump, 0.0, np.abs(steps))
    near = _compute_nearby_maximum(others)[is_jump]
    goes_on = np.sign(steps[is_jump]) == -np.sign(np.median(steps[~is_jump & (steps != 0)]))
    is_moving = ((near > others.max() / 8) & (near < reach / 8)).all()
    return float(np.median(np.abs(steps[is_jump]))) if goes_on.all() and is_moving else None


def _remove_jumps(counts: Float, period: float, resolution: float) -> Float | None:
    jumps = np.abs(np.diff(counts))
    low = -period / 2 if counts.min() < 0 else 0.0
    if counts.min() < low or counts.max() >= low + period or jumps.max() <= period / 2:
        return None
    whole: Float = np.unwrap(counts, period=period)
    steps = np.abs(np.diff(whole))
    is_wrap = jumps > period / 2
    nearby = _compute_nearby_maximum(np.where(is_wrap, 0.0, steps))
    is_steady = (steps[is_wrap] <= 2 * nearby[is_wrap] + resolution).all() and steps.max() < period / 8
    return whole if is_steady else None


def _fill_finite(values: Float, known: Int, whole: Float) -> Float:
    placed = values.copy()
    placed[known] = whole
    return placed


def _find_scale(values: Float) -> float | None:
    if not (np.abs(values) < MOST_COUNTS).all():
        return None
    for decimals in range(MOST_DECIMALS + 1):
        scaled = values * 10.0**decimals
        if (np.abs(scaled - np.rint(scaled)) <= 1e-6 + 1e-12 * np.abs(scaled)).all():
            return 10.0**decimals
    return None


def _compute_nearby_maximum(steps: Float, reach: int = 3) -> Float:
    padded = np.pad(steps, reach)
    greatest: Float = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return greatest
