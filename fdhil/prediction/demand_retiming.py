"""Generates a recorded demand at other feeds: it has no lines, and the NC's response to another feed is not in it.

If the NC is an interpolator of the configured averages (``[nc] smoothing_s``), these can be removed from the demand,
the path under them run at another speed, and the averages applied again: the demand is then the NC's. Otherwise the
truth lies between two rules: that the averages, or the acceleration, stay (cautious), and that time itself is
stretched, so that accelerations fall with the square of the feed (hopeful).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from fdhil.config import MachineConfig
from fdhil.prediction.feed_search import FeedScaledPath
from fdhil.prediction.path_prediction import predict_path
from fdhil.program import Smoother
from fdhil.records import Bool, Float, Int, Parameters, Trajectory, freeze_array, freeze_integers

APART_S = 0.1  # an error that oscillates through 0 has several peaks at one corner
EXACT_MM = 5e-3  # effect of rounding to 9 decimals on a minute under two averages; other averages leave far more
RESTING_MM = 1e-7  # a step below it is the rounding of a file
TOO_FAST = 1.05  # of the rapid speed: beyond any NC's command

# path (n, d), segment and share of the feed of each row (n,) -> path (m, d) and segment (m,) at those feeds
Rule = Callable[[Float, Int, Float], tuple[Float, Int]]


def make_demand_sources(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, tolerance_um: float
) -> tuple[FeedScaledPath, FeedScaledPath | None]:
    """Return a demand as a source; if two rules bracket the truth, the cautious and the hopeful one.

    Its segments reach from half way behind one position that leaves the tolerance to half way before the next.
    """
    contour = predict_path(reference, models, config).contour_um
    stretch = label_segments_around(contour > tolerance_um, round(APART_S / reference.dt_s))
    path = reference.path_mm
    averages = SmoothingFilters(config.nc.smoothing_s, reference.dt_s)
    if config.nc.profile != "fir":
        return _make_source(reference, path, stretch, averages.limit_speed), _make_source(
            reference, path, stretch, averages.stretch_time
        )
    fastest = [TOO_FAST * config.axis[axis].rapid_speed_mm_s * reference.dt_s for axis in reference.table_axes]
    under = averages.remove_smoothing(path)
    if under is not None and bool(np.all(np.abs(np.diff(under, axis=0)) <= fastest)):
        return _make_source(reference, under, stretch, averages.scale_under_smoothing), None
    return _make_source(reference, path, stretch, averages.scale_distances), _make_source(
        reference, path, stretch, averages.stretch_time
    )


def label_segments_around(over: Bool, apart: int) -> Int:
    """Return (n,) numbers from 1 on, a new one half way between rows that are ``over`` and more than ``apart``."""
    rows = np.flatnonzero(over)
    gaps = np.flatnonzero(np.diff(rows) > apart)
    begins = np.zeros(over.size, dtype=np.int64)
    begins[(rows[gaps] + rows[gaps + 1]) // 2] = 1
    return 1 + np.cumsum(begins)


def _make_source(reference: Trajectory, path: Float, stretch: Int, rule: Rule) -> FeedScaledPath:
    positions, columns = reference.path_mm, reference.table_axes
    fastest = _find_largest_speeds(_measure_step_lengths(positions) * 60.0 / reference.dt_s, stretch)

    def generate_demand(shares: Mapping[int, float]) -> Trajectory:
        per_stretch = np.array([shares.get(k, 1.0) for k in range(fastest.size)])
        as_it_is = bool((per_stretch == 1.0).all())
        moved, lines = (positions, stretch) if as_it_is else rule(path, stretch, per_stretch[stretch])
        return replace(
            reference,
            time_s=freeze_array(reference.time_s[0] + np.arange(lines.size) * reference.dt_s),
            position_mm={axis: freeze_array(moved[:, columns.index(axis[0])]) for axis in reference.axes},
            rapid=np.broadcast_to(np.False_, lines.size),
            line=freeze_integers(lines),
        )

    # a segment ends where the error is small: later errors are not its own
    return FeedScaledPath(generate_demand, line=lambda _: 0, feed_mm_min=lambda k: float(fastest[k]), after_s=0.0)


class SmoothingFilters:
    """The rules of one NC, and the moving averages that it applies to each axis' demand."""

    def __init__(self, smoothing_s: Sequence[float], dt_s: float) -> None:
        self._smoothing_s, self._dt_s = smoothing_s, dt_s
        self._lengths = [max(1, math.floor(average / dt_s + 0.5)) for average in smoothing_s]

    def remove_smoothing(self, path: Float) -> Float | None:
        """Return the path (n, d) that these averages turn into ``path``; None if there is none.

        Of an average over m rows, x[k] = x[k - m] + m (y[k] - y[k - 1]). A demand made otherwise does not come to rest.
        """
        moving = np.flatnonzero(np.any(np.abs(np.diff(path, axis=0)) > RESTING_MM, axis=1))
        under = path
        for m in self._lengths:
            steps = m * np.diff(under, axis=0, prepend=under[:1])
            padded = np.concatenate([steps, np.zeros((-len(steps) % m, steps.shape[1]))])
            sums = np.cumsum(padded.reshape(-1, m, steps.shape[1]), axis=0)
            under = path[0] + sums.reshape(-1, steps.shape[1])[: len(path)]
        if moving.size == 0:
            return path
        arrived = max(0, int(moving[-1]) + 2 - sum(m - 1 for m in self._lengths))
        return under if np.abs(under[arrived:] - path[-1]).max() <= EXACT_MM else None

    def _apply_smoothing(self, rows: Float) -> Float:
        """Apply the averages to rows (n, d) that rest at both ends."""
        smoother = Smoother(self._smoothing_s, self._dt_s)
        return smoother(np.concatenate([rows, np.repeat(rows[-1:], smoother.settle_rows, axis=0)]))

    def scale_under_smoothing(self, path: Float, stretch: Int, share: Float) -> tuple[Float, Int]:
        """Return the path under the averages at other speeds, with the averages applied again."""
        rows = _compute_row_positions(1.0 / share)
        grid = np.arange(len(path), dtype=np.float64)
        moved = self._apply_smoothing(np.column_stack([np.interp(rows, grid, column) for column in path.T]))
        found = stretch[rows.astype(np.int64)]
        return moved, np.concatenate([found, np.full(len(moved) - found.size, found[-1])])

    def _smooth_values(self, values: Float) -> Float:
        return self._apply_smoothing(values[:, None])[: values.size, 0]

    def stretch_time(self, path: Float, stretch: Int, share: Float) -> tuple[Float, Int]:
        """Stretch time: speeds fall with the share, accelerations with its square."""
        rows = _compute_row_positions(1.0 / self._smooth_values(share))
        return _interpolate_path(path, rows), stretch[rows.astype(np.int64)]

    def scale_distances(self, path: Float, stretch: Int, share: Float) -> tuple[Float, Int]:
        """Shorten each move by the share: speeds and accelerations fall with it, as with constant averages."""
        steps = np.diff(path, axis=0) * self._smooth_values(share)[:-1, None]
        return path[0] + np.concatenate([np.zeros((1, path.shape[1])), np.cumsum(steps, axis=0)]), stretch

    def limit_speed(self, path: Float, stretch: Int, share: Float) -> tuple[Float, Int]:
        """Limit the speed to a share of the segment's fastest: accelerations stay, as where they are the limit."""
        speed = _measure_step_lengths(path)
        most = self._smooth_values(
            np.where(share < 1.0, share * _find_largest_speeds(speed, stretch)[stretch], speed.max())
        )
        rows = _compute_row_positions(np.maximum(1.0, speed / np.maximum(most, 1e-12)))
        return _interpolate_path(path, rows), stretch[rows.astype(np.int64)]


def _measure_step_lengths(path: Float) -> Float:
    """Return (n,) the distance from each row of a path (n, d) to the next."""
    return np.asarray(np.linalg.norm(np.diff(path, axis=0, append=path[-1:]), axis=1))


def _find_largest_speeds(speed: Float, stretch: Int) -> Float:
    fastest = np.zeros(int(stretch[-1]) + 1)
    np.maximum.at(fastest, stretch, speed)
    return fastest


def _compute_row_positions(lasts: Float) -> Float:
    """Return the row reached after 0, 1, 2 .. cycles where row k lasts ``lasts`` (n,) cycles."""
    begins = np.concatenate([[0.0], np.cumsum(lasts[:-1])])
    rows = np.arange(lasts.size, dtype=np.float64)
    return np.asarray(np.interp(np.arange(math.ceil(begins[-1]) + 1), begins, rows))


def _interpolate_path(path: Float, rows: Float) -> Float:
    """Interpolate a demand smoothly: kinks at each row would ask for twice the acceleration."""
    return np.asarray(CubicSpline(np.arange(len(path)), path)(rows))
