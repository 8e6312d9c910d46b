"""The stored history as one HTML page."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdhil.cli.status_view import with_interval
from fdhil.config import MachineConfig


def write_report(machine: MachineConfig, rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write the report of all revisions (see ``fdhil history --json``). FdhilError without the extra ``report``."""
    from fdhil.report import Page, write

    axes = dict.fromkeys(row["axis"] for row in rows)
    sections = [_axis_section(axis, [row for row in rows if row["axis"] == axis]) for axis in axes]
    headline = [(f"axis {axis}", f"{sum(row['axis'] == axis for row in rows)} revisions") for axis in axes]
    page = Page(f"{machine.machine.name}: identified drives", "parameters with 95 % intervals", headline, sections)
    write(page, path)


def _axis_section(axis: str, rows: Sequence[Mapping[str, Any]]) -> Any:
    from fdhil.report import Section, Table

    names = list(rows[0]["parameters"])
    table = Table(
        head=["revision", "time", "degC", "windows", *names],
        rows=[
            [
                str(row["revision"]),
                row["time"],
                "" if row["temperature_c"] is None else f"{row['temperature_c']:.2f}",
                str(row["windows_used"]),
                *(with_interval(row["parameters"][name]) for name in names),
            ]
            for row in rows
        ],
        caption=f"Published parameter sets of axis {axis}",
    )
    return Section(f"Axis {axis}", tables=[table], figures=[("Course of each parameter", _svg(rows))])


def _svg(rows: Sequence[Mapping[str, Any]]) -> str:
    from fdhil.cli.history_plot import courses

    sink = io.StringIO()
    courses(rows).savefig(sink, format="svg")
    text = sink.getvalue()
    return text[text.index("<svg") :]
