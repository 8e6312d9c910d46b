"""The paper's figures as inline SVG: pure functions from records to text.

Figure numbers in the docstrings are those of [DES] (Desforges, Habbadi, Dessein).
"""

from __future__ import annotations

import io
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fdhil.model.feed_drive import simulate_plant
from fdhil.records import Float, Parameters, Window

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

PIECES = 600  # of a coloured path
LONGEST_PIECE = 60  # rows: a longer one would hide where in it the error is
POINTS = 300  # of a picture of a long path
MOST_POINTS = 6000
FAR_APART = 20.0  # errors that differ by more are not seen on one linear scale
LEAST_UM = 0.01
WIDTH = 4.8  # inches
TALL = 0.71  # of its width, an enlarged place
INK, REFERENCE = "#1d2733", "#9aa5b1"
# colours that stay apart in print and for colour-blind readers (Okabe and Ito)
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


@dataclass(frozen=True, slots=True)
class Curve:
    """A labelled path (n, 2) in mm."""

    label: str
    path_mm: Float
    dashed: bool = False


def magnified(reference_mm: Float, actual_mm: Float, factor: float) -> Float:
    """Return the actual path (n, 2) with its deviation from the reference ``factor`` times as large."""
    return reference_mm + factor * (actual_mm - reference_mm)


@contextmanager
def _drawing(width: float = 6.4, height: float = 3.6, above: float = 0.35) -> Iterator[tuple[Figure, Axes, list[str]]]:
    """A figure with one pair of axes, ``above`` them a margin, all in inches; on leaving, the list holds its SVG."""
    from matplotlib import style
    from matplotlib.figure import Figure

    svg: list[str] = []
    with style.context(Path(__file__).with_name("fdhil.mplstyle")):
        figure = Figure(figsize=(width, height))
        # fixed margins: matplotlib's own layout would draw every figure twice
        yield figure, figure.add_axes((0.8 / width, 0.55 / height, 1 - 1.0 / width, 1 - (0.55 + above) / height)), svg
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    body = text.getvalue()
    body = body[body.index("<svg") :]
    # several figures share one page: identifiers must not meet
    mark = f"f{zlib.crc32(body.encode()):08x}"
    body = re.sub(r'id="', f'id="{mark}-', body)
    body = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{mark}-", body)
    svg.append(body)


def signals(window: Window) -> str:
    """Measured voltage, current and speed of one rapid (Figure 4)."""
    time_s = np.arange(window.n) * window.dt_s
    with _drawing() as (_, axes, svg):
        if window.voltage_v is not None:
            axes.plot(time_s, window.voltage_v, label="voltage (V)", color=COLOURS[1])
        axes.plot(time_s, window.current_a, label="current (A)", color=COLOURS[2])
        axes.plot(time_s, window.speed_rad_s, label="speed (rad/s)", color=COLOURS[0])
        axes.set_xlabel("time (s)")
        axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 0.98))
    return svg[0]


def torque(cases: Sequence[tuple[str, Window, Parameters]]) -> str:
    """Estimated torque Jt dw/dt + ft w + Cd sign(w) of rapids at several temperatures (Figure 5)."""
    with _drawing() as (_, axes, svg):
        for (label, window, parameters), colour in zip(cases, COLOURS, strict=False):
            speed = simulated_speed(window, parameters)
            time_s = np.arange(window.n) * window.dt_s
            estimated = (
                parameters.Jt * np.gradient(speed, window.dt_s) + parameters.ft * speed + parameters.Cd * np.sign(speed)
            )
            axes.plot(time_s, estimated, label=label, color=colour)
        axes.set_xlabel("time (s)")
        axes.set_ylabel("torque (N.m)")
        axes.legend()
    return svg[0]


def simulated_speed(window: Window, parameters: Parameters) -> Float:
    """Shaft speed (n,), rad/s, that the model answers to the measured voltage; the measured one without a voltage."""
    if window.voltage_v is None:
        return window.speed_rad_s
    voltage = np.nan_to_num(window.voltage_v)
    _, speed = simulate_plant(parameters, voltage, window.dt_s, window.voltage_sampling)
    return speed


def drift(symbol: str, unit: str, series: Mapping[str, tuple[Float, Float, Float]]) -> str:
    """A parameter against slide-way temperature with two-sigma bars (Figures 6 and 7).

    ``series`` maps an axis to (temperature_c, value, standard deviation), each (n,).
    """
    with _drawing(4.8, 3.2) as (_, axes, svg):
        for (label, (celsius, value, std)), colour in zip(series.items(), COLOURS, strict=False):
            axes.errorbar(celsius, value, 2 * std, fmt="o", ms=3.5, capsize=2, color=colour, label=label, lw=1.0)
            if celsius.size > 2 and np.ptp(celsius) > 0:
                slope, start = np.polyfit(celsius, value, 1)
                span = np.array([celsius.min(), celsius.max()])
                axes.plot(span, start + slope * span, color=colour, lw=0.9, ls="--")
        axes.set_xlabel("slide-way temperature (degC)")
        axes.set_ylabel(f"{symbol} ({unit})")
        axes.legend()
    return svg[0]


def model_against_drive(window: Window, parameters: Parameters, fit_percent: float | None) -> str:
    """Measured speed and the model's answer to the same voltage (Figure 8)."""
    time_s = np.arange(window.n) * window.dt_s
    fit = "" if fit_percent is None else f", fit {fit_percent:.2f} %"
    with _drawing() as (_, axes, svg):
        axes.plot(time_s, window.speed_rad_s, color=REFERENCE, lw=2.4, label="drive, measured")
        axes.plot(time_s, simulated_speed(window, parameters), color=COLOURS[1], lw=1.0, label=f"model{fit}")
        axes.set_xlabel("time (s)")
        axes.set_ylabel("speed (rad/s)")
        axes.legend()
    return svg[0]


def path(reference_mm: Float, points: Mapping[str, tuple[float, float]]) -> str:
    """The programmed path with its named points (Figures 10 and 19)."""
    with _drawing() as (_, axes, svg):
        axes.plot(*reference_mm.T, color=INK)
        for name, (x, y) in points.items():
            axes.plot(x, y, "o", ms=3.5, color=COLOURS[1])
            axes.annotate(name, (x, y), xytext=(4, 5), textcoords="offset points", color=COLOURS[1], fontweight="bold")
        _equal(axes)
    return svg[0]


def corner(
    curves: Sequence[Curve],
    place_mm: tuple[float, float],
    half_width_mm: float,
    names: tuple[str, str] = ("X", "Y"),
    on_path: bool = True,
) -> str:
    """A place of the path enlarged (Figures 11-15, 17, 18, 20): reference grey, the others in colour.

    The NC rounds its corners by far more than the drives err, so the view is centred on the point of the reference (the
    first curve) that is nearest to ``place_mm``, unless ``on_path`` is false.
    """
    reference = curves[0].path_mm
    centre = np.asarray(place_mm)
    if on_path:
        centre = reference[np.argmin(np.hypot(*(reference - centre).T))]
    columns = len(curves) if len(curves) < 4 else 2
    above = 0.35 if len(curves) < 4 else 0.55
    with _drawing(WIDTH, (WIDTH - 1.0) * TALL + 0.55 + above, above) as (_, axes, svg):
        for k, curve in enumerate(_near(curves, centre, max(3 * half_width_mm, 1.0))):
            colour, width = (REFERENCE, 3.4) if k == 0 else (COLOURS[(k - 1) % len(COLOURS)], 1.3)
            axes.plot(*curve.path_mm.T, color=colour, lw=width, ls="--" if curve.dashed else "-", label=curve.label)
        x, y = centre
        axes.set_xlim(x - half_width_mm, x + half_width_mm)
        axes.set_ylim(y - TALL * half_width_mm, y + TALL * half_width_mm)
        axes.ticklabel_format(useOffset=False)
        axes.locator_params(nbins=6)
        axes.set_xlabel(f"{names[0]} (mm)")
        axes.set_ylabel(f"{names[1]} (mm)")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns)
    return svg[0]


def _near(curves: Sequence[Curve], centre_mm: Float, distance_mm: float) -> Iterator[Curve]:
    """Blank what lies outside the view: a page with twenty whole paths would be large and slow."""
    for curve in curves:
        inside = np.all(np.abs(curve.path_mm - centre_mm) < distance_mm, axis=1, keepdims=True)
        yield Curve(curve.label, np.where(inside, curve.path_mm, np.nan), curve.dashed)


def contour_errors(dt_s: float, cases: Mapping[str, Float]) -> str:
    """Contour error (um) along the path on a grid of ``dt_s``, one curve a case.

    Where one is far smaller than another the scale is logarithmic; what is longer than the picture is wide is drawn by
    its largest values.
    """
    largest = [float(error_um.max()) for error_um in cases.values()]
    far_apart = max(largest) > FAR_APART * max(min(largest), LEAST_UM)
    with _drawing(4.8, 3.2) as (_, axes, svg):
        for (label, error_um), colour in zip(cases.items(), COLOURS, strict=False):
            time_s, peaks = _peaks(error_um, dt_s)
            drawn = np.maximum(peaks, LEAST_UM) if far_apart else peaks
            axes.plot(time_s, drawn, label=label, color=colour, lw=1.1)
        axes.set_xlabel("time (s)")
        axes.set_ylabel("contour error (um)")
        if far_apart:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(bottom=LEAST_UM if far_apart else 0.0, top=None if max(largest) > LEAST_UM else LEAST_UM)
        if len(cases) > 1:
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return svg[0]


def _peaks(values: Float, dt_s: float) -> tuple[Float, Float]:
    """Return times and values (m,), the largest of each stretch where there are more than can be drawn."""
    per = -(-values.size // MOST_POINTS)
    peaks: Float = np.maximum.reduceat(values, np.arange(0, values.size, per))
    return np.asarray(np.arange(peaks.size) * (per * dt_s)), peaks


def axis_errors(time_s: Float, cases: Mapping[str, Float], axis: str) -> str:
    """A place of one axis enlarged: its position less the desired one over time, um, one curve a case."""
    with _drawing(4.8, 3.6) as (_, axes, svg):
        axes.axhline(0.0, color=REFERENCE, lw=3.4, label="desired")
        for (label, error_um), colour in zip(cases.items(), COLOURS, strict=False):
            axes.plot(time_s, error_um, label=label, color=colour)
        axes.set_xlabel("time (s)")
        axes.set_ylabel(f"{axis} ahead of the desired (um)")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return svg[0]


def error_map(path_mm: Float, error_um: Float, largest_um: float, names: tuple[str, str] = ("X", "Y")) -> str:
    """The path (n, 2) coloured by its contour error, from 0 to ``largest_um``.

    It is drawn in at most ``PIECES`` pieces, each in the colour of its largest error, the larger on top; a longer path
    by points, each in the colour of the largest error there.
    """
    across, along = np.maximum(np.ptp(path_mm, axis=0), 1e-9)
    height = float(np.clip(3.2 * along / across, 1.4, 4.6)) + 0.9  # of the picture: the path fills it
    with _drawing(WIDTH, height) as (figure, axes, svg):
        if len(path_mm) > PIECES * LONGEST_PIECE:
            drawn: ScalarMappable = _as_points(axes, path_mm, error_um)
        else:
            drawn = _as_lines(axes, path_mm, error_um)
        drawn.set_cmap("viridis")
        drawn.set_clim(0, max(largest_um, LEAST_UM))
        left, bottom, _, tall = axes.get_position().bounds
        axes.set_position((left, bottom, 1 - left - 0.9 / WIDTH, tall))
        beside = figure.add_axes((1 - 0.7 / WIDTH, bottom, 0.13 / WIDTH, tall))
        figure.colorbar(drawn, cax=beside)
        beside.set_title("um", fontsize=8.5)
        _equal(axes, names)
    return svg[0]


def _as_lines(axes: Axes, path_mm: Float, error_um: Float) -> LineCollection:
    from matplotlib.collections import LineCollection

    edges = np.unique(np.linspace(0, len(path_mm) - 1, PIECES + 1).round().astype(np.int64))
    pieces = list(pairwise(edges.tolist()))
    worst = np.array([error_um[first : last + 1].max() for first, last in pieces])
    order = np.argsort(worst, kind="stable")
    lines = [path_mm[pieces[k][0] : pieces[k][1] + 1][:: max(1, len(path_mm) // MOST_POINTS)] for k in order]
    ends = [path_mm[pieces[k][1]] for k in order]
    joined = [np.vstack([line, end]) for line, end in zip(lines, ends, strict=True)]
    drawn = LineCollection(joined, array=worst[order], lw=3.5, capstyle="round")
    axes.add_collection(drawn)
    axes.autoscale()
    return drawn


def _as_points(axes: Axes, path_mm: Float, error_um: Float) -> AxesImage:
    """Draw a picture of ``POINTS`` points along the longer side: as large a file however long the path is."""
    low = path_mm.min(axis=0)
    size_mm = max(float(np.ptp(path_mm, axis=0).max()), 1e-9) / POINTS
    columns, rows = (np.ptp(path_mm, axis=0) / size_mm).astype(np.int64) + 1
    # a step longer than a point leaves points between its rows
    between = math.ceil(float(np.abs(np.diff(path_mm, axis=0)).max()) / size_mm) + 1
    largest = np.full((rows, columns), -1.0)
    for part in np.arange(between) / between:
        at = path_mm[:-1] + part * np.diff(path_mm, axis=0)
        column, row = ((at - low) / size_mm).astype(np.int64).T
        np.maximum.at(largest, (row, column), np.maximum(error_um[:-1], error_um[1:]))
    right, top = low + size_mm * np.array([columns, rows])
    seen = np.ma.masked_less(largest, 0.0)
    return axes.imshow(seen, origin="lower", extent=(low[0], right, low[1], top), interpolation="nearest", zorder=2)


def _equal(axes: Axes, names: tuple[str, str] = ("X", "Y")) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{names[0]} (mm)")
    axes.set_ylabel(f"{names[1]} (mm)")
