"""Draws a circular test as in ISO 230-4: the programmed circle, and both runs with magnified deviations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fdhil.prediction import CIRCLE_POINTS, CircleDeviations
from fdhil.records import Float
from fdhil.report.svg_drawing import COLOURS, INK, REFERENCE, open_drawing, place_legend_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOMINAL = 6  # divisions from the centre to the programmed circle
RINGS = 4  # divisions inside and outside of it
DIVISIONS_UM = tuple(m * 10.0**e for e in range(-3, 5) for m in (1, 2, 5))


def choose_division_um(test: CircleDeviations) -> float:
    """Return the division at which the deviations fill the plot."""
    largest = max(abs(value) for value in test.radial_um)
    return next((division for division in DIVISIONS_UM if largest <= (RINGS - 0.5) * division), DIVISIONS_UM[-1])


def draw_polar(test: CircleDeviations, names: tuple[str, str] = ("X", "Y")) -> str:
    """Draw both runs of a circular test about the programmed circle as inline SVG."""
    division = choose_division_um(test)
    angle = np.append(np.arange(CIRCLE_POINTS), 0) * 2 * np.pi / CIRCLE_POINTS
    with open_drawing(4.8, 4.9, 0.4) as made:
        axes = made.axes
        axes.set_position((0.02, 0.05, 0.96, 0.86))
        _draw_rings(axes, angle, division, names)
        for run_um, label, colour in (
            (test.counter_um, "counter-clockwise", COLOURS[0]), (test.clockwise_um, "clockwise", COLOURS[1]),
        ):  # fmt: skip
            axes.plot(
                *_convert_polar(angle, NOMINAL + np.append(run_um, run_um[0]) / division), color=colour, label=label
            )
        place_legend_above(axes, 2, axes.get_legend_handles_labels()[0])
        highest, lowest = test.radial_um
        made.alt = (
            f"Circular test of radius {test.radius_mm:g} mm in the plane {''.join(names)}: from {lowest:+.3g} um to "
            f"{highest:+.3g} um, the runs {test.hysteresis_um:.3g} um apart at most; one division is {division:g} um."
        )
        made.data = {"kind": "map"}
    return made.svg


def _convert_polar(angle: Float, radius: Float) -> tuple[Float, Float]:
    return radius * np.cos(angle), radius * np.sin(angle)


def _draw_rings(axes: Axes, angle: Float, division: float, names: Sequence[str]) -> None:
    for ring in range(-RINGS, RINGS + 1):
        look: dict[str, Any] = {"color": REFERENCE, "lw": 2.0} if ring == 0 else {"color": "#d9dfe6", "lw": 0.7}
        axes.plot(*_convert_polar(angle, np.full(angle.size, NOMINAL + ring)), **look)
    reach = NOMINAL + RINGS + 0.4
    for end, name in zip(((reach, 0.0), (0.0, reach)), names, strict=True):
        axes.plot([-end[0], end[0]], [-end[1], end[1]], color=INK, lw=0.6, zorder=1)
        axes.annotate(f"+{name}", end, ha="center", va="center", fontsize=9, backgroundcolor="white")
    axes.annotate(f"1 division: {division:g} um", (0, 0.6), ha="center", fontsize=9)
    axes.annotate("outside: larger than programmed", (0, -0.9), ha="center", fontsize=7.5, color=INK)
    axes.set_xlim(-reach - 0.6, reach + 0.6)
    axes.set_ylim(-reach - 0.6, reach + 0.6)
    axes.set_aspect("equal")
    axes.set_axis_off()
