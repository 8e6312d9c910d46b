"""Which way a file goes from one format to another: a recording, or a log of the bus."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fdhil import tables
from fdhil.store.export import export_table
from fdhil.store.output import open_output
from fdhil.store.recordings import read_table


def export_file(recording: Path, out: Path, format_name: str | None, columns: Path | None) -> dict[str, Any]:
    """Write ``recording`` to ``out`` and return what ``--json`` tells of it; click.BadParameter for what cannot be."""
    suffix = out.suffix.lower()
    name = format_name or tables.RECORDING_SUFFIXES.get(suffix) or tables.BUS_LOG_SUFFIXES.get(suffix) or "csv"
    is_log = recording.suffix.lower() in tables.BUS_LOG_SUFFIXES
    if is_log != (name in tables.BUS_LOG_FORMATS):
        what, others = "a recording", tables.RECORDING_FORMATS
        if is_log:
            what, others = "a log of the bus", tables.BUS_LOG_FORMATS
        raise click.BadParameter(f"{recording} is {what}, which becomes {', '.join(others)}", param_hint="--format")
    if is_log:
        from fdhil.drivers.can.bus_log import converted_log

        content, frames = converted_log(recording, name)
        with open_output(out) as file:
            file.write(content)
        return {"format": name, "frames": frames}
    table = read_table(recording, columns)
    export_table(table, out, name)
    return {"format": name, "axis": table.headers.get("axis"), "rows": next(iter(table.columns.values())).size}
