"""The stored history as one HTML page."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdhil.cli.history_trends import moved, slope_rows
from fdhil.cli.parameter_view import DISPLAY, MEANING, cell, half_of
from fdhil.config import MachineConfig


def write_report(
    machine: MachineConfig,
    rows: Sequence[Mapping[str, Any]],
    health: Mapping[str, Mapping[str, Any]],
    path: Path,
    pdf: Path | None = None,
) -> None:
    """Write the report of revisions and health (see ``fdhil history --json``). FdhilError without extra ``report``."""
    from fdhil.report import Page, deliver

    axes = sorted({row["axis"] for row in rows})
    sections = [_axis_section(axis, [row for row in rows if row["axis"] == axis], health.get(axis)) for axis in axes]
    headline = [(f"axis {axis}", f"{sum(row['axis'] == axis for row in rows)} revisions") for axis in axes]
    page = Page(f"{machine.machine.name}: identified drives", "parameters with 95 % intervals", headline, sections)
    deliver(page, path, pdf)


def _axis_section(axis: str, rows: Sequence[Mapping[str, Any]], told: Mapping[str, Any] | None) -> Any:
    from fdhil.report import Section, Table

    names = list(rows[0]["parameters"])
    table = Table(
        head=["revision", "time (UTC)", "degC", "windows", *(f"{name} {DISPLAY[name][0]}" for name in names)],
        rows=[
            [
                str(row["revision"]),
                row["time"][:19].replace("T", " "),
                "" if row["temperature_c"] is None else f"{row['temperature_c']:.2f}",
                str(row["windows_used"]),
                *(cell(name, its["value"], half_of(its), " ") for name, its in row["parameters"].items()),
            ]
            for row in rows
        ],
        caption=f"Published parameter sets of axis {axis}; {MEANING}",
    )
    tables = [table] if told is None else [table, *_health_tables(told)]
    return Section(
        f"Axis {axis}",
        tables=tables,
        figures=[("Course of each parameter", _svg(rows, {axis: told} if told else {}))],
        wide=True,
    )


def _health_tables(told: Mapping[str, Any]) -> list[Any]:
    """Return slopes with dates of the limits, and the changes, each where there are any."""
    from fdhil.report import Table

    slopes = Table(
        head=["parameter", "per kelvin", "per day", "maintenance limit"],
        rows=slope_rows(told),
        caption=f"Slopes since the last change; {MEANING}",
    )
    changes = Table(
        head=["time", "window", "parameters", "likely cause"],
        rows=[[c["time"], str(c["window"]), moved(c), c["cause"]] for c in told["changes"]],
        caption="Changes",
    )
    return [table for table in (slopes, changes) if table.rows]


def _svg(rows: Sequence[Mapping[str, Any]], health: Mapping[str, Mapping[str, Any]]) -> str:
    from fdhil.cli.history_plot import courses

    sink = io.StringIO()
    courses(rows, health).savefig(sink, format="svg")
    text = sink.getvalue()
    return text[text.index("<svg") :]
