"""Figures of ``fdhil paper`` beyond those of the report, in the same style; most are interactive charts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.cli.paper.derivative_operators import OPERATORS
from fdhil.records import INTERVAL_95, PARAMETERS, Bool, Float
from fdhil.report import (
    COLOURS,
    INK,
    REFERENCE,
    Chart,
    Panel,
    Trace,
    compute_legend_layout,
    open_drawing,
    place_legend_above,
    render_svg,
)

WIDTH = 6.4  # inches
TALL = 4.8
BELOW_SHARE = 0.8  # of the panel above


@dataclass(frozen=True, slots=True)
class View:
    """Drawn range: an interval in X (mm) and ``band_mm`` around a level in Y (mm).

    ``fine``: Y is shown in um relative to the level.
    """

    x_mm: tuple[float, float]
    level_mm: float
    band_mm: float
    fine: bool = False

    def select_rows(self, path_mm: Float) -> Bool:
        """Return the drawn rows (n,) of a path."""
        x, y = path_mm.T
        return np.asarray((np.abs(y - self.level_mm) < self.band_mm) & (x >= self.x_mm[0]) & (x <= self.x_mm[1]))

    @property
    def y_label(self) -> str:
        """Label of the Y axis."""
        return f"Y from {self.level_mm:g} mm on (um)" if self.fine else "Y (mm)"

    def scale_y(self, y_mm: Float) -> Float:
        """Return Y (n,) in the shown unit."""
        return 1e3 * (y_mm - self.level_mm) if self.fine else y_mm


@dataclass(frozen=True, slots=True)
class TracedPath:
    """A path (n, 2), mm, with its optional distance (n,), um, from a reference path."""

    label: str
    path_mm: Float
    apart_um: Float | None = None


def draw_path_detail(traced: Sequence[TracedPath], view: View, below: str = "error (um)") -> str:
    """Draw paths at one location with stretched axes, and their distances from the reference below.

    The first path is grey, the others are coloured.
    """
    paths, distances = [], []
    for k, (one, colour) in enumerate(zip(traced, (REFERENCE, *COLOURS), strict=False)):
        rows = view.select_rows(one.path_mm)
        x, y = one.path_mm[rows].T
        paths.append(Trace(one.label, x, view.scale_y(y), colour, "line" if k else "wide"))
        if one.apart_um is not None:
            distances.append(Trace(one.label, x, one.apart_um[rows], colour))
    panels = [Panel(view.y_label, paths), Panel(below, distances, BELOW_SHARE, from_zero=True)]
    return render_svg(Chart("X (mm)", panels, ""), height=TALL)


def draw_operators() -> str:
    """Draw the sine response of each derivative operator, relative to the exact derivative, over frequency."""
    share = np.linspace(1e-3, 0.5, 300)
    turned = 2j * np.pi * share
    traces = []
    for (name, operator), colour in zip(OPERATORS.items(), COLOURS, strict=False):
        pairs = zip(operator.offsets, operator.weights, strict=True)
        answer = np.sum([weight * np.exp(turned * offset) for offset, weight in pairs], axis=0)
        traces.append(Trace(name.replace("_", " "), share, np.abs(answer / turned), colour))
    alt = "Zero forcing #1 overshoots by 9 % at a quarter of the sampling rate, central falls to nothing at half of it."
    panel = Panel("amplitude, operator / exact", traces, levels=[("exact", 1.0)])
    return render_svg(Chart("frequency / sampling rate", [panel], alt))


def draw_over_bound(ratios: Float, labels: Sequence[str]) -> str:
    """Draw the ratio of RMS error and bound (methods, 6), one line per method, on a logarithmic axis."""
    columns, rows = compute_legend_layout(list(labels), WIDTH - 1.0)
    with open_drawing(WIDTH, 3.9, 0.2 * rows + 0.15) as made:
        for row, label, colour in zip(ratios, labels, COLOURS, strict=False):
            made.axes.plot(range(len(PARAMETERS)), row, "o-", ms=4, lw=0.9, color=colour, label=label)
        made.axes.axhline(1.0, color=INK, lw=0.9)
        made.axes.set_yscale("log")
        made.axes.yaxis.set_major_formatter("{x:g}")
        made.axes.set_xticks(range(len(PARAMETERS)), PARAMETERS)
        made.axes.set_ylabel("RMS error / bound")
        place_legend_above(made.axes, columns)
        worst = "; ".join(f"{label} up to {row.max():.2g}" for row, label in zip(ratios, labels, strict=True))
        made.alt = f"RMS error over the bound of Cramer and Rao: {worst}."
    return made.svg


def draw_correlations(curves: Mapping[str, Float], bound: float) -> str:
    """Draw normalised autocorrelations over the lags 1, 2, ... with the bounds of whiteness."""
    traces = [
        Trace(label, np.arange(1.0, values.size + 1), values, colour)
        for (label, values), colour in zip(curves.items(), COLOURS, strict=False)
    ]
    alt = "; ".join(f"{label}: {np.abs(values).max():.2f} at most" for label, values in curves.items())
    panel = Panel("correlation", traces, levels=[("white above", -bound), ("white below", bound)])
    return render_svg(Chart("lag (samples)", [panel], f"Correlations. {alt}."), height=3.9)


def draw_drift(
    symbol: str, unit: str, series: Mapping[str, tuple[Float, Float, Float]], printed: tuple[float, float]
) -> str:
    """Draw a parameter over temperature with 95 % bars, one panel per scenario, and the paper's values in grey."""
    panels = []
    for (label, (celsius, value, std)), colour in zip(series.items(), COLOURS, strict=False):
        half = INTERVAL_95 * std
        points = Trace("identified, 95 %", celsius, value, colour, "points", value - half, value + half)
        course = Trace("the paper's", celsius[[0, -1]], np.array(printed), REFERENCE, "wide")
        panels.append(Panel(f"{label}\n{symbol} ({unit})", [course, points]))
    alt = f"{symbol} falls from {printed[0]:g} to {printed[1]:g} {unit} as the slide-ways warm."
    return render_svg(Chart("slide-way temperature (degC)", panels, alt), height=1.2 + 1.4 * len(panels))


def draw_overlay(x: Float, x_label: str, y_label: str, both: Sequence[tuple[str, Float]]) -> str:
    """Draw two curves and their difference below."""
    (first, one), (second, other) = both
    above = [Trace(first, x, one, REFERENCE, "wide"), Trace(second, x, other, COLOURS[1])]
    apart = Trace(f"{second} less {first}", x, other - one)
    alt = f"{first} and {second}; they are {np.abs(other - one).max():.2g} apart at most."
    panels = [Panel(y_label, above), Panel(y_label.replace(y_label.split(" (")[0], "difference"), [apart], BELOW_SHARE)]
    return render_svg(Chart(x_label, panels, alt), height=TALL)


def draw_axis_errors(time_s: Float, curves: Mapping[str, Float], label: str) -> str:
    """Draw the errors of one axis over time."""
    traces = [
        Trace(name, time_s, values, colour, "dashed" if name == "offset" else "line")
        for (name, values), colour in zip(curves.items(), COLOURS, strict=False)
    ]
    alt = "; ".join(f"{name} {np.abs(values).max():.0f} um at most" for name, values in curves.items())
    return render_svg(Chart("time (s)", [Panel(label, traces, levels=[("", 0.0)])], f"{label}: {alt}."))


def draw_cutter_path(centre_mm: Float, shape_mm: Float) -> str:
    """Draw the path of a cutter's centre and the cut shape, both (n, 2), mm."""
    with open_drawing(WIDTH, 3.2) as made:
        made.axes.plot(*shape_mm.T, color=REFERENCE, lw=1.2, label="shape")
        made.axes.plot(*centre_mm.T, color=COLOURS[0], label="centre of the cutter")
        made.axes.set_aspect("equal", adjustable="datalim")
        made.axes.set_xlabel("X (mm)")
        made.axes.set_ylabel("Y (mm)")
        place_legend_above(made.axes, 2)
        made.alt = "The path of the cutter's centre runs 20 mm beside the shape, round its convex corners in arcs."
    return made.svg
