"""The bench's path (figure 10 of [DES]) as the NC orders it, made here without the planner."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from fdhil.records import Float, Trajectory, frozen, frozen_ints


def _geometry(step_mm: float = 0.002) -> Float:
    corners = [(0.0, 0.0), (0.0, 55.0), (100.0, 55.0)]
    lines = [_line(a, b, step_mm) for a, b in pairwise(corners)]
    angle = np.arange(np.pi, 2 * np.pi, step_mm / 50.0)
    arc = np.column_stack([150 + 50 * np.cos(angle), 55 + 50 * np.sin(angle)])
    tail = [_line((200.0, 55.0), (250.0, 55.0), step_mm), _line((250.0, 55.0), (250.0, 0.0), step_mm)]
    return np.concatenate([*lines, arc, *tail, [[250.0, 0.0]]])


def _line(a: tuple[float, float], b: tuple[float, float], step_mm: float) -> Float:
    start, end = np.array(a), np.array(b)
    share = np.arange(0.0, 1.0, step_mm / float(np.linalg.norm(end - start)))
    return np.asarray(start + share[:, None] * (end - start))


def smooth(path: Float, windows_s: tuple[float, ...], dt_s: float) -> Float:
    """Moving averages, causal, starting from rest at the first row."""
    for window in windows_s:
        m = round(window / dt_s)
        total = np.cumsum(np.concatenate([np.repeat(path[:1], m, axis=0), path]), axis=0)
        path = (total[m:] - total[:-m]) / m
    return path


def bench_demand(
    feed_m_min: float, smoothing_s: tuple[float, ...] = (0.060, 0.030), hold_s: float = 0.5, dt_s: float = 0.001
) -> Float:
    """Return the demand (n, 2) in mm: the bench path at constant feed, smoothed per axis, held at its end."""
    path = _geometry()
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    along = np.minimum(np.arange(int(arc[-1] / (feed_m_min / 0.06 * dt_s)) + 2) * feed_m_min / 0.06 * dt_s, arc[-1])
    rows = np.column_stack([np.interp(along, arc, path[:, a]) for a in range(2)])
    rest = round((sum(smoothing_s) + hold_s) / dt_s)
    return smooth(np.concatenate([rows, np.repeat(rows[-1:], rest, axis=0)]), smoothing_s, dt_s)


def trajectory(demand: Float, axes: str = "XY", dt_s: float = 0.001) -> Trajectory:
    """Wrap a demand (n, d) as a reference."""
    n = len(demand)
    return Trajectory(
        dt_s,
        frozen(np.arange(n) * dt_s),
        {axis: frozen(demand[:, a]) for a, axis in enumerate(axes)},
        np.zeros(n, dtype=np.bool_),
        frozen_ints(np.zeros(n)),
    )


def bench_trajectory(feed_m_min: float, smoothing_s: tuple[float, ...] = (0.060, 0.030)) -> Trajectory:
    """The bench path as a reference of X and Y."""
    return trajectory(bench_demand(feed_m_min, smoothing_s))


def rms(values: Float) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))
