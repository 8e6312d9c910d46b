"""Cascaded causal moving averages of each axis' demand: the usual FIR interpolation of an NC."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fdhil.records import Float


class Smoother:
    """Smooths consecutive blocks of rows; before the first row everything is at rest there.

    ``settle_rows`` is the number of rows until the output rests after its input.
    """

    def __init__(self, averages_s: Sequence[float], dt_s: float) -> None:
        self._lengths = [max(1, math.floor(average / dt_s + 0.5)) for average in averages_s]
        self._past: list[Float] = []
        self.settle_rows = sum(length - 1 for length in self._lengths)

    def __call__(self, rows: Float) -> Float:
        """Return the smoothed rows, (n, d) -> (n, d)."""
        if not rows.size:
            return rows
        if not self._past:
            self._past = [np.repeat(rows[:1], length - 1, axis=0) for length in self._lengths]
        for stage, length in enumerate(self._lengths):
            if length == 1:
                continue
            whole = np.concatenate([self._past[stage], rows])
            self._past[stage] = whole[whole.shape[0] - length + 1 :]
            rows = np.column_stack([_smooth_column(column, length) for column in whole.T])
        return rows


def _smooth_column(column: Float, length: int) -> Float:
    """Return the mean of each ``length`` consecutive values; a constant column is returned bit for bit."""
    origin = column[0]
    if column[-1] == origin and bool(np.all(column == origin)):
        return column[length - 1 :]
    smooth: Float = np.convolve(column - origin, np.full(length, 1.0 / length), mode="valid")
    smooth += origin
    return smooth
