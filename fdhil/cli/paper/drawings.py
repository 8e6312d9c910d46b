"""Draws what the report's figures do not have, as inline SVG in the same style."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np

from fdhil.cli.paper.operators import OPERATORS
from fdhil.records import PARAMETERS, Bool, Float
from fdhil.report.figures import COLOURS, INK, REFERENCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEVEL = 0.15  # of a view: what is farther from its line is another piece of the path
WIDTH, LEFT, BOTTOM, TOP, RIGHT = 6.4, 0.85, 0.6, 0.55, 0.2  # inches


@contextmanager
def drawing(height: float = 3.6, panels: int = 1) -> Iterator[tuple[Sequence[Axes], list[str]]]:
    """Axes, one above the other with one time axis, in margins that hold a legend of two rows; SVG on leaving."""
    from matplotlib import style
    from matplotlib.figure import Figure

    svg: list[str] = []
    with style.context(str(files("fdhil.report").joinpath("fdhil.mplstyle"))):
        figure = Figure(figsize=(WIDTH, height))
        each = (height - BOTTOM - TOP) / panels
        place = [
            (LEFT / WIDTH, (BOTTOM + (panels - 1 - k) * each + (0.12 if k < panels - 1 else 0)) / height,
             1 - (LEFT + RIGHT) / WIDTH, (each - (0.12 if panels > 1 else 0)) / height)
            for k in range(panels)
        ]  # fmt: skip
        axes = [figure.add_axes(box) for box in place]
        for upper in axes[:-1]:
            upper.sharex(axes[-1])
            upper.tick_params(labelbottom=False)
        yield axes, svg
        figure.align_ylabels(axes)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    body = text.getvalue()
    body = body[body.index("<svg") :]
    # several drawings share one page: identifiers must not meet
    mark = f"p{zlib.crc32(body.encode()):08x}"
    body = re.sub(r'id="', f'id="{mark}-', body)
    svg.append(re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{mark}-", body))


def legend(axes: Axes, columns: int = 3) -> None:
    """Put the legend above the axes, inside the figure."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns)


def operators() -> str:
    """Each derivative operator's response to a sine over that of the exact derivative, against frequency."""
    share = np.linspace(1e-3, 0.5, 300)
    with drawing() as ((axes,), svg):
        for (name, operator), colour in zip(OPERATORS.items(), COLOURS, strict=False):
            turned = 2j * np.pi * share
            answer = sum(b * np.exp(turned * j) for j, b in zip(operator.offsets, operator.weights, strict=True))
            axes.plot(share, np.abs(answer / turned), color=colour, label=name.replace("_", " "))
        axes.axhline(1.0, color=REFERENCE, lw=0.8)
        axes.set_xlabel("frequency / sampling rate")
        axes.set_ylabel("amplitude, operator / exact")
        legend(axes, 2)
    return svg[0]


def over_bound(ratios: Float, labels: Sequence[str]) -> str:
    """RMS error over the bound (methods, 6), a line of marks a method, on a logarithmic axis."""
    with drawing(3.9) as ((axes,), svg):
        for row, label, colour in zip(ratios, labels, COLOURS, strict=False):
            axes.plot(range(len(PARAMETERS)), row, "o-", ms=4, lw=0.9, color=colour, label=label)
        axes.axhline(1.0, color=INK, lw=0.9)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xticks(range(len(PARAMETERS)), PARAMETERS)
        axes.set_ylabel("RMS error / bound")
        legend(axes)
    return svg[0]


def correlations(curves: Mapping[str, Float], bound: float) -> str:
    """Normalised autocorrelations over the lags 1, 2, ... with the bounds within which they count as none."""
    with drawing(3.9) as ((axes,), svg):
        axes.axhspan(-bound, bound, color="#eef2f6")
        for (label, values), colour in zip(curves.items(), COLOURS, strict=False):
            axes.plot(np.arange(1, values.size + 1), values, "o-", ms=3, lw=0.9, color=colour, label=label)
        axes.set_xlabel("lag (samples)")
        axes.set_ylabel("correlation")
        legend(axes, 2)
    return svg[0]


def drift(
    symbol: str, unit: str, series: Mapping[str, tuple[Float, Float, Float]], printed: tuple[float, float]
) -> str:
    """A parameter against temperature with 95 % bars, a panel a scenario, and the paper's course of it in grey."""
    with drawing(1.4 + 1.3 * len(series), len(series)) as (panels, svg):
        for axes, (label, (celsius, value, std)), colour in zip(panels, series.items(), COLOURS, strict=False):
            axes.plot(celsius[[0, -1]], printed, color=REFERENCE, lw=2.4)
            axes.errorbar(celsius, value, 1.96 * std, fmt="o", ms=3.5, capsize=2, lw=1.0, color=colour, label=label)
            axes.locator_params(axis="y", nbins=4)
            axes.margins(y=0.15)
            axes.legend(loc="lower left", handlelength=1.0)
        panels[-1].set_xlabel("slide-way temperature (°C)")
        panels[len(panels) // 2].set_ylabel(f"{symbol} ({unit})")
    return svg[0]


def overlay(time_s: Float, measured: Float, simulated: Float) -> str:
    """Measured and simulated speed (rad/s) above, their difference below."""
    with drawing(4.6, 2) as ((above, below), svg):
        above.plot(time_s, measured, color=REFERENCE, lw=2.6, label="drive, measured")
        above.plot(time_s, simulated, color=COLOURS[1], lw=1.0, label="model")
        above.set_ylabel("speed (rad/s)")
        legend(above)
        below.plot(time_s, measured - simulated, color=COLOURS[0], lw=0.6)
        below.set_xlabel("time (s)")
        below.set_ylabel("difference (rad/s)")
    return svg[0]


@dataclass(frozen=True, slots=True)
class View:
    """What is drawn of a place: the limits in X (mm); those in Y follow from what is near to ``about`` (mm)."""

    x_mm: tuple[float, float]
    about: tuple[float, float]
    near_mm: float

    def holds(self, path_mm: Float) -> Bool:
        """Return the rows (n,) of a path that are near."""
        return np.asarray(np.abs(path_mm - self.about).max(axis=1) < 1.2 * self.near_mm)


@dataclass(frozen=True, slots=True)
class Traced:
    """A path (n, 2) in mm and, where there is one, its distance (n,) in um from what it is compared with."""

    label: str
    path_mm: Float
    apart_um: Float | None = None


def place(traced: Sequence[Traced], view: View, below_label: str = "error (µm)") -> str:
    """A place of the path, axes stretched to what is there, and below it the distances, which no path would show.

    The first path is grey, the others are in colour.
    """
    with drawing(5.0, 2) as ((above, below), svg):
        colours = [REFERENCE, *COLOURS]
        for k, one in enumerate(traced):
            rows = view.holds(one.path_mm)
            shown = np.where(rows[:, None], one.path_mm, np.nan)
            above.plot(*shown.T, color=colours[k], lw=1.2 if k else 2.8, label=one.label)
            if one.apart_um is not None:
                below.plot(shown[:, 0], np.where(rows, one.apart_um, np.nan), color=colours[k], lw=1.2)
        _limit(above, [one.path_mm for one in traced], view)
        above.set_ylabel("Y (mm)")
        legend(above)
        below.set_ylim(bottom=0.0)
        below.set_xlabel("X (mm)")
        below.set_ylabel(below_label)
    return svg[0]


def _limit(axes: Axes, paths_mm: Sequence[Float], view: View) -> None:
    """Set the limits: those in Y hold all that runs along near the level of the place."""
    levels = []
    for path in paths_mm:
        beside = view.holds(path) & (path[:, 0] >= view.x_mm[0]) & (path[:, 0] <= view.x_mm[1])
        levels.append(path[beside & (np.abs(path[:, 1] - view.about[1]) < LEVEL * view.near_mm), 1])
    every = np.concatenate(levels)
    margin = max(0.08 * float(np.ptp(every)), 1e-4)
    axes.set_xlim(*view.x_mm)
    axes.set_ylim(every.min() - margin, every.max() + margin)
    axes.ticklabel_format(useOffset=False)
    axes.locator_params(nbins=6)


def prediction(time_s: Float, measured_um: Float, predicted_um: Float) -> str:
    """Measured and predicted contour error above, their difference below."""
    with drawing(4.6, 2) as ((above, below), svg):
        above.plot(time_s, measured_um, color=REFERENCE, lw=2.6, label="machine")
        above.plot(time_s, predicted_um, color=COLOURS[1], lw=1.0, label="predicted")
        above.set_ylabel("contour error (µm)")
        legend(above)
        below.plot(time_s, predicted_um - measured_um, color=COLOURS[0], lw=0.8)
        below.set_xlabel("time (s)")
        below.set_ylabel("difference (µm)")
    return svg[0]


def axis_errors(time_s: Float, curves: Mapping[str, Float], unit: str) -> str:
    """Errors of one axis over time."""
    with drawing() as ((axes,), svg):
        axes.axhline(0.0, color=REFERENCE, lw=1.2)
        for (label, values), colour in zip(curves.items(), COLOURS, strict=False):
            axes.plot(time_s, values, color=colour, label=label, ls="--" if label == "offset" else "-")
        axes.set_xlabel("time (s)")
        axes.set_ylabel(unit)
        legend(axes)
    return svg[0]


def shape(centre_mm: Float, shape_mm: Float) -> str:
    """The path of a cutter's centre beside the shape that it cuts, both (n, 2) mm."""
    with drawing(3.4) as ((axes,), svg):
        axes.plot(*shape_mm.T, color=REFERENCE, lw=1.2, label="shape")
        axes.plot(*centre_mm.T, color=COLOURS[0], label="centre of the cutter")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("X (mm)")
        axes.set_ylabel("Y (mm)")
        legend(axes)
    return svg[0]
