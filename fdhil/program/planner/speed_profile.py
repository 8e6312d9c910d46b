"""Speed along the path: limits of its stretches, braking in time for each, and phases of constant acceleration."""

from __future__ import annotations

import numpy as np

from fdhil.records import Float

# columns of a limit on a stretch of path, and of a phase
LOW, HIGH, SPEED, ACCELERATION = range(4)
T, S, V, A, PLACE = range(5)


def widen_limits(limits: Float, filter_s: float) -> Float:
    """Return limits (n, 4) extended beyond their stretches by the reach of an average over ``filter_s``.

    If a path keeps ``v`` within v filter / 2 of a stretch, its average keeps ``v`` on the stretch.
    """
    margin = limits[:, SPEED] * filter_s / 2.0
    wide = limits.copy()
    wide[:, LOW] -= margin
    wide[:, HIGH] += margin
    return wide


def build_speed_grid(limits: Float, inner: Float, first: float, last: float) -> tuple[Float, Float, Float, Float]:
    """Cut [first, last] at the ends of all limits and at the ``inner`` points.

    Return the cuts (m + 1,), the speed limit at each cut (m + 1,), and speed and acceleration between them (m,).
    """
    ends = np.concatenate([limits[:, LOW], limits[:, HIGH], inner])
    cuts = np.unique(np.concatenate([[first, last], ends[(ends > first) & (ends < last)]]))
    low = np.searchsorted(cuts, limits[:, LOW], side="left")
    high = np.searchsorted(cuts, limits[:, HIGH], side="right") - 1
    at_cut = np.full(cuts.size, np.inf)
    between = np.full(cuts.size, np.inf)
    acceleration = np.full(cuts.size, np.inf)
    for column, painted in ((SPEED, between), (ACCELERATION, acceleration)):
        for row in np.argsort(-limits[:, column]).tolist():  # the lowest is painted last and prevails
            painted[low[row] : high[row]] = limits[row, column]
    point = limits[:, LOW] == limits[:, HIGH]
    inside = point & (limits[:, LOW] >= first) & (limits[:, HIGH] <= last)
    np.minimum.at(at_cut, low[inside], limits[inside, SPEED])
    at_cut[:-1] = np.minimum(at_cut[:-1], between[:-1])
    at_cut[1:] = np.minimum(at_cut[1:], between[:-1])
    return cuts, at_cut, between[:-1], acceleration[:-1]


def compute_squared_speeds(at_cut: Float, gain: Float, first: float, last: float) -> Float:
    """Return the highest squared speed (m + 1,) at each cut from ``first`` to ``last``.

    Between two cuts it changes by at most ``gain`` (m,) = 2 acceleration x length; both passes of a look-ahead are
    running minima of the limit minus (plus) the gain up to there.
    """
    bound = at_cut**2
    bound[0], bound[-1] = min(first, bound[0]), min(last, bound[-1])
    total = np.concatenate([[0.0], np.cumsum(gain)])
    forward = np.minimum.accumulate(bound - total) + total
    backward = np.minimum.accumulate((bound + total)[::-1])[::-1] - total
    reached = np.maximum(np.minimum(forward, backward), 0.0)
    reached[0] = bound[0]
    if last == 0.0:
        reached[-1] = 0.0
    return np.asarray(reached)


def build_phases(cuts: Float, energy: Float, speed: Float, acceleration: Float, place: Float, start_s: float) -> Float:
    """Return phases (3 m, 5): begin (s), path (mm), speed, acceleration and ``place`` of each stretch's three phases.

    Each stretch accelerates to its limit, or as far as possible, keeps that speed, and decelerates.
    """
    length = np.diff(cuts)
    begin, end = energy[:-1], energy[1:]
    top = np.minimum(speed**2, (begin + end) / 2.0 + acceleration * length)
    top = np.maximum(top, np.maximum(begin, end))
    v0, peak, v1 = np.sqrt(begin), np.sqrt(top), np.sqrt(end)
    up, down = (top - begin) / (2.0 * acceleration), (top - end) / (2.0 * acceleration)
    level = np.maximum(length - up - down, 0.0)
    spans = np.column_stack([(peak - v0) / acceleration, level / np.maximum(peak, 1e-12), (peak - v1) / acceleration])
    table = np.zeros((length.size, 3, 5))
    table[:, :, S] = np.column_stack([cuts[:-1], cuts[:-1] + up, cuts[:-1] + up + level])
    table[:, :, V] = np.column_stack([v0, peak, peak])
    table[:, :, A] = np.column_stack([acceleration, np.zeros(length.size), -acceleration])
    table[:, :, PLACE] = place[:, None]
    ends = start_s + np.cumsum(spans.ravel())
    flat = table.reshape(-1, 5)
    flat[:, T] = np.concatenate([[start_s], ends[:-1]])
    kept = spans.ravel() > 0.0
    return np.concatenate([flat[kept], [[ends[-1], cuts[-1], v1[-1], 0.0, place[-1]]]])


def evaluate_phases(table: Float, t: Float, tolerance_s: float) -> tuple[Float, Float]:
    """Return path (n,) in mm and place (n,) at times ``t`` (n,) of a table of phases."""
    index = np.maximum(np.searchsorted(table[:, T], t - tolerance_s, side="left") - 1, 0)
    phase = table[index]
    into = np.maximum(t - phase[:, T], 0.0)
    return phase[:, S] + (phase[:, V] + phase[:, A] * into / 2.0) * into, phase[:, PLACE]
