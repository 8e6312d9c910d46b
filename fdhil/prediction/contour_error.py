"""Computes the contour error: the distance from the table to the path, whatever its position along the path."""

from __future__ import annotations

import numpy as np

from fdhil.prediction import contour_kernels
from fdhil.records import Float

WINDOW_S = 0.4


def compute_contour_error_um(reference_mm: Float, actual_mm: Float, dt_s: float, first: int | None = None) -> Float:
    """Return (n,) >= 0, the distance of each actual point (n, d) to the polyline of the reference (n, d) within 0.4 s.

    With ``first`` the actual rows (m, d) belong to the rows of the reference from there on. ValueError when the two do
    not fit each other.
    """
    reference = np.ascontiguousarray(reference_mm, dtype=np.float64)
    actual = np.ascontiguousarray(actual_mm, dtype=np.float64)
    fits = actual.shape == reference.shape
    if first is not None and actual.ndim == 2:
        fits = actual.shape[1:] == reference.shape[1:] and 0 <= first <= len(reference) - len(actual)
    if not fits or reference.ndim != 2:
        raise ValueError(f"reference {reference.shape} and actual path {actual.shape} must both be (n, d)")
    return contour_kernels.search_contour_error(reference, actual, round(WINDOW_S / dt_s), first or 0) * 1e3


def find_nearest_points_mm(reference_mm: Float, actual_mm: Float, dt_s: float, first: int) -> Float:
    """Return the points (m, d) of the path (n, d) nearest to the actual points (m, d).

    The actual points belong to the rows of the reference from ``first`` on.
    """
    window = round(WINDOW_S / dt_s)
    found = np.empty_like(actual_mm)
    for k, point in enumerate(actual_mm):
        begin = reference_mm[max(0, first + k - window) : first + k + window + 1]
        edge = np.diff(begin, axis=0)
        length = np.maximum(np.sum(edge**2, axis=1), 1e-30)
        share = np.clip(np.sum(edge * (point - begin[:-1]), axis=1) / length, 0.0, 1.0)
        on = begin[:-1] + share[:, None] * edge
        found[k] = on[np.argmin(np.sum((on - point) ** 2, axis=1))]
    return found
