"""The courses of the parameters as a picture (extra ``report``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fdhil.errors import FdhilError
from fdhil.records import INTERVAL_95, UNITS
from fdhil.store.output import open_output

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DAY_S = 86_400.0


def courses(rows: Sequence[Mapping[str, Any]], health: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Return a figure with each parameter over time and, where it is known, over the slide-way's temperature.

    ``rows`` are the published revisions, drawn as a line; ``health`` (see :mod:`fdhil.cli.history_trends`) gives the
    windows with their 95 % intervals, the steps as dashed lines, and the slopes since the last step, each with the
    fan of its interval. FdhilError when matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise FdhilError("a plot needs the extra 'report': pip install 'fdhil[report]'") from None
    published = [row["parameters"] for row in rows] + [
        w["parameters"] for told in health.values() for w in told["windows"]
    ]
    names = list(dict.fromkeys(name for parameters in published for name in parameters))
    warm = any(told["slopes"] for told in health.values())
    figure = Figure(figsize=(15, 9) if warm else (11, 6.5), layout="constrained")
    columns = 4 if warm else 3
    panels = figure.subplots(max(1, -(-len(names) * (2 if warm else 1) // columns)), columns, squeeze=False)
    for k, name in enumerate(names):
        over_time = panels.flat[2 * k if warm else k]
        over_time.set_title(f"{name} [{UNITS[name]}]{_limits(name, health)}", fontsize=9)
        axes = list(dict.fromkeys([*(row["axis"] for row in rows), *health]))
        for number, axis in enumerate(axes):
            own = [row for row in rows if row["axis"] == axis and name in row["parameters"]]
            _draw_time(over_time, own, health.get(axis), name, f"C{number}")
            if warm and axis in health:
                _draw_temperature(panels.flat[2 * k + 1], health[axis], name, f"C{number}")
        if warm:
            panels.flat[2 * k + 1].set_title(f"{name} over the slide-way's temperature, degC", fontsize=9)
        if (len(axes) > 1 or k == 0) and over_time.get_legend_handles_labels()[1]:
            over_time.legend(fontsize=7)
    for panel in panels.flat:
        panel.tick_params(labelsize=7)
        panel.grid(True, alpha=0.3)
    return figure


def _limits(name: str, health: Mapping[str, Mapping[str, Any]]) -> str:
    """Return what the title says of a parameter's maintenance limits."""
    words = []
    for axis, told in health.items():
        if limit := told["limits"].get(name):
            when = "reached" if limit["reached"] else f"on {limit['date'][:10]}"
            words.append(f"{axis}: limit {limit['limit']:.4g} {when}")
    return "\n" + ", ".join(words) if words else ""


def _draw_time(
    panel: Any, rows: Sequence[Mapping[str, Any]], told: Mapping[str, Any] | None, name: str, colour: str
) -> None:
    """Draw one axis' parameter over time."""
    from matplotlib import dates

    formatter: Any = dates.ConciseDateFormatter
    times = [datetime.fromisoformat(row["time"]) for row in rows]
    if rows:
        label = f"{rows[0]['axis']} published"
        panel.plot(times, [row["parameters"][name]["value"] for row in rows], color=colour, linewidth=1.5, label=label)
    panel.xaxis.set_major_formatter(formatter(panel.xaxis.get_major_locator()))
    if told is None:
        return
    known = _known(told["windows"], name)
    _points(panel, [datetime.fromisoformat(w["time"]) for w in known], known, name, colour)
    for change in told["changes"]:
        if name in change["parameters"]:
            panel.axvline(datetime.fromisoformat(change["time"]), color=colour, linestyle="--", linewidth=1.0)
    if line := told["trends"].get(name):
        at, newest = datetime.fromisoformat(line["at"]), datetime.fromisoformat(told["windows"][-1]["time"])
        ends = [datetime.fromisoformat(line["since"]), at, newest]
        _fan(panel, ends, [(end - at).total_seconds() / DAY_S for end in ends], line, "per_day")


def _draw_temperature(panel: Any, told: Mapping[str, Any], name: str, colour: str) -> None:
    """Draw one axis' parameter over the slide-way's temperature."""
    known = [window for window in _known(told["windows"], name) if window["temperature_c"] is not None]
    _points(panel, [window["temperature_c"] for window in known], known, name, colour)
    if known and (line := told["slopes"].get(name)):
        celsius = [window["temperature_c"] for window in known]
        ends = [min(celsius), line["at_celsius"], max(celsius)]
        _fan(panel, ends, [end - line["at_celsius"] for end in ends], line, "per_kelvin")


def _known(windows: Sequence[Mapping[str, Any]], name: str) -> list[Mapping[str, Any]]:
    told = ((window, window["parameters"].get(name, {})) for window in windows)
    return [window for window, its in told if None not in (its.get("value"), its.get("std"))]


def _points(panel: Any, at: Sequence[Any], windows: Sequence[Mapping[str, Any]], name: str, colour: str) -> None:
    values = [window["parameters"][name]["value"] for window in windows]
    bars = [INTERVAL_95 * window["parameters"][name]["std"] for window in windows]
    panel.errorbar(at, values, bars, fmt=".", color=colour, alpha=0.35, markersize=4, linewidth=0.7)


def _fan(panel: Any, ends: Sequence[Any], away: Sequence[float], line: Mapping[str, Any], key: str) -> None:
    """Draw a line through its centre, and between the slopes of its interval."""
    value, low, high = ([line["level"] + line[which] * x for x in away] for which in (key, "low", "high"))
    panel.fill_between(ends, low, high, color="black", alpha=0.12, linewidth=0)
    panel.plot(ends, value, color="black", linewidth=1.0)


def write_plot(rows: Sequence[Mapping[str, Any]], health: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Write the courses as PNG, SVG or PDF, by the name's suffix. FdhilError when there is nothing to plot."""
    if not rows and not health:
        raise FdhilError("there is nothing to plot: no parameters were published yet; let the daemon see some rapids")
    figure = courses(rows, health)
    with open_output(path) as file:
        figure.savefig(file, format=path.suffix.lower().removeprefix("."), dpi=120)
