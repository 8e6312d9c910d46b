"""Charts a parameter's history: estimates over time or temperature, trend line, nominal value and limit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np

from fdhil.records import INTERVAL_95, Float
from fdhil.report.chart import DAY_S, Chart, Panel, Trace
from fdhil.report.parameter_format import DISPLAY_UNITS, compute_half_width, describe_name, format_cell
from fdhil.report.svg_drawing import COLOURS, INK

MOST_SINGLE_ESTIMATES = 200  # estimates: more are shown by their daily medians
DAY_PERCENTILES = (5.0, 95.0)  # percentiles of a day's estimates
IN_VIEW = 4.0  # of the estimates' range: a farther limit would flatten the curve


@dataclass(frozen=True, slots=True)
class AxisHistory:
    """The history of one axis: its revisions, its health (see ``fdhil history --json``), its nominal values."""

    axis: str
    rows: Sequence[Mapping[str, Any]] = ()
    health: Mapping[str, Any] | None = None
    nominal: Mapping[str, float] = field(default_factory=dict)

    def list_parameters(self) -> list[str]:
        """Return the parameters with a history, in the order of display."""
        of_windows = [window["parameters"] for window in (self.health or {}).get("windows", ())]
        known = dict.fromkeys(name for parameters in of_windows for name in parameters)
        known |= dict.fromkeys(name for row in self.rows for name in row["parameters"])
        return [name for name in DISPLAY_UNITS if name in known]

    def list_estimates(self, name: str) -> list[Mapping[str, Any]]:
        """Return the windows that have an estimate of a parameter."""
        windows = () if self.health is None else self.health["windows"]
        return [w for w in windows if None not in (w["parameters"].get(name, {}).get(key) for key in ("value", "std"))]


def build_time_chart(history: AxisHistory, name: str) -> Chart:
    """Return the chart of a parameter over time: estimates or daily medians, published values, trend."""
    unit, factor = DISPLAY_UNITS[name]
    traces = [*_trace_published(history, name), *_trace_estimates(history, name)]
    health = history.health or {}
    if line := health.get("trends", {}).get(name):
        at, newest = _parse_time_s(line["at"]), _parse_time_s(health["windows"][-1]["time"])
        ends = np.array([_parse_time_s(line["since"]), at, newest])
        traces.append(_trace_line("trend", ends, (ends - at) / DAY_S, line, "per_day", factor))
    marks = [
        (change["cause"], _parse_time_s(change["time"]))
        for change in health.get("changes", ())
        if name in change["parameters"]
    ]
    panel = Panel(f"{name.partition('_')[0]} ({unit})", traces, levels=_select_levels(history, name, traces))
    return Chart("time (UTC)", [panel], _describe_trend(history, name), in_time=True, marks=marks)


def build_temperature_chart(history: AxisHistory, name: str) -> Chart | None:
    """Return the chart of a parameter over the slide-way's temperature; None without a significant slope."""
    line = (history.health or {}).get("slopes", {}).get(name)
    known = [window for window in history.list_estimates(name) if window["temperature_c"] is not None]
    if not known or line is None or line["low"] <= 0.0 <= line["high"]:
        return None
    unit, factor = DISPLAY_UNITS[name]
    drawn = known[:: -(-len(known) // MOST_SINGLE_ESTIMATES)]
    celsius = np.array([window["temperature_c"] for window in drawn])
    ends = np.array([celsius.min(), line["at_celsius"], celsius.max()])
    ends.sort()
    traces = [
        _trace_points(drawn, name, celsius),
        _trace_line("slope", ends, ends - line["at_celsius"], line, "per_kelvin", factor),
    ]
    slope = format_cell(name, line["per_kelvin"], compute_half_width(line), " ")
    alt = (
        f"Axis {history.axis}: {describe_name(name)} over the temperature of the slide-way, {slope} {unit} per kelvin."
    )
    return Chart("temperature of the slide-way (degC)", [Panel(f"{name.partition('_')[0]} ({unit})", traces)], alt)


def _trace_published(history: AxisHistory, name: str) -> list[Trace]:
    rows = [row for row in history.rows if name in row["parameters"]]
    if len(rows) > MOST_SINGLE_ESTIMATES or len(history.list_estimates(name)) > MOST_SINGLE_ESTIMATES:
        rows = list({row["time"][:10]: row for row in rows}.values())
    if not rows:
        return []
    values = np.array([row["parameters"][name]["value"] for row in rows]) * DISPLAY_UNITS[name][1]
    return [Trace("published", _parse_times_s(row["time"] for row in rows), values, COLOURS[1])]


def _trace_estimates(history: AxisHistory, name: str) -> list[Trace]:
    known = history.list_estimates(name)
    if not known:
        return []
    time_s = _parse_times_s(window["time"] for window in known)
    if len(known) <= MOST_SINGLE_ESTIMATES:
        return [_trace_points(known, name, time_s)]
    values = np.array([window["parameters"][name]["value"] for window in known]) * DISPLAY_UNITS[name][1]
    starts = np.flatnonzero(np.diff(time_s // DAY_S, prepend=-1.0))
    days = np.split(values, starts[1:])
    low, middle, high = (
        np.array([np.percentile(day, p) for day in days]) for p in (DAY_PERCENTILES[0], 50.0, DAY_PERCENTILES[1])
    )
    at = np.array([float(np.median(part)) for part in np.split(time_s, starts[1:])])
    return [Trace("median of the day, with 90 % of its rapids", at, middle, COLOURS[0], low=low, high=high)]


def _trace_points(windows: Sequence[Mapping[str, Any]], name: str, at: Float) -> Trace:
    factor = DISPLAY_UNITS[name][1]
    values = np.array([window["parameters"][name]["value"] for window in windows]) * factor
    half = INTERVAL_95 * np.array([window["parameters"][name]["std"] for window in windows]) * factor
    return Trace("each rapid, 95 % interval", at, values, COLOURS[0], "points", values - half, values + half)


def _trace_line(label: str, ends: Float, away: Float, line: Mapping[str, Any], key: str, factor: float) -> Trace:
    value, one, other = (factor * (line["level"] + line[which] * away) for which in (key, "low", "high"))
    return Trace(label, ends, value, INK, "dashed", np.minimum(one, other), np.maximum(one, other))


def _select_levels(history: AxisHistory, name: str, traces: Sequence[Trace]) -> list[tuple[str, float]]:
    shown = [values for trace in traces for values in (trace.low, trace.y, trace.high) if values is not None]
    if not shown:
        return []
    low, high = min(float(np.nanmin(v)) for v in shown), max(float(np.nanmax(v)) for v in shown)
    limits = (history.health or {}).get("limits", {})
    named = {"nominal": history.nominal.get(name), "limit": limits.get(name, {}).get("limit")}
    levels = [(label, value * DISPLAY_UNITS[name][1]) for label, value in named.items() if value is not None]
    room = IN_VIEW * max(high - low, 0.02 * abs(high))
    return [(label, level) for label, level in levels if low - room <= level <= high + room]


def _describe_trend(history: AxisHistory, name: str) -> str:
    unit, factor = DISPLAY_UNITS[name]
    known = [row["parameters"][name]["value"] for row in history.rows if name in row["parameters"]]
    known = known or [window["parameters"][name]["value"] for window in history.list_estimates(name)]
    ends = f", first {known[0] * factor:.4g} {unit}, latest {known[-1] * factor:.4g} {unit}" if known else ""
    return f"Axis {history.axis}: history of {describe_name(name)}{ends}."


def _parse_time_s(date: str) -> float:
    return datetime.fromisoformat(date).timestamp()


def _parse_times_s(dates: Any) -> Float:
    return np.array([_parse_time_s(date) for date in dates])
