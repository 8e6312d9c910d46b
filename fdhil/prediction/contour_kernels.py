"""Compiled kernels that search for the contour error."""

from __future__ import annotations

import numpy as np

from fdhil.model import compile_kernel
from fdhil.records import Float


@compile_kernel
def _measure_segment_distance(path: Float, j: int, point: Float) -> float:
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


@compile_kernel
def _measure_point_distance(path: Float, j: int, point: Float) -> float:
    square = 0.0
    for a in range(point.size):
        square += (point[a] - path[j, a]) ** 2
    return float(np.sqrt(square))


@compile_kernel
def _find_first_beyond(arc: Float, reach: float, begin: int, end: int) -> int:
    """Return the first row from ``begin`` to ``end`` (in either direction) that is farther along than ``reach``.

    ``reach`` is a length from row ``begin``; if no row is that far, the one behind ``end`` is returned.
    """
    way = 1 if end >= begin else -1
    far = abs(end - begin)
    if abs(arc[end] - arc[begin]) <= reach:
        return end + way
    step = 1
    while step < far and abs(arc[begin + way * step] - arc[begin]) <= reach:  # gallop, then halve
        step *= 2
    low, high = step // 2, min(step, far)
    while high - low > 1:
        middle = (low + high) // 2
        if abs(arc[begin + way * middle] - arc[begin]) <= reach:
            low = middle
        else:
            high = middle
    return begin + way * high


@compile_kernel
def search_contour_error(path: Float, actual: Float, half_window: int, first: int) -> Float:
    """Return (m,) the distance of each row of ``actual`` (m, d) to the polyline of ``path`` (n, d) within the window.

    Row k of ``actual`` belongs to row ``first`` + k. A part of the path is skipped only if its length proves that no
    point of it can be nearer than the best one found, so the result is that of the full search. The search begins at
    the previous row's nearest point: on a slow path that is many rows from the row itself.
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
        best = _measure_point_distance(path, k, point)
        begin = max(low, min(nearest, high))
        nearest = k
        for end in (high, low):
            way = 1 if end == high else -1
            j = begin
            while j != end:
                # no point of the path within so far of row j is nearer than the best one
                room = _measure_point_distance(path, j, point) - best
                if abs(arc[j + way] - arc[j]) <= room:
                    j = _find_first_beyond(arc, room, j, end) - way
                    continue
                distance = _measure_segment_distance(path, min(j, j + way), point)
                if distance < best:
                    best = distance
                    nearest = min(j, j + way)
                j += way
        out[row] = best
    return out
