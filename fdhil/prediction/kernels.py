"""The compiled search of the contour error."""

from __future__ import annotations

import numpy as np

from fdhil.model.compiled import compiled
from fdhil.records import Float


@compiled
def _segment(path: Float, j: int, point: Float) -> float:
    """Return the distance from ``point`` (d,) to the segment from row j of ``path`` to row j + 1."""
    length = 0.0
    along = 0.0
    for a in range(point.size):
        edge = path[j + 1, a] - path[j, a]
        length += edge * edge
        along += edge * (point[a] - path[j, a])
    t = 0.0 if length == 0.0 else min(max(along / length, 0.0), 1.0)
    square = 0.0
    for a in range(point.size):
        gap = point[a] - path[j, a] - t * (path[j + 1, a] - path[j, a])
        square += gap * gap
    return float(np.sqrt(square))


@compiled
def _row(path: Float, j: int, point: Float) -> float:
    """Return the distance from ``point`` (d,) to row j of ``path``."""
    square = 0.0
    for a in range(point.size):
        square += (point[a] - path[j, a]) ** 2
    return float(np.sqrt(square))


@compiled
def _beyond(arc: Float, reach: float, low: int, high: int) -> int:
    """Return the first row above ``low`` at which ``arc`` (n,) exceeds ``reach``, high + 1 if none; it never falls."""
    if low >= high or arc[high] <= reach:
        return high + 1
    step = 1
    at = low + 1
    while at < high and arc[at] <= reach:  # gallop, then halve
        low = at
        step *= 2
        at = min(low + step, high)
    while at - low > 1:
        middle = (low + at) // 2
        if arc[middle] <= reach:
            low = middle
        else:
            at = middle
    return at


@compiled
def _before(arc: Float, reach: float, low: int, high: int) -> int:
    """Return the last row below ``high`` at which ``arc`` (n,) is less than ``reach``; low - 1 if none."""
    if high <= low or arc[low] >= reach:
        return low - 1
    step = 1
    at = high - 1
    while at > low and arc[at] >= reach:
        high = at
        step *= 2
        at = max(high - step, low)
    while high - at > 1:
        middle = (at + high) // 2
        if arc[middle] >= reach:
            high = middle
        else:
            at = middle
    return at


@compiled
def contour(path: Float, actual: Float, half_window: int, first: int) -> Float:
    """Return (m,) the distance of each row of ``actual`` (m, d) to the polyline of ``path`` (n, d) within the window.

    Row k of ``actual`` belongs to row ``first`` + k. A stretch of the path is passed over only where its length proves
    that no point of it can be nearer than the best one found, so the result is that of the full search. The search
    begins where the row before was nearest: on a slow path that is many rows from the row itself.
    """
    n, d = path.shape
    arc = np.zeros(n)
    for k in range(1, n):
        square = 0.0
        for a in range(d):
            square += (path[k, a] - path[k - 1, a]) ** 2
        arc[k] = arc[k - 1] + np.sqrt(square)
    out = np.empty(len(actual))
    nearest = first
    for row in range(len(actual)):
        k = first + row
        point = actual[row]
        low = max(0, k - half_window)
        high = min(n - 1, k + half_window)
        best = _row(path, k, point)
        begin = max(low, min(nearest, high))
        nearest = k
        j = begin
        while j < high:
            # no point of the path within so far of row j is nearer than the best one
            room = _row(path, j, point) - best
            if arc[j + 1] - arc[j] <= room:
                j = _beyond(arc, arc[j] + room, j + 1, high) - 1
                continue
            distance = _segment(path, j, point)
            if distance < best:
                best = distance
                nearest = j
            j += 1
        j = begin
        while j > low:
            room = _row(path, j, point) - best
            if arc[j] - arc[j - 1] <= room:
                j = _before(arc, arc[j] - room, low, j - 1) + 1
                continue
            j -= 1
            distance = _segment(path, j, point)
            if distance < best:
                best = distance
                nearest = j
        out[row] = best
    return out
