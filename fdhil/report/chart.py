"""Charts over one common axis as data: drawn for print, and exported to the page's script, which makes them
interactive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from fdhil.records import Float
from fdhil.report.svg_drawing import (
    BELOW,
    COLOURS,
    INK,
    LEFT,
    LEGEND_LINE,
    RIGHT,
    compute_legend_layout,
    open_drawing,
    place_legend_above,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_POINTS = 2000  # of a curve
FEW_POINTS = 40  # up to which bars have caps: each adds an element to the picture
DIGITS = 5  # of the data for the page's script
DAY_S = 86_400.0
PANEL_GAP = 0.12  # inches
WIDTHS = {"line": 1.3, "dashed": 1.3, "wide": 2.6, "points": 0.0}

Style = Literal["line", "dashed", "wide", "points"]


@dataclass(frozen=True, slots=True)
class Trace:
    """One labelled curve, or points, (n,); ``low`` and ``high`` bound its band, or its error bars."""

    label: str
    x: Float
    y: Float
    colour: str = COLOURS[0]
    style: Style = "line"
    low: Float | None = None
    high: Float | None = None


@dataclass(frozen=True, slots=True)
class Panel:
    """Traces in one panel; ``levels`` are labelled horizontal lines; ``share`` is its part of the height."""

    y_label: str
    traces: Sequence[Trace]
    share: float = 1.0
    log: bool = False
    levels: Sequence[tuple[str, float]] = ()
    from_zero: bool = False


@dataclass(frozen=True, slots=True)
class Chart:
    """Panels over one common axis; ``in_time``: seconds since 1970; ``marks`` are labelled vertical lines."""

    x_label: str
    panels: Sequence[Panel]
    alt: str
    in_time: bool = False
    marks: Sequence[tuple[str, float]] = ()


def decimate_curve(x: Float, y: Float, most: int = MOST_POINTS) -> tuple[Float, Float]:
    """Return a curve (m,) of at most ``most`` points that keeps the lowest and the highest of each stretch."""
    if x.size <= most:
        return x, y
    per = -(-2 * x.size // most)
    starts = np.arange(0, x.size, per)
    rows: set[int] = set()
    for lost, pick in ((np.inf, np.argmin), (-np.inf, np.argmax)):
        filled = np.where(np.isnan(y), lost, y)
        rows.update(int(start + pick(filled[start : start + per])) for start in starts)
    kept = np.array(sorted(rows))
    return x[kept], y[kept]


def render_svg(chart: Chart, width: float = 6.4, height: float = 3.6) -> str:
    """Return the chart as inline SVG that contains its data."""
    from matplotlib.ticker import MaxNLocator

    columns, rows = compute_legend_layout([trace.label for trace in chart.panels[0].traces], width - LEFT - RIGHT)
    if shown := sum(bool(trace.label) for trace in chart.panels[0].traces) > 1:
        height += max(0, rows - 1) * LEGEND_LINE
    above = rows * LEGEND_LINE + 0.15 if shown else 0.15
    with open_drawing(width, height, above) as made:
        places = _lay_out_panels(chart, height, above)
        every = [made.axes, *(made.figure.add_axes((0, 0, 1, 1), sharex=made.axes) for _ in chart.panels[1:])]
        left, across = made.axes.get_position().x0, made.axes.get_position().width
        for axes, panel, (bottom, tall) in zip(every, chart.panels, places, strict=True):
            axes.set_position((left, bottom, across, tall))
            draw_panel(axes, panel, chart)
            if axes is not every[-1]:
                axes.tick_params(labelbottom=False)
            if not panel.log:
                axes.yaxis.set_major_locator(MaxNLocator(max(2, round(5 * tall * height / 2.5)), min_n_ticks=2))
        every[-1].set_xlabel(chart.x_label)
        if shown:
            place_legend_above(made.axes, columns)
        made.alt, made.data = chart.alt, export_chart(chart)
    return made.svg


def _lay_out_panels(chart: Chart, height: float, above: float) -> list[tuple[float, float]]:
    free = height - BELOW - above - PANEL_GAP * (len(chart.panels) - 1)
    whole = sum(panel.share for panel in chart.panels)
    top, places = height - above, []
    for panel in chart.panels:
        tall = free * panel.share / whole
        places.append(((top - tall) / height, tall / height))
        top -= tall + PANEL_GAP
    return places


def draw_panel(axes: Axes, panel: Panel, chart: Chart) -> None:
    """Draw one panel on matplotlib's axes."""
    for trace in panel.traces:
        _draw_trace(axes, trace, chart.in_time)
    for label, at in chart.marks:
        axes.axvline(at / DAY_S if chart.in_time else at, color=INK, lw=0.9, ls=":", label="_" + label)
    for label, level in panel.levels:
        axes.axhline(level, color=INK, lw=0.8, ls=(0, (5, 4)), zorder=1)
        axes.annotate(
            label, (1.0, level), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=7.5, color=INK
        )
    axes.set_ylabel(panel.y_label)
    if panel.log:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(bottom=_find_decade_below(panel))
    else:
        axes.ticklabel_format(axis="y", useOffset=False, style="plain")
        if panel.from_zero:
            axes.set_ylim(bottom=0.0)
    if chart.in_time:
        _format_date_axis(axes)
    else:
        axes.locator_params(axis="x", nbins=6)


def _find_decade_below(panel: Panel) -> float:
    least = min(float(np.nanmin(trace.y)) for trace in panel.traces)
    return float(10.0 ** math.floor(math.log10(least)))


def _draw_trace(axes: Axes, trace: Trace, in_time: bool) -> None:
    x, y = (trace.x, trace.y) if trace.low is not None else decimate_curve(trace.x, trace.y)
    x = x / DAY_S if in_time else x
    if trace.style == "points":
        bars = None
        if trace.low is not None and trace.high is not None:
            bars = np.maximum(np.vstack([y - trace.low, trace.high - y]), 0.0)
        caps = 2 if x.size <= FEW_POINTS else 0
        axes.errorbar(x, y, bars, fmt="o", ms=3, capsize=caps, lw=0.9, color=trace.colour, label=trace.label)
        return
    if trace.low is not None and trace.high is not None:
        axes.fill_between(x, trace.low, trace.high, color=trace.colour, alpha=0.2, lw=0)
    dash = "--" if trace.style == "dashed" else "-"
    axes.plot(x, y, color=trace.colour, lw=WIDTHS[trace.style], ls=dash, label=trace.label)


def _format_date_axis(axes: Axes) -> None:
    from matplotlib import dates

    make_locator: Any = dates.AutoDateLocator
    make_formatter: Any = dates.ConciseDateFormatter
    locator = make_locator(minticks=3, maxticks=7)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(make_formatter(locator))


def export_chart(chart: Chart) -> dict[str, Any]:
    """Return the chart in the format of the page's script (``page.js``)."""
    grids: list[list[float | None]] = []
    panels = [_export_panel(panel, grids) for panel in chart.panels]
    return {
        "kind": "chart",
        "x": chart.x_label,
        "time": chart.in_time,
        "marks": [[label, _round_value(at)] for label, at in chart.marks],
        "grids": grids,
        "panels": panels,
    }


def _export_panel(panel: Panel, grids: list[list[float | None]]) -> dict[str, Any]:
    return {
        "y": panel.y_label,
        "share": panel.share,
        "log": panel.log,
        "zero": panel.from_zero,
        "levels": [[label, _round_value(level)] for label, level in panel.levels],
        "traces": [_export_trace(trace, grids) for trace in panel.traces],
    }


def _export_trace(trace: Trace, grids: list[list[float | None]]) -> dict[str, Any]:
    """Return a trace whose ``x`` is the number of its grid; traces share grids."""
    order = np.argsort(trace.x, kind="stable")
    columns: Mapping[str, Float | None] = {"low": trace.low, "high": trace.high}
    bounds = {name: _round_values(values[order]) for name, values in columns.items() if values is not None}
    x, y = trace.x[order], trace.y[order]
    x, y = (x, y) if bounds else decimate_curve(x, y)
    grid = _round_values(x)
    if grid not in grids:
        grids.append(grid)
    look = {"label": trace.label, "colour": trace.colour, "style": trace.style}
    return look | {"x": grids.index(grid), "y": _round_values(y)} | bounds


def _round_values(values: Float) -> list[float | None]:
    return [_round_value(value) for value in values.tolist()]


def _round_value(value: float) -> float | None:
    if not math.isfinite(value):
        return None
    kept = round(value) if abs(value) >= 1e6 else float(f"{value:.{DIGITS}g}")
    return int(kept) if kept == int(kept) else kept
