"""HTML report of the stored history: the condition of the drives first, then the evidence."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdhil.config import MachineConfig
from fdhil.report import (
    DAY_PERCENTILES,
    DISPLAY_UNITS,
    IN_ORDER,
    INTERVAL_MEANING,
    LATEST_HEAD,
    MOST_SINGLE_ESTIMATES,
    PARAMETER_MEANINGS,
    AxisHistory,
    Page,
    Refusals,
    Section,
    Table,
    build_latest_rows,
    build_slope_rows,
    build_temperature_chart,
    build_time_chart,
    compute_half_width,
    describe_change,
    describe_condition,
    format_cell,
    render_svg,
    write_page_or_pdf,
)

MOST_REVISIONS = 50
MOST_NOTICES = 30
WIDTH, HEIGHT = 4.8, 2.6  # of a trend, inches


def write_report(
    machine: MachineConfig,
    histories: Sequence[AxisHistory],
    refused: Mapping[str, Refusals],
    path: Path,
    pdf: Path | None = None,
    notices: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Write the report of all recorded axes and their notices. Raises FdhilError without the extra ``report``."""
    sections = [_build_verdict_section(machine, histories, refused)]
    sections += [_build_axis_section(history, refused.get(history.axis, Refusals())) for history in histories]
    sections += [_build_notice_section(notices)] if notices else []
    page = Page(
        f"{machine.machine.name}: condition of the drives",
        f"Identified from rapid moves; {_describe_time_span(histories)}. {INTERVAL_MEANING.capitalize()}.",
        [_build_tile(history, refused.get(history.axis, Refusals())) for history in histories],
        sections,
    )
    write_page_or_pdf(page, path, pdf)


def _describe_time_span(histories: Sequence[AxisHistory]) -> str:
    times = [window["time"] for history in histories for window in (history.health or {}).get("windows", ())]
    times += [row["time"] for history in histories for row in history.rows]
    return f"from {min(times)[:10]} to {max(times)[:10]}" if times else "nothing identified yet"


def _build_tile(history: AxisHistory, refused: Refusals) -> tuple[str, str]:
    limits = (history.health or {}).get("limits", {})
    if any(limit["reached"] for limit in limits.values()):
        return f"axis {history.axis}", "limit reached"
    if not (history.health or {}).get("windows") and not history.rows:
        return f"axis {history.axis}", "not identified"
    first = min((limit["date"] for limit in limits.values()), default=None)
    verdict = describe_condition(history, refused)[0]
    return (
        f"axis {history.axis}",
        f"limit {first[:10]}" if first else "in order" if verdict == IN_ORDER else "see below",
    )


def _build_verdict_section(
    machine: MachineConfig, histories: Sequence[AxisHistory], refused: Mapping[str, Refusals]
) -> Section:
    shares = machine.maintenance.model_dump()
    rows = [[history.axis, text] for history in histories
            for text in describe_condition(history, refused.get(history.axis, Refusals()))]  # fmt: skip
    latest = [
        Table(LATEST_HEAD, build_latest_rows(history, shares), f"Axis {history.axis}: the newest published parameters")
        for history in histories
        if history.rows
    ]
    return Section("Condition", "", [Table(("axis", "condition"), rows), *latest])


def _build_axis_section(history: AxisHistory, refused: Refusals) -> Section:
    many = (
        max((len(history.list_estimates(name)) for name in history.list_parameters()), default=0)
        > MOST_SINGLE_ESTIMATES
    )
    shown = "" if not many else (
        f"With more than {MOST_SINGLE_ESTIMATES} rapids the plots show the median of each day, and a band from the "
        f"{DAY_PERCENTILES[0]:.0f}th to "
        f"the {DAY_PERCENTILES[1]:.0f}th percentile."
    )  # fmt: skip
    tables = [
        *_build_health_tables(history.health),
        *_build_refusal_tables(refused),
        *_build_revision_tables(history.rows),
    ]
    return Section(f"Axis {history.axis}", shown, tables, _draw_trends(history))


def _draw_trends(history: AxisHistory) -> list[tuple[str, str]]:
    pictures = []
    for name in history.list_parameters():
        what = f"{name.partition('_')[0]}, {PARAMETER_MEANINGS[name]}"
        pictures.append((f"{what}, over time", render_svg(build_time_chart(history, name), WIDTH, HEIGHT)))
    for name in history.list_parameters():
        if (course := build_temperature_chart(history, name)) is not None:
            what = f"{name.partition('_')[0]}, {PARAMETER_MEANINGS[name]}"
            caption = f"{what}, over the temperature of the slide-way, with which it varies"
            pictures.append((caption, render_svg(course, WIDTH, HEIGHT)))
    return pictures


def _build_health_tables(health: Mapping[str, Any] | None) -> list[Table]:
    if health is None:
        return []
    slopes = Table(
        head=["parameter", "per kelvin", "per day", "maintenance limit"],
        rows=build_slope_rows(health),
        caption=f"Slopes since the last change; {INTERVAL_MEANING}",
    )
    changes = Table(
        head=["time", "window", "parameters that changed", "likely cause"],
        rows=[[_format_minute(c["time"]), str(c["window"]), describe_change(c), c["cause"]] for c in health["changes"]],
        caption="Changes",
    )
    return [table for table in (slopes, changes) if table.rows]


def _build_refusal_tables(refused: Refusals) -> list[Table]:
    if not refused.refused:
        return []
    rows = [[code, str(count), text, time] for code, count, text, time in refused.reasons]
    caption = f"Refused rapids: {refused.refused} of {refused.seen}"
    return [Table(("reason", "count", "text of the latest", "time of the latest"), rows, caption)]


def _build_revision_tables(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    if not rows:
        return []
    names = list(dict.fromkeys(name for row in rows for name in row["parameters"]))
    head = ["revision", "time (UTC)", "degC", "windows", *(f"{name} {DISPLAY_UNITS[name][0]}" for name in names)]
    newest = rows[-MOST_REVISIONS:][::-1]
    left_out = len(rows) - len(newest)
    cells = [
        [
            str(row["revision"]),
            _format_minute(row["time"]),
            "" if row["temperature_c"] is None else f"{row['temperature_c']:.2f}",
            str(row["windows_used"]),
            *(format_cell(name, its["value"], compute_half_width(its), " ") for name, its in row["parameters"].items()),
        ]
        for row in newest
    ]
    more = f"; {left_out} older ones are omitted (fdhil history --json lists them)" if left_out else ""
    caption = f"Published parameter sets, newest first{more}; {INTERVAL_MEANING}"
    return [Table(head, cells, caption, folded=f"{len(rows)} published parameter sets")]


def _build_notice_section(notices: Sequence[Mapping[str, Any]]) -> Section:
    waiting = sum(notice["acknowledged"] is None for notice in notices)
    shown = sorted(notices, key=lambda notice: (notice["acknowledged"] is not None, -notice["number"]))[:MOST_NOTICES]
    rows = [
        [
            _format_minute(n["time"]),
            n["severity"],
            n["axis"] or "-",
            f"{n['code']}: {n['text']}",
            _format_acknowledgement(n["acknowledged"]),
        ]
        for n in shown
    ]
    caption = f"{waiting} pending; {len(shown)} of {len(notices)} are shown"
    return Section("Notices", "", [Table(("time (UTC)", "severity", "axis", "notice", "acknowledged"), rows, caption)])


def _format_acknowledgement(given: Mapping[str, Any] | None) -> str:
    if given is None:
        return "pending"
    return f"{given['who']}, {_format_minute(given['time'])}" + (f": {given['note']}" if given["note"] else "")


def _format_minute(time: str) -> str:
    return time[:16].replace("T", " ")
