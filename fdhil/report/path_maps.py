"""Draws paths in a plane as inline SVG: start and direction, named positions, error by colour."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from fdhil.identification import find_longest_run
from fdhil.records import Float
from fdhil.report.svg_drawing import (
    COLOURS,
    INK,
    LEGEND_LINE,
    REFERENCE,
    SHADES,
    compute_legend_layout,
    open_drawing,
    place_legend_above,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.image import AxesImage

PIECES = 600  # of a coloured path
LONGEST_PIECE = 60  # samples: a longer one would hide the position of the error
POINTS = 300  # of a picture of a long path
MOST_POINTS = 6000
LEAST_UM = 0.01
WIDTH = 4.8  # inches
TALL = 0.71  # of its width: height of an enlarged detail
ARROWS = 5  # along a path
ARROW = 0.035  # of the picture: length of path under an arrow


@dataclass(frozen=True, slots=True)
class Curve:
    """A labelled path (n, 2) in mm."""

    label: str
    path_mm: Float
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class MapPosition:
    """A named position on a path, mm."""

    name: str
    x_mm: float
    y_mm: float


def make_error_colormap() -> Colormap:
    """Return the colour map of errors, the same as on the page *Program*."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("error", SHADES)


def magnify_deviation(reference_mm: Float, actual_mm: Float, factor: float) -> Float:
    """Return the actual path (n, 2) with its deviation from the reference magnified by ``factor``."""
    return reference_mm + factor * (actual_mm - reference_mm)


def draw_path(reference_mm: Float, points: Mapping[str, tuple[float, float]]) -> str:
    """Draw the programmed path with its start, its direction and its named points (Figures 10 and 19)."""
    with open_drawing(6.4, _compute_height(reference_mm, 6.4), 0.25) as made:
        made.axes.plot(*reference_mm.T, color=REFERENCE, lw=2.0)
        _set_equal_axes(made.axes)
        _mark_direction(made.axes, reference_mm)
        _mark_positions(made.axes, [MapPosition(name, *at) for name, at in points.items()])
        made.alt = (
            f"The programmed path, {_describe_extent(reference_mm)}, with {', '.join(points) or 'no'} named points."
        )
        made.data = _describe_frame(made.axes, ("X", "Y"))
    return made.svg


def draw_path_detail(
    curves: Sequence[Curve],
    place_mm: tuple[float, float],
    half_width_mm: float,
    names: tuple[str, str] = ("X", "Y"),
    on_path: bool = True,
) -> str:
    """Draw a magnified detail of the path (Figures 11-15, 17, 18, 20): reference grey, the others in colour.

    The NC rounds its corners by far more than the drives err, so the view is centred on the point of the reference (the
    first curve) that is nearest to ``place_mm``, unless ``on_path`` is false.
    """
    reference = curves[0].path_mm
    centre = np.asarray(place_mm)
    if on_path:
        centre = reference[np.argmin(np.hypot(*(reference - centre).T))]
    columns, rows = compute_legend_layout([curve.label for curve in curves], WIDTH - 1.0)
    above = rows * LEGEND_LINE + 0.15
    with open_drawing(WIDTH, (WIDTH - 1.0) * TALL + 0.55 + above, above) as made:
        axes = made.axes
        for k, curve in enumerate(_hide_outside_view(curves, centre, max(3 * half_width_mm, 1.0))):
            colour, width = (REFERENCE, 3.4) if k == 0 else (COLOURS[(k - 1) % len(COLOURS)], 1.3)
            axes.plot(*curve.path_mm.T, color=colour, lw=width, ls="--" if curve.dashed else "-", label=curve.label)
        x, y = centre
        axes.set_xlim(x - half_width_mm, x + half_width_mm)
        axes.set_ylim(y - TALL * half_width_mm, y + TALL * half_width_mm)
        axes.ticklabel_format(useOffset=False)
        axes.locator_params(nbins=5)
        axes.set_xlabel(f"{names[0]} (mm)")
        axes.set_ylabel(f"{names[1]} (mm)")
        inside = np.all(np.abs(reference - centre) < [half_width_mm, TALL * half_width_mm], axis=1)
        _draw_arrow(axes, reference[slice(*find_longest_run(inside))], 0.3)
        place_legend_above(axes, columns)
        shown = ", ".join(curve.label for curve in curves)
        made.alt = f"The path around {names[0]} {x:.1f} mm, {names[1]} {y:.1f} mm: {shown}."
        made.data = _describe_frame(axes, names)
    return made.svg


def _hide_outside_view(curves: Sequence[Curve], centre_mm: Float, distance_mm: float) -> Iterator[Curve]:
    """Blank the curves outside the view: a page with twenty whole paths would be large and slow."""
    for curve in curves:
        inside = np.all(np.abs(curve.path_mm - centre_mm) < distance_mm, axis=1, keepdims=True)
        yield Curve(curve.label, np.where(inside, curve.path_mm, np.nan), curve.dashed)


def draw_error_map(
    path_mm: Float,
    error_um: Float,
    largest_um: float,
    names: tuple[str, str] = ("X", "Y"),
    places: Sequence[MapPosition] = (),
    least_um: float | None = None,
) -> str:
    """Draw the path (n, 2) coloured by its contour error, from 0 to ``largest_um``, or logarithmically from
    ``least_um``.

    It is drawn in at most ``PIECES`` pieces, each in the colour of its largest error, the larger on top; a longer path
    by points. Maps to be compared need the same scale.
    """
    with open_drawing(WIDTH, _compute_height(path_mm, WIDTH - 0.3), 0.35) as made:
        axes = made.axes
        if len(path_mm) > PIECES * LONGEST_PIECE:
            drawn: ScalarMappable = _draw_points(axes, path_mm, error_um)
        else:
            drawn = _draw_lines(axes, path_mm, error_um)
        drawn.set_cmap(make_error_colormap())
        drawn.set_norm(_make_colour_scale(largest_um, least_um))
        left, bottom, _, tall = axes.get_position().bounds
        axes.set_position((left, bottom, 1 - left - 0.95 / WIDTH, tall))
        scale = made.figure.add_axes((1 - 0.75 / WIDTH, bottom, 0.13 / WIDTH, tall))
        made.figure.colorbar(drawn, cax=scale, format=None if least_um is None else "{x:g}")
        scale.set_title("um", fontsize=8.5)
        _set_equal_axes(axes, names)
        _mark_direction(axes, path_mm)
        _mark_positions(axes, places)
        worst = int(np.argmax(error_um))
        where = f"{names[0]} {path_mm[worst, 0]:.1f} mm, {names[1]} {path_mm[worst, 1]:.1f} mm"
        made.alt = (
            f"Map of the contour error, {_describe_extent(path_mm)}: {error_um[worst]:.3g} um at most, at {where}."
        )
        made.data = _describe_frame(axes, names) | {"unit": "um", "at": _sample_errors(path_mm, error_um)}
    return made.svg


def _make_colour_scale(largest_um: float, least_um: float | None) -> Normalize:
    from matplotlib.colors import LogNorm, Normalize

    largest = max(largest_um, LEAST_UM)
    if least_um is None:
        return Normalize(0, largest)
    return LogNorm(min(max(least_um, LEAST_UM), largest / 10), largest, clip=True)


def _draw_lines(axes: Axes, path_mm: Float, error_um: Float) -> LineCollection:
    from matplotlib.collections import LineCollection

    pieces = _split_path(len(path_mm))
    worst = np.array([error_um[first : last + 1].max() for first, last in pieces])
    order = np.argsort(worst, kind="stable")
    lines = [path_mm[pieces[k][0] : pieces[k][1] + 1][:: max(1, len(path_mm) // MOST_POINTS)] for k in order]
    ends = [path_mm[pieces[k][1]] for k in order]
    joined = [np.vstack([line, end]) for line, end in zip(lines, ends, strict=True)]
    drawn = LineCollection(joined, array=worst[order], lw=3.5, capstyle="round")
    axes.add_collection(drawn)
    axes.autoscale()
    return drawn


def _split_path(n: int) -> list[tuple[int, int]]:
    edges = np.unique(np.linspace(0, n - 1, PIECES + 1).round().astype(np.int64))
    return list(pairwise(edges.tolist()))


def _draw_points(axes: Axes, path_mm: Float, error_um: Float) -> AxesImage:
    """Draw a picture of ``POINTS`` points along the longer side: its size does not depend on the length of the path."""
    low = path_mm.min(axis=0)
    size_mm = max(float(np.ptp(path_mm, axis=0).max()), 1e-9) / POINTS
    columns, rows = (np.ptp(path_mm, axis=0) / size_mm).astype(np.int64) + 1
    # a step longer than a point needs points between its samples
    between = math.ceil(float(np.abs(np.diff(path_mm, axis=0)).max()) / size_mm) + 1
    largest = np.full((rows, columns), -1.0)
    for part in np.arange(between) / between:
        at = path_mm[:-1] + part * np.diff(path_mm, axis=0)
        column, row = ((at - low) / size_mm).astype(np.int64).T
        np.maximum.at(largest, (row, column), np.maximum(error_um[:-1], error_um[1:]))
    right, top = low + size_mm * np.array([columns, rows])
    seen = np.ma.masked_less(largest, 0.0)
    return axes.imshow(seen, origin="lower", extent=(low[0], right, low[1], top), interpolation="nearest", zorder=2)


def _sample_errors(path_mm: Float, error_um: Float) -> list[list[float]]:
    """Return x, y (mm) and error (um) of the worst sample of each piece, shown under the pointer."""
    rows = [first + int(np.argmax(error_um[first : last + 1])) for first, last in _split_path(len(path_mm))]
    worst = np.column_stack([path_mm[rows], error_um[rows]])
    return [[round(x, 2), round(y, 2), float(f"{um:.3g}")] for x, y, um in worst.tolist()]


def _compute_height(path_mm: Float, width: float) -> float:
    across, along = np.maximum(np.ptp(path_mm, axis=0), 1e-9)
    return float(np.clip((width - 1.3) * along / across, 1.4, 4.6)) + 0.9


def _describe_extent(path_mm: Float) -> str:
    across, along = np.ptp(path_mm, axis=0)
    return f"{across:.0f} mm by {along:.0f} mm"


def _mark_direction(axes: Axes, path_mm: Float) -> None:
    axes.plot(*path_mm[0], "o", ms=8, mfc="white", mec=INK, mew=1.3, zorder=6)
    axes.annotate("start", path_mm[0], xytext=(7, -9), textcoords="offset points", fontsize=8, color=INK, zorder=6)
    for share in (np.arange(ARROWS) + 0.5) / ARROWS:
        _draw_arrow(axes, path_mm, float(share))


def _draw_arrow(axes: Axes, path_mm: Float, share: float) -> None:
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path_mm, axis=0).T))]) if len(path_mm) > 1 else np.zeros(1)
    if run[-1] <= 0.0:
        return
    head, reach = share * float(run[-1]), ARROW * float(np.ptp(path_mm, axis=0).max())
    begin, end = (
        (float(np.interp(s, run, path_mm[:, 0])), float(np.interp(s, run, path_mm[:, 1]))) for s in (head - reach, head)
    )
    if begin != end:
        look: dict[str, Any] = {"arrowstyle": "-|>,head_width=0.28,head_length=0.5", "color": INK, "lw": 0.0}
        axes.annotate("", end, begin, arrowprops=look | {"shrinkA": 0, "shrinkB": 0}, zorder=5)


def _mark_positions(axes: Axes, places: Sequence[MapPosition]) -> None:
    box: dict[str, Any] = {"boxstyle": "round,pad=0.25", "fc": "white", "ec": COLOURS[1], "lw": 0.9}
    line: dict[str, Any] = {"arrowstyle": "-", "color": COLOURS[1], "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    for place in places:
        at = (place.x_mm, place.y_mm)
        axes.plot(*at, "o", ms=3.5, color=COLOURS[1], zorder=6)
        axes.annotate(
            place.name, at, xytext=(9, 9), textcoords="offset points", color=COLOURS[1], fontweight="bold", fontsize=8,
            bbox=box, arrowprops=line, zorder=7,
        )  # fmt: skip


def _describe_frame(axes: Axes, names: tuple[str, str]) -> dict[str, Any]:
    """Return the position of the axes in the picture (points, from its top left) and their limits in mm."""
    axes.apply_aspect()
    height = axes.get_figure(root=True).bbox_inches.height * 72  # type: ignore[union-attr]
    (left, bottom), (right, top) = (axes.transAxes.transform(at) * 72 / axes.figure.dpi for at in ((0, 0), (1, 1)))
    box = [round(float(v), 2) for v in (left, height - top, right, height - bottom)]
    return {"kind": "map", "names": list(names), "box": box,
            "x": [float(v) for v in axes.get_xlim()], "y": [float(v) for v in axes.get_ylim()]}  # fmt: skip


def _set_equal_axes(axes: Axes, names: tuple[str, str] = ("X", "Y")) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set_xlabel(f"{names[0]} (mm)")
    axes.set_ylabel(f"{names[1]} (mm)")
