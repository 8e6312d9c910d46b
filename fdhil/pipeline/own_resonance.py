"""Searches for a resonance between motor and table if neither configured nor other loops explain a drive's rapids.

The motor's position is measured far better than its speed, and the closed loop along the demand shows the table's
reaction on the motor in it: the resonance with the smallest residual of the replays is used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fdhil.config import Axis
from fdhil.records import Parameters, Window
from fdhil.validation.replay import replay_window

GRID = np.geomspace(40.0, 250.0, 14)  # Hz
HALVINGS = 2  # of the grid's steps around the best
NOTICED = 0.01  # of the following error: below, nothing is searched for
BETTER = 0.5  # of the residual, at most, with an accepted resonance
MOST_RAPIDS = 4

Rapids = Sequence[tuple[Window, Parameters]]


def softer_axis(rapids: Rapids, axis: Axis, sync_period_s: float) -> Axis | None:
    """Return the axis with the resonance that the rapids show.

    None if one is configured already, if the rapids are explained, and if none explains them.
    """
    rapids = [pair for pair in rapids if not pair[1].term("resonance")][-MOST_RAPIDS:]
    if axis.resonance_hz is not None or not rapids:
        return None
    left, following = _left_um(rapids, axis, sync_period_s)
    if not left > NOTICED * following:
        return None
    found = _best(rapids[-1:], axis, sync_period_s)
    soft = _with(axis, found)
    return soft if _left_um(rapids, soft, sync_period_s)[0] < BETTER * left else None


def _best(rapids: Rapids, axis: Axis, sync_period_s: float) -> float:
    left: dict[float, float] = {}

    def tried(*resonances: float) -> float:
        for hertz in resonances:
            left[hertz] = _left_um(rapids, _with(axis, hertz), sync_period_s)[0]
        return min(left, key=left.__getitem__)

    best, ratio = tried(*GRID.tolist()), float(GRID[1] / GRID[0])
    for _ in range(HALVINGS):
        ratio **= 0.5
        best = tried(best / ratio, best * ratio)
    return best


def _with(axis: Axis, hertz: float) -> Axis:
    return axis.model_copy(update={"resonance_hz": hertz})


def _left_um(rapids: Rapids, axis: Axis, sync_period_s: float) -> tuple[float, float]:
    """Return the RMS residual of the rapids' replays, and of the following error; zero without any."""
    replays = [replay_window(window, drive, axis, sync_period_s) for window, drive in rapids]
    residuals = [(one.unexplained_um, one.measured_um) for one in replays if one is not None]
    left, following = np.sqrt(np.mean(np.square(residuals), axis=0)) if residuals else (0.0, 0.0)
    return float(left), float(following)
