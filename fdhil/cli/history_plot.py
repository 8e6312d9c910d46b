"""Plot of the parameter trends (extra ``report``)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fdhil.errors import FdhilError
from fdhil.report import AxisHistory, build_time_chart, typeset_text
from fdhil.store import open_output

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 6.0, 2.1  # of a panel, inches
HEAD, FOOT = 0.8, 0.45


def build_figure(histories: Sequence[AxisHistory]) -> Figure:
    """Return a figure with one column per axis and one row per parameter."""
    from matplotlib import style
    from matplotlib.figure import Figure

    import fdhil.report
    from fdhil.report import draw_panel

    names = list(dict.fromkeys(name for history in histories for name in history.list_parameters()))
    with style.context(Path(fdhil.report.__file__).with_name("fdhil.mplstyle")):
        tall = HEIGHT * len(names) + HEAD + FOOT
        figure = Figure(figsize=(WIDTH * len(histories), tall))
        panels = figure.subplots(len(names), len(histories), squeeze=False, sharex="col")
        figure.subplots_adjust(
            left=0.85 / WIDTH / len(histories), right=1 - 0.15 / WIDTH / len(histories), top=1 - HEAD / tall,
            bottom=FOOT / tall, hspace=0.15, wspace=0.2,
        )  # fmt: skip
        for column, history in zip(panels.T, histories, strict=True):
            column[0].set_title(f"axis {history.axis}", loc="left", fontweight="bold")
            for panel, name in zip(column, names, strict=True):
                course = build_time_chart(history, name)
                draw_panel(panel, course.panels[0], course)
                panel.set_ylabel(typeset_text(course.panels[0].y_label))
        named = panels[0, 0].get_legend_handles_labels()
        figure.legend(*named, loc="upper right", ncols=3 if len(histories) > 1 else 1, fontsize=8)
    return figure


def write_plot(histories: Sequence[AxisHistory], path: Path) -> None:
    """Write the trends as PNG, SVG or PDF, by suffix. Raises FdhilError if there is nothing to plot."""
    shown = [history for history in histories if history.list_parameters()]
    if not shown:
        raise FdhilError("nothing to plot: no parameters are published yet; run the daemon while the axes make rapids")
    figure = build_figure(shown)
    with open_output(path) as file:
        figure.savefig(file, format=path.suffix.lower().removeprefix("."), dpi=120)
