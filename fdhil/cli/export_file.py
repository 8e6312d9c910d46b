"""Conversion of recordings and bus logs between file formats."""

from pathlib import Path
from typing import Any

import click

from fdhil import tables
from fdhil.store import BUS_LOGS, RECORDING_SUFFIXES, export_table, open_output, read_column_map, read_table


def export_file(recording: Path, out: Path, format_name: str | None, columns: Path | None) -> dict[str, Any]:
    """Write ``recording`` to ``out``; return the JSON document. Raises click.BadParameter for an invalid format."""
    suffix = out.suffix.lower()
    name = format_name or RECORDING_SUFFIXES.get(suffix) or BUS_LOGS.get(suffix) or "csv"
    is_log = recording.suffix.lower() in BUS_LOGS
    if is_log != (name in BUS_LOGS.values()):
        what, others = "a recording", [*tables.RECORDING_FORMATS]
        if is_log:
            what, others = "a bus log", [*BUS_LOGS.values()]
        raise click.BadParameter(f"{recording} is {what}, which converts to {', '.join(others)}", param_hint="--format")
    if is_log:
        from fdhil.drivers import convert_log

        log = convert_log(recording, BUS_LOGS[recording.suffix.lower()], name)
        with open_output(out) as file:
            file.write(log.content)
        return {"format": name} | log.report_conversion()
    table = read_table(recording, None if columns is None else read_column_map(columns))
    export_table(table, out, name)
    return {"format": name, "axis": table.headers.get("axis"), "rows": next(iter(table.columns.values())).size}
