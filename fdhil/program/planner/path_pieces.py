"""Motions as rows of a table: lines and arcs with their lengths, limits, and tangents at both ends."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fdhil.program.motions import PLANE_AXES, PLANES, Arc, Feed, Place, Rapid, SweptArc, compute_end
from fdhil.program.planner.axis_limits import AxisLimits
from fdhil.records import Float, Int

# columns of a piece; the kind of an arc is the index of its plane
KIND, LINE, RAPID, LENGTH, SPEED, ACCELERATION, JERK, BLENDS, TOLERANCE = range(9)
START, STOP = slice(9, 18), slice(18, 27)
_EXTRA = slice(27, 33)  # of an arc: centre, radius at start and end, angle at the start, angle swept
WIDTH = 33
_GROUPS = (slice(0, 3), slice(6, 9), slice(3, 6))  # F refers to the length of X Y Z, else of U V W, else of A B C
LINE_KIND = -1.0
_NO_EXTRA = (0.0,) * 6
Row = tuple[float, ...]


def measure_length(start: Place, end: Place) -> float:
    """Return the length of a straight move: mm of X Y Z, else of U V W, else degrees."""
    return next((length for part in _GROUPS if (length := math.dist(start[part], end[part])) > 0.0), 0.0)


def limit_path_speed(start: Place, end: Place, limits: AxisLimits) -> float:
    """Return the largest speed along the path, which limits lengths but not angles."""
    turns_alone = start[:3] == end[:3] and start[6:] == end[6:]
    return math.inf if turns_alone else limits.path_speed


def build_piece(motion: Rapid | Feed | Arc, start: Place, limits: AxisLimits) -> Row | None:
    """Return the row of one motion, None if it has no length. Speeds keep each axis within its limit."""
    extra: Row = _NO_EXTRA
    kind = LINE_KIND
    end = compute_end(motion, start)
    if isinstance(motion, Arc):
        path = SweptArc.create_from_arc(motion, start)
        kind, length = float(PLANES.index(motion.plane)), path.length_mm
        share = [abs(b - a) / length if length else 0.0 for a, b in zip(start, end, strict=True)]
        for axis in PLANE_AXES[motion.plane][:2]:
            share[axis] = 1.0
        extra = (path.centre.real, path.centre.imag, *path.radii, path.begin_rad, path.angle_rad)
    else:
        length = measure_length(start, end)
        share = [abs(b - a) / length if length else 0.0 for a, b in zip(start, end, strict=True)]
    if length <= 0.0:
        return None
    speed, acceleration, jerk = (
        min(limit / part for limit, part in zip(axes, share, strict=True) if part)
        for axes in (limits.speed, limits.acceleration, limits.jerk)
    )
    speed = min(speed, limit_path_speed(start, end, limits))
    if not isinstance(motion, Rapid):
        speed = min(speed, motion.feed / 60.0)
    corner = motion.corner
    return (
        kind, float(motion.line), float(isinstance(motion, Rapid)), length, speed, acceleration, jerk,
        float(corner.mode == "blend"), corner.tolerance_mm, *start, *end, *extra,
    )  # fmt: skip


def _iterate_arcs(pieces: Float) -> Iterator[tuple[Int, tuple[int, int, int]]]:
    for plane, name in enumerate(PLANES):
        rows = np.flatnonzero(pieces[:, KIND] == plane)
        if rows.size:
            yield rows, PLANE_AXES[name]


def compute_points(pieces: Float, distance: Float) -> Float:
    """Return the points (n, 9) of pieces (n, WIDTH) at ``distance`` (n,) mm from their starts."""
    return compute_points_at_share(pieces, np.clip(distance / pieces[:, LENGTH], 0.0, 1.0))


def compute_points_at_share(pieces: Float, share: Float) -> Float:
    """Return the points (n, 9) of pieces (n, WIDTH) at ``share`` (n,) of their lengths, 0 to 1."""
    start, stop = pieces[:, START], pieces[:, STOP]
    position = start + (stop - start) * share[:, None]
    at_end = share >= 1.0
    for rows, (first, second, _) in _iterate_arcs(pieces):
        along = share[rows]
        x, y, begin_radius, end_radius, begin_angle, swept = pieces[rows, _EXTRA].T
        radius = begin_radius + (end_radius - begin_radius) * along
        angle = begin_angle + swept * along
        position[rows, first] = x + radius * np.cos(angle)
        position[rows, second] = y + radius * np.sin(angle)
    position[at_end] = stop[at_end]
    return np.asarray(position)


def compute_directions(pieces: Float, at_end: bool) -> tuple[Float, Float]:
    """Return tangents (n, 9) and curvature vectors (n, 9), per mm of path, at the starts or at the ends of pieces."""
    length = pieces[:, LENGTH, None]
    tangent = (pieces[:, STOP] - pieces[:, START]) / length
    curvature = np.zeros_like(tangent)
    for rows, (first, second, _) in _iterate_arcs(pieces):
        _, _, begin_radius, end_radius, begin_angle, swept = pieces[rows, _EXTRA].T
        radius, angle = (end_radius, begin_angle + swept) if at_end else (begin_radius, begin_angle)
        rate = swept / pieces[rows, LENGTH]
        growth = (end_radius - begin_radius) / pieces[rows, LENGTH]
        c, s = np.cos(angle), np.sin(angle)
        tangent[rows, first] = growth * c - radius * rate * s
        tangent[rows, second] = growth * s + radius * rate * c
        curvature[rows, first] = -radius * rate**2 * c
        curvature[rows, second] = -radius * rate**2 * s
    return tangent, curvature


def compute_curvature(pieces: Float) -> Float:
    """Return the curvature (n,) of pieces, 1/mm: for an arc the one at its smaller radius."""
    extra = pieces[:, _EXTRA]
    radius = np.minimum(extra[:, 2], extra[:, 3])
    curved = (pieces[:, KIND] >= 0.0) & (radius > 0.0)
    return np.where(curved, 1.0 / np.where(curved, radius, 1.0), 0.0)
