"""Shows trends, changes and notices of the history on the terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape

from fdhil.cli.status_view import make_narrow_table, open_console
from fdhil.report import build_slope_rows, describe_change, format_minute

SHOWN_OPEN, SHOWN_DONE = 10, 5


def show_health(told: Mapping[str, Mapping[str, Any]], console: Console | None = None) -> None:
    """Print slopes, limits and changes of every axis that has some."""
    out = console or open_console()
    for axis, its in told.items():
        if rows := build_slope_rows(its):
            table = make_narrow_table(f"axis {axis}: slopes")
            for text in ("parameter", "per kelvin of\nthe slide-way", "per day", "maintenance limit"):
                table.add_column(text)
            for row in rows:
                table.add_row(*row)
            out.print(table)
        for change in its["changes"]:
            at = format_minute(change["time"])
            out.print(f"axis {axis}, window {change['window']} at {at}: {change['cause']}", highlight=False)
            out.print(f"  {describe_change(change)}", highlight=False)


def show_notices(notices: Sequence[Mapping[str, Any]], console: Console | None = None) -> None:
    """Print the pending notices, and the latest acknowledged ones with their operators."""
    out = console or open_console()
    waiting = [notice for notice in notices if notice["acknowledged"] is None]
    done = [notice for notice in notices if notice["acknowledged"] is not None]
    if waiting:
        out.print(f"pending notices (see fdhil acknowledge): {len(waiting)}", highlight=False)
    for notice in waiting[-SHOWN_OPEN:]:
        out.print(escape(_format_notice(notice)), highlight=False)
    for notice in done[-SHOWN_DONE:]:
        given = notice["acknowledged"]
        note = f": {given['note']}" if given["note"] else ""
        text = f"{_format_notice(notice)}\n    acknowledged by {given['who']} on {format_minute(given['time'])}{note}"
        out.print(escape(text), highlight=False)


def _format_notice(notice: Mapping[str, Any]) -> str:
    where = f"{notice['axis']}: " if notice["axis"] else ""
    number = "" if notice["number"] is None else f"{notice['number']:>5}  "
    return f"{number}{format_minute(notice['time'])}  {notice['severity']:5}  {where}{notice['code']}: {notice['text']}"
