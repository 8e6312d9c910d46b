"""The path as a curve over its length: consecutive pieces with rounded corners."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fdhil.program.motions import ALL_AXES
from fdhil.program.planner.corners import compute_fade
from fdhil.program.planner.path_pieces import LENGTH, WIDTH, compute_points
from fdhil.records import Float


class PathCurve:
    """The known pieces that are still needed. ``smooth`` selects the kind of blend."""

    def __init__(self, smooth: bool) -> None:
        self._smooth = smooth
        self._pieces = np.empty((0, WIDTH))
        self._end_mm = np.empty(0)  # path at the end of each piece
        self._half_mm = np.empty(0)  # half length of the blend at its start
        self._start = np.zeros((1, len(ALL_AXES)))

    def append_pieces(self, pieces: Float, half_mm: Float) -> None:
        """Append pieces (n, WIDTH) whose blends at their starts have half lengths (n,)."""
        begin = self._end_mm[-1] if self._end_mm.size else 0.0
        self._pieces = np.concatenate([self._pieces, pieces])
        self._end_mm = np.concatenate([self._end_mm, begin + np.cumsum(pieces[:, LENGTH])])
        self._half_mm = np.concatenate([self._half_mm, half_mm])

    def drop_before(self, before_mm: float) -> None:
        """Drop the pieces that end before a length of path, except the last of them."""
        drop = int(np.searchsorted(self._end_mm, before_mm)) - 2
        if drop > 0:
            self._pieces, self._end_mm = self._pieces[drop:], self._end_mm[drop:]
            self._half_mm = self._half_mm[drop:]

    def compute_points(self, path_mm: Float) -> Float:
        """Return the points (n, 9) at lengths of path (n,)."""
        if not self._end_mm.size:
            return np.repeat(self._start, path_mm.size, axis=0)
        last = self._end_mm.size - 1
        index = np.minimum(np.searchsorted(self._end_mm, path_mm, side="left"), last)
        here = self._pieces[index]
        to_go = self._end_mm[index] - path_mm
        position = compute_points(here, here[:, LENGTH] - to_go)
        before, behind = self._half_mm[index], np.append(self._half_mm, 0.0)[index + 1]
        entering = (before > 0.0) & (here[:, LENGTH] - to_go < before)
        leaving = (behind > 0.0) & (to_go < behind)
        rows = np.flatnonzero(entering | leaving)
        if rows.size:
            position[rows] = self._blend_points(np.where(leaving, index + 1, index)[rows], path_mm[rows])
        return position

    def _blend_points(self, after_index: npt.NDArray[np.intp], path_mm: Float) -> Float:
        before, after = self._pieces[after_index - 1], self._pieces[after_index]
        whole = 2.0 * self._half_mm[after_index]
        u = np.clip((path_mm - self._end_mm[after_index - 1]) / whole + 0.5, 0.0, 1.0)
        left, grown = compute_fade(u, self._smooth)
        turn = compute_points(before, before[:, LENGTH])
        return compute_points(before, before[:, LENGTH] - whole * left) + compute_points(after, whole * grown) - turn
