"""The bench's path (figure 10 of [DES]) as commanded by the NC, computed without the planner."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np

from fdhil.records import Float, Trajectory, freeze_array, freeze_integers


def _build_geometry(step_mm: float = 0.002) -> Float:
    corners = [(0.0, 0.0), (0.0, 55.0), (100.0, 55.0)]
    lines = [_build_line(a, b, step_mm) for a, b in pairwise(corners)]
    angle = np.arange(np.pi, 2 * np.pi, step_mm / 50.0)
    arc = np.column_stack([150 + 50 * np.cos(angle), 55 + 50 * np.sin(angle)])
    tail = [_build_line((200.0, 55.0), (250.0, 55.0), step_mm), _build_line((250.0, 55.0), (250.0, 0.0), step_mm)]
    return np.concatenate([*lines, arc, *tail, [[250.0, 0.0]]])


def _build_line(a: tuple[float, float], b: tuple[float, float], step_mm: float) -> Float:
    start, end = np.array(a), np.array(b)
    share = np.arange(0.0, 1.0, step_mm / float(np.linalg.norm(end - start)))
    return np.asarray(start + share[:, None] * (end - start))


def smooth_demand(path: Float, windows_s: tuple[float, ...], dt_s: float) -> Float:
    """Apply causal moving averages, starting from rest at the first sample."""
    for window in windows_s:
        m = round(window / dt_s)
        total = np.cumsum(np.concatenate([np.repeat(path[:1], m, axis=0), path]), axis=0)
        path = (total[m:] - total[:-m]) / m
    return path


def build_bench_demand(
    feed_m_min: float, smoothing_s: tuple[float, ...] = (0.060, 0.030), hold_s: float = 0.5, dt_s: float = 0.001
) -> Float:
    """Return the demand (n, 2) in mm: the bench path at constant feed, smoothed per axis, held at its end."""
    return _build_bench_demand(feed_m_min, smoothing_s, hold_s, dt_s).copy()


@cache
def _build_bench_demand(feed_m_min: float, smoothing_s: tuple[float, ...], hold_s: float, dt_s: float) -> Float:
    return _build_demand(_build_geometry(), feed_m_min, smoothing_s, hold_s, dt_s)


def _build_demand(path: Float, feed_m_min: float, smoothing_s: tuple[float, ...], hold_s: float, dt_s: float) -> Float:
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    along = np.minimum(np.arange(int(arc[-1] / (feed_m_min / 0.06 * dt_s)) + 2) * feed_m_min / 0.06 * dt_s, arc[-1])
    rows = np.column_stack([np.interp(along, arc, path[:, a]) for a in range(2)])
    rest = round((sum(smoothing_s) + hold_s) / dt_s)
    return smooth_demand(np.concatenate([rows, np.repeat(rows[-1:], rest, axis=0)]), smoothing_s, dt_s)


def build_trajectory(demand: Float, axes: str = "XY", dt_s: float = 0.001) -> Trajectory:
    n = len(demand)
    return Trajectory(
        dt_s,
        freeze_array(np.arange(n) * dt_s),
        {axis: freeze_array(demand[:, a]) for a, axis in enumerate(axes)},
        np.zeros(n, dtype=np.bool_),
        freeze_integers(np.zeros(n)),
    )


@cache
def build_bench_trajectory(feed_m_min: float, smoothing_s: tuple[float, ...] = (0.060, 0.030)) -> Trajectory:
    """The bench path as a reference of X and Y."""
    return build_trajectory(build_bench_demand(feed_m_min, smoothing_s))


def compute_rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


def build_rounded_demand(
    feed_m_min: float, smoothing_s: tuple[float, ...] = (0.060, 0.030), dt_s: float = 0.001
) -> Float:
    """Return (n, 2) in mm: the path of a 40 mm cutter around the bench's shape (figure 19 of [DES])."""
    step = 0.002
    pieces = [
        _build_line((-20.0, 0.0), (-20.0, 55.0), step),
        _build_arc((0.0, 55.0), 20.0, np.pi, np.pi / 2, step),
        _build_line((0.0, 75.0), (100.0, 75.0), step),
        _build_arc((100.0, 55.0), 20.0, np.pi / 2, 0.0, step),
        _build_arc((150.0, 55.0), 30.0, np.pi, 2 * np.pi, step),
        _build_arc((200.0, 55.0), 20.0, np.pi, np.pi / 2, step),
        _build_line((200.0, 75.0), (250.0, 75.0), step),
        np.array([[250.0, 75.0]]),
    ]
    return _build_demand(np.concatenate(pieces), feed_m_min, smoothing_s, 0.5, dt_s)


def _build_arc(centre: tuple[float, float], radius: float, begin: float, end: float, step_mm: float) -> Float:
    angle = np.linspace(begin, end, round(abs(end - begin) * radius / step_mm), endpoint=False)
    return np.asarray(centre) + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def build_jerky_demand(feed_m_min: float, acceleration_mm_s2: float = 2000.0, dt_s: float = 0.001) -> Float:
    """Return (n, 2) in mm: the bench path with steps of acceleration and no smoothing, as LinuxCNC commands it.

    Each straight or arc follows a trapezoid of speed; the next one begins where the previous one decelerates, each with
    half of the acceleration, so that corners become parabolas (LinuxCNC's G64 without a tolerance).
    """
    path = _build_geometry()
    corners = [0, *(int(np.argmin(np.hypot(*(path - c).T))) for c in ((0, 55), (100, 55), (200, 55), (250, 55)))]
    speed, rate = feed_m_min / 0.06, 0.5 * acceleration_mm_s2
    begin_s, moves = 0.0, []
    for first, last in pairwise([*corners, len(path) - 1]):
        piece = path[first : last + 1]
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(piece, axis=0), axis=1))])
        top = min(speed, float(np.sqrt(rate * arc[-1])))
        moves.append((begin_s, piece, arc, top))
        begin_s += arc[-1] / top  # here it begins to brake
    rows = round((begin_s + speed / rate + 0.5) / dt_s)
    demand = np.tile(path[0], (rows, 1))
    for begin, piece, arc, top in moves:
        along = _compute_trapezoid_length(np.arange(float(rows)) * dt_s - begin, float(arc[-1]), top, rate)
        demand += np.column_stack([np.interp(along, arc, piece[:, a]) for a in range(2)]) - piece[0]
    return demand


def _compute_trapezoid_length(time_s: Float, length: float, top: float, rate: float) -> Float:
    """Return the length covered by ``time_s`` of a move that accelerates, runs at ``top`` and decelerates."""
    ramp, brake = top / rate, length / top
    t = np.clip(time_s, 0.0, brake + ramp)
    up, down = np.minimum(t, ramp), np.maximum(t - brake, 0.0)
    return np.asarray(0.5 * rate * up**2 + top * np.maximum(t - ramp, 0.0) - 0.5 * rate * down**2)
