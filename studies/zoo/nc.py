"""Set-points as numerical controllers plan them: jerk-limited moves and a path with corners and quadrants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from studies.zoo.plant import Array


def _smooth_moving_average(rate: Array, seconds: float, period_s: float) -> Array:
    """Return a speed after a moving average, longer by its length; the distance stays."""
    n = round(seconds / period_s)
    return np.convolve(rate, np.ones(n) / n) if n > 1 else rate


def make_move(distance: float, speed: float, acceleration: float, jerk: float, period_s: float) -> Array:
    """Return the speeds (m/s) of a move over ``distance`` (m, signed); ``jerk`` 0 m/s3 is a trapezoid."""
    length = abs(distance)
    top = min(speed, math.sqrt(length * acceleration))
    cruise = max(1, round(length / top / period_s))
    rate = np.full(cruise, length / (cruise * period_s))
    rate = _smooth_moving_average(rate, top / acceleration, period_s)
    rate = _smooth_moving_average(rate, acceleration / jerk if jerk else 0.0, period_s)
    return math.copysign(1.0, distance) * rate


def make_set_points(parts: Sequence[Array], rest_s: float, period_s: float) -> Array:
    """Return the set-points (m) of moves with a rest before, between and after them."""
    rest = np.zeros(round(rest_s / period_s))
    rates = np.concatenate([rest, *(part for one in parts for part in (one, rest))])
    return np.concatenate([[0.0], np.cumsum(rates) * period_s])


def make_path(feed_m_s: float, period_s: float, smoothing_s: tuple[float, float] = (0.060, 0.030)) -> Array:
    """Return the set-points (n, 2) in m of a circle (radius 30 mm) and a square (40 mm), each axis smoothed."""
    circle = np.linspace(0.0, 2 * np.pi, 2001)
    corners = np.array([[0.0, 0.0], [0.04, 0.0], [0.04, 0.04], [0.0, 0.04], [0.0, 0.0]])
    square = np.concatenate([np.linspace(a, b, 400) for a, b in pairwise(corners)])
    line = np.concatenate([0.03 * np.column_stack([1 - np.cos(circle), np.sin(circle)]), square])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    step = feed_m_s * period_s
    rows = np.arange(0.0, along[-1], step)
    raw = np.column_stack([np.interp(rows, along, line[:, k]) for k in (0, 1)])
    rates = np.diff(raw, axis=0, prepend=raw[:1])
    rest = np.zeros((round(0.1 / period_s), 2))
    end = np.zeros((round(0.5 / period_s), 2))
    rates = np.concatenate([rest, rates, end])
    smooth = []
    for k in (0, 1):
        one = rates[:, k]
        for seconds in smoothing_s:
            n = max(1, round(seconds / period_s))
            one = np.convolve(one, np.ones(n) / n)[: len(rates)]
        smooth.append(np.cumsum(one))
    return np.column_stack(smooth)


def measure_distance_um(path_m: Array, points_m: Array, period_s: float, reach_s: float = 0.4) -> Array:
    """Return the distance (n,) in um of each point from the polyline of the path within ``reach_s`` of its time."""
    reach = round(reach_s / period_s)
    found = np.empty(len(points_m))
    for k, point in enumerate(points_m):
        part = path_m[max(0, k - reach) : k + reach + 1]
        begin, way = part[:-1], np.diff(part, axis=0)
        square = np.maximum((way**2).sum(axis=1), 1e-30)
        share = np.clip(((point - begin) * way).sum(axis=1) / square, 0.0, 1.0)
        gap = point - begin - share[:, None] * way
        found[k] = math.sqrt(float((gap**2).sum(axis=1).min()))
    return 1e6 * found
