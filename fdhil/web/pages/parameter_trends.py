"""The drives' history for the browser: the state of each axis, and the trend of each parameter. Reads only."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from fdhil.config import MachineConfig
from fdhil.records import INTERVAL_95
from fdhil.report import (
    COLOURS,
    DISPLAY_UNITS,
    IN_ORDER,
    NOT_IDENTIFIED,
    PARAMETER_MEANINGS,
    AxisHistory,
    Chart,
    Refusals,
    build_latest_rows,
    build_temperature_chart,
    build_time_chart,
    compute_half_width,
    describe_change,
    describe_condition,
    describe_name,
    export_chart,
    format_cell,
)

MOST_REVISIONS = 50
MOST_ESTIMATES = 50
LINE_COLOUR = 3
LATEST = ("parameter", "latest", "unit", "nominal", "beside_nominal", "since_first", "may_change_by", "limit")
"""The names of the cells of :func:`fdhil.report.condition_summary.build_latest_rows`."""
State = Literal["good", "warn", "bad", "none"]


def classify_axis(history: AxisHistory, refused: Refusals) -> State:
    """Return the state of an axis: good, to be checked, at a limit, or unknown."""
    limits = (history.health or {}).get("limits", {})
    if any(limit["reached"] for limit in limits.values()):
        return "bad"
    findings = describe_condition(history, refused)
    return "good" if findings == [IN_ORDER] else "none" if findings == [NOT_IDENTIFIED] else "warn"


def summarise_axis(history: AxisHistory, refused: Refusals) -> dict[str, Any]:
    """Return the summary of an axis."""
    windows = (history.health or {}).get("windows", ())
    return {
        "axis": history.axis,
        "state": classify_axis(history, refused),
        "says": describe_condition(history, refused),
        "newest_time": windows[-1]["time"] if windows else None,
        "rapids_believed": len(windows),
        "rapids_refused": refused.refused,
        "rapids_seen": refused.seen,
    }


def make_axis_document(machine: MachineConfig, history: AxisHistory, refused: Refusals) -> dict[str, Any]:
    """Return the complete document of an axis."""
    health = history.health or {}
    return {
        **summarise_axis(history, refused),
        "latest": [
            dict(zip(LATEST, row, strict=True)) for row in build_latest_rows(history, machine.maintenance.model_dump())
        ],
        "limits": [_format_limit(name, limit) for name, limit in health.get("limits", {}).items()],
        "slopes": _format_slopes(health),
        "changes": [_format_change(change) for change in health.get("changes", ())[::-1]],
        "refused": [
            {"code": code, "count": count, "last_text": text, "last_time": time}
            for code, count, text, time in refused.reasons
        ],
        "courses": [_make_trend(history, name) for name in history.list_parameters()],
        "revisions": [_format_revision(row) for row in history.rows[-MOST_REVISIONS:][::-1]],
        "revisions_kept": len(history.rows),
    }


def _format_limit(name: str, limit: Mapping[str, Any]) -> dict[str, Any]:
    unit, factor = DISPLAY_UNITS[name]
    dates = {key: limit[key] for key in ("reached", "date", "earliest", "latest")}
    return {"parameter": name, "name": describe_name(name), "value": limit["limit"] * factor, "unit": unit, **dates}


def _format_slopes(health: Mapping[str, Any]) -> list[dict[str, Any]]:
    found = []
    for name in DISPLAY_UNITS:
        lines = {key: health.get(of, {}).get(name) for key, of in (("per_kelvin", "slopes"), ("per_day", "trends"))}
        if any(lines.values()):
            shown = {
                key: line and format_cell(name, line[key], compute_half_width(line), " ") for key, line in lines.items()
            }
            found.append({"parameter": name, "name": describe_name(name), "unit": DISPLAY_UNITS[name][0], **shown})
    return found


def _format_change(change: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "time": change["time"],
        "window": change["window"],
        "moved": describe_change(change),
        "cause": change["cause"],
    }


def _make_trend(history: AxisHistory, name: str) -> dict[str, Any]:
    unit, factor = DISPLAY_UNITS[name]
    warming = build_temperature_chart(history, name)
    return {
        "parameter": name,
        "name": describe_name(name),
        "unit": unit,
        "meaning": PARAMETER_MEANINGS[name],
        "over_time": _make_chart(build_time_chart(history, name)),
        "over_temperature": None if warming is None else _make_chart(warming),
        "estimates": [
            _format_estimate(name, factor, window) for window in history.list_estimates(name)[-MOST_ESTIMATES:][::-1]
        ],
    }


def _make_chart(chart: Chart) -> dict[str, Any]:
    """Return a chart for the browser: colours are numbers, so that they suit a dark page too."""
    document = export_chart(chart)
    for trace in (trace for panel in document["panels"] for trace in panel["traces"]):
        trace["colour"] = COLOURS.index(trace["colour"]) + 1 if trace["colour"] in COLOURS else LINE_COLOUR
    return {**document, "words": chart.alt}


def _format_estimate(name: str, factor: float, window: Mapping[str, Any]) -> dict[str, Any]:
    figures = window["parameters"][name]
    half = INTERVAL_95 * figures["std"]
    return {
        "window": window["window"],
        "time": window["time"],
        "temperature_celsius": window["temperature_c"],
        "value": figures["value"] * factor,
        "half_width_95": half * factor,
        "shown": format_cell(name, figures["value"], half, " "),
    }


def _format_revision(row: Mapping[str, Any]) -> dict[str, Any]:
    parameters: Mapping[str, Mapping[str, Any]] = row["parameters"]
    return {
        "revision": row["revision"],
        "time": row["time"],
        "temperature_celsius": row["temperature_c"],
        "windows_used": row["windows_used"],
        "parameters": {
            name: format_cell(name, its["value"], compute_half_width(its), " ") for name, its in parameters.items()
        },
        "units": {name: DISPLAY_UNITS[name][0] for name in parameters},
    }


def sort_notices(notices: Sequence[Mapping[str, Any]], most: int) -> list[Mapping[str, Any]]:
    """Return notices with unacknowledged ones first, then the newest first."""
    return sorted(notices, key=lambda notice: (notice["acknowledged"] is not None, -notice["number"]))[:most]
