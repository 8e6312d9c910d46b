"""Reduces a forecast to what a browser draws: all or a part of its path, by the fewest points that look the same."""

import heapq
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fdhil.prediction import WINDOW_S, find_nearest_points_mm
from fdhil.records import Bool, Float, Int
from fdhil.web.forecast.forecast_files import AFTER, BEFORE, StoredForecast

MOST_POINTS = 5000
WHOLE_ROWS = 3000  # up to which every row is sent, with the predicted table path
MOST_ROWS = 400_000  # examined in one view
STRETCH = 4096  # rows simplified at once
FINE = 1 / 1500  # of the view: the smallest visible distance
SHADE = 0.03  # of the colour scale
FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
SEEN = 0.15  # of the view, for the largest error
BESIDE = 0.1  # of the view, as a margin around it
MOST_COURSE = 1500


class ViewBox(NamedTuple):
    """A rectangle in a plane, mm."""

    left: float
    right: float
    bottom: float
    top: float


def find_plane(forecast: StoredForecast, asked: Sequence[str]) -> tuple[int, int]:
    """Return the columns of a plane's axes. Raises ValueError for an unknown axis."""
    across, along = (forecast.axes.index(axis) for axis in asked)
    return across, along


def make_view(forecast: StoredForecast, plane: tuple[int, int], box: ViewBox | None, factor: float) -> dict[str, Any]:
    """Return the path inside ``box`` (None: all of it) as runs of points, each with the figures up to the next.

    A run's ``before_um`` and ``after_um`` are the largest contour errors of each piece. With few rows inside, all are
    returned (``whole``) together with the predicted table path, its distance from the path enlarged by ``factor`` (0:
    as far as the view has room).
    """
    flat = _project_path(forecast, plane)
    inside = _select_inside(flat, box)
    count = int(inside.sum())
    whole = count <= WHOLE_ROWS
    step = 1 if whole else -(-count // MOST_ROWS)
    size_mm = float(np.ptp(flat, axis=0).max()) if box is None else max(box.right - box.left, box.top - box.bottom)
    factor = factor or _choose_enlargement(forecast, inside, size_mm)
    runs = []
    for first, last in _find_runs(inside):
        rows = np.arange(first, last)[::step]
        most = max(8, MOST_POINTS * rows.size * step // max(1, count))
        points = rows if whole else rows[select_knots(_scale_to_view(forecast, flat, rows, size_mm), most)]
        run = _make_run(forecast, flat, points, last)
        if whole:
            run |= {
                "table": [
                    _enlarge_table_path(forecast, plane, slice(first, last), case, factor) for case in (BEFORE, AFTER)
                ]
            }
        runs.append(run)
    return {"rows": count, "whole": whole, "factor": factor, "runs": runs}


def _choose_enlargement(forecast: StoredForecast, inside: Bool, size_mm: float) -> float:
    largest_mm = float(np.max(forecast.contour_um[BEFORE], where=inside, initial=0.0)) * 1e-3
    return float(max(f for f in FACTORS if f == 1 or f * largest_mm <= SEEN * size_mm))


def _project_path(forecast: StoredForecast, plane: tuple[int, int]) -> Float:
    flat = np.asarray(forecast.path_mm[:, list(plane)], dtype=np.float64)
    if plane[0] == plane[1]:
        flat[:, 1] = 0.0
    return flat


def _select_inside(flat: Float, box: ViewBox | None) -> Bool:
    if box is None:
        return np.ones(len(flat), dtype=np.bool_)
    across, along = BESIDE * (box.right - box.left), BESIDE * (box.top - box.bottom)
    low = np.array([box.left - across, box.bottom - along])
    high = np.array([box.right + across, box.top + along])
    inside = np.asarray(np.all((flat >= low) & (flat <= high), axis=1))
    # a step across the edge of the view is drawn completely
    inside[:-1] |= inside[1:].copy()
    inside[1:] |= inside[:-1].copy()
    return inside


def _find_runs(inside: Bool) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def _scale_to_view(forecast: StoredForecast, flat: Float, rows: Int, size_mm: float) -> Float:
    """Return the rows (m, 4), position and both colours, in units of the smallest visible difference."""
    scale = forecast.document["scale"]
    least_um, largest_um = scale["least_um"], max(scale["largest_um"], 1e-6)
    errors = np.asarray(forecast.contour_um[:, rows], dtype=np.float64)
    if least_um is None:
        shades = errors / largest_um
    else:
        decades = np.log10(max(largest_um / least_um, 10.0))
        shades = np.log10(np.maximum(errors, least_um) / least_um) / decades
    place = (flat[rows] - flat[rows[0]]) / max(size_mm * FINE, 1e-9)
    return np.column_stack([place, shades.T / SHADE])


def select_knots(seen: Float, most: int) -> Int:
    """Return the rows (k,) that divide a path (m, d) into straight pieces with deviations below 1.

    The path is parametrised by its length. The piece with the largest deviation is divided first, so that ``most``
    points are the best possible [Douglas, Peucker 1973, with the length as the parameter].
    """
    end = len(seen) - 1
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(seen[:, :2], axis=0).T))])
    knot_rows = {0, end, *range(STRETCH, end, STRETCH)}
    starts = sorted(knot_rows)
    waiting = [_find_worst_point(seen, way, first, last) for first, last in pairwise(starts)]
    heapq.heapify(waiting)
    while waiting and len(knot_rows) < most:
        off, first, at, last = heapq.heappop(waiting)
        if -off < 1.0:
            break
        knot_rows.add(at)
        for begin, stop in ((first, at), (at, last)):
            if stop - begin > 1:
                heapq.heappush(waiting, _find_worst_point(seen, way, begin, stop))
    return np.array(sorted(knot_rows))


def _find_worst_point(seen: Float, way: Float, first: int, last: int) -> tuple[float, int, int, int]:
    """Return the negative of a piece's largest deviation (for a heap), its first row, that row, and its last row."""
    length = way[last] - way[first]
    share = (way[first : last + 1] - way[first]) / length if length > 0 else np.linspace(0, 1, last - first + 1)
    chord = seen[first] + share[:, None] * (seen[last] - seen[first])
    off = np.abs(seen[first : last + 1] - chord).max(axis=1)
    at = int(np.argmax(off))
    return -float(off[at]), first, first + at, last


def _make_run(forecast: StoredForecast, flat: Float, points: Int, last: int) -> dict[str, Any]:
    first = int(points[0])
    starts = points - first
    before, after = (
        np.maximum.reduceat(np.asarray(forecast.contour_um[case, first:last]), starts) for case in (BEFORE, AFTER)
    )
    feed = np.maximum.reduceat(forecast.compute_feed_mm_min(slice(first, last)), starts)
    return {
        "row": points.tolist(),
        "line": forecast.line[points].tolist(),
        "x_mm": round_values(flat[points, 0], 5),
        "y_mm": round_values(flat[points, 1], 5),
        "before_um": round_values(before, 3),
        "after_um": round_values(after, 3),
        "feed_mm_min": round_values(feed, 0),
    }


def _enlarge_table_path(
    forecast: StoredForecast, plane: tuple[int, int], rows: slice, case: int, factor: float
) -> Mapping[str, list[float]]:
    margin = round(WINDOW_S / forecast.dt_s)
    around = slice(max(0, rows.start - margin), rows.stop + margin)
    actual = forecast.compute_table_mm(case, rows)
    path = np.asarray(forecast.path_mm[around])
    nearest = find_nearest_points_mm(path, actual, forecast.dt_s, rows.start - around.start)
    drawn = (nearest + factor * (actual - nearest))[:, list(plane)]
    if plane[0] == plane[1]:
        drawn[:, 1] = 0.0
    return {"x_mm": round_values(drawn[:, 0], 6), "y_mm": round_values(drawn[:, 1], 6)}


def make_error_curve(forecast: StoredForecast, first: int, last: int) -> dict[str, Any]:
    """Return contour errors and feed over time, the largest of each of at most ``MOST_COURSE`` intervals."""
    starts = np.arange(0, last - first, max(1, -(-(last - first) // MOST_COURSE)))
    before, after = (
        np.maximum.reduceat(np.asarray(forecast.contour_um[case, first:last]), starts) for case in (BEFORE, AFTER)
    )
    return {
        "time_s": round_values((first + starts) * forecast.dt_s, 4),
        "before_um": round_values(before, 3),
        "after_um": round_values(after, 3),
        "feed_mm_min": round_values(np.maximum.reduceat(forecast.compute_feed_mm_min(slice(first, last)), starts), 0),
    }


def locate_line(forecast: StoredForecast, line: int) -> dict[str, Any] | None:
    """Return where a program line has its largest error, and its extent; None if it orders no motion."""
    rows = np.flatnonzero(np.asarray(forecast.line) == line)
    if rows.size == 0:
        return None
    row = int(rows[np.argmax(forecast.contour_um[BEFORE][rows])])
    path = np.asarray(forecast.path_mm[rows])
    return {
        "line": line,
        "row": row,
        "start_s": round(float(rows[0] * forecast.dt_s), 6),
        "end_s": round(float((rows[-1] + 1) * forecast.dt_s), 6),
        "at_mm": round_values(forecast.path_mm[row], 6),
        "low_mm": round_values(path.min(axis=0), 6),
        "high_mm": round_values(path.max(axis=0), 6),
        "before_um": round(float(forecast.contour_um[BEFORE][row]), 3),
        "after_um": round(float(forecast.contour_um[AFTER][row]), 3),
        "feed_mm_min": round(float(forecast.compute_feed_mm_min(slice(row, row + 1))[0]), 0),
    }


def round_values(values: npt.ArrayLike, decimals: int) -> list[float]:
    """Return values as JSON data, without excess digits."""
    return [float(value) for value in (np.round(np.asarray(values, dtype=np.float64), decimals) + 0.0).tolist()]
