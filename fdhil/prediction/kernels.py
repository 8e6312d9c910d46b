"""The compiled search of the contour error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from fdhil.records import Float


def _segment_plain(path: Float, j: int, point: Float) -> float:
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


_segment: Callable[[Float, int, Float], float] = njit(cache=True, nogil=True)(_segment_plain)


def _contour_plain(path: Float, actual: Float, half_window: int) -> Float:
    """Return (n,) the distance of each row of ``actual`` (n, d) to the polyline of ``path`` rows within the window.

    A stretch of the path is passed over only where its length proves that no point of it can be nearer than the best
    one found, so the result is that of the full search.
    """
    n, d = path.shape
    arc = np.zeros(n)
    for k in range(1, n):
        square = 0.0
        for a in range(d):
            square += (path[k, a] - path[k - 1, a]) ** 2
        arc[k] = arc[k - 1] + np.sqrt(square)
    out = np.empty(n)
    for k in range(n):
        point = actual[k]
        low = max(0, k - half_window)
        high = min(n - 1, k + half_window)
        here = 0.0
        for a in range(d):
            here += (point[a] - path[k, a]) ** 2
        best = np.sqrt(here)
        j = k
        while j < high:
            distance = _segment(path, j, point)
            best = min(best, distance)
            reach = arc[j] + distance - best
            j += 1
            while j < high and arc[j + 1] < reach:
                j += 1
        j = k - 1
        while j >= low:
            distance = _segment(path, j, point)
            best = min(best, distance)
            reach = arc[j + 1] - (distance - best)
            j -= 1
            while j >= low and arc[j] > reach:
                j -= 1
        out[k] = best
    return out


contour: Callable[[Float, Float, int], Float] = njit(cache=True, nogil=True)(_contour_plain)
