"""The daemon's status and the stored history as tables for a person."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fdhil.cli.parameter_view import MEANING, cell, half_of, head
from fdhil.records import PARAMETERS

BARS = "▁▂▃▄▅▆▇█"
COURSE = 7  # revisions in a row of bars: what fits the column of a value


def open_console() -> Console:
    """Return a console for stdout: as wide as the terminal or as COLUMNS says, 80 columns where there is neither."""
    return Console(width=shutil.get_terminal_size((80, 24)).columns)


def show(status: Mapping[str, Any], console: Console | None = None) -> None:
    """Print the status document."""
    out = console or open_console()
    source, sync, guard = status["source"], status["sync"], status.get("guard") or {}
    rate = "no SYNC yet" if sync["rate_hz"] is None else f"SYNC {sync['rate_hz']:.1f} Hz of {sync['expected_hz']:.0f}"
    out.print(f"[bold]{escape(status['machine'])}[/bold]: {source['state']}, {rate}, up {status['uptime_s']:.0f} s")
    counted = ", ".join(f"{name} {value}" for name, value in _flat(status.get("counters", {})))
    out.print(f"frames: {counted or 'none'}")
    loads = "".join(f", {bus} loaded {load:.0f} %" for bus, load in status["bus_load_percent"].items())
    out.print(
        f"correction: {escape(status['state'])}, guard {escape(str(guard.get('state', 'absent')))}{escape(loads)}"
    )
    if guard.get("shadow_um"):
        would = ", ".join(f"{axis} {offset:+.1f} um" for axis, offset in guard["shadow_um"].items())
        out.print(escape(f"in shadow, not sent: {would}"))
    for refused in ((status.get("armed") or {}).get("check") or {}).get("refused", []):
        out.print(f"[red]the correction ends early: {escape(refused)}[/red]")
    if checking := status.get("checking"):
        out.print(escape(f"checking {checking['program']}: {checking['checked_s']:.0f} s, line {checking['line']}"))
    if status["store"]["fault"]:
        out.print(f"[red]store: {escape(status['store']['fault'])}[/red], in shadow")
    out.print(_axes_table(status["axes"]))
    for notice in status["notices"][-5:]:
        axis = f"{notice['axis']}: " if notice["axis"] else ""
        out.print(
            escape(f"{notice['age_s']:8.0f} s ago  {notice['severity']:5}  {axis}{notice['code']}: {notice['text']}")
        )


def _flat(counters: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    flat: list[tuple[str, Any]] = []
    for name, value in counters.items():
        flat += _flat(value, f"{prefix}{name} ") if isinstance(value, Mapping) else [(f"{prefix}{name}", value)]
    return flat


def _axes_table(axes: Mapping[str, Any]) -> Table:
    table = narrow_table()
    for text in ("axis", "windows\nok/not", "rev", *map(head, PARAMETERS)):
        table.add_column(text, no_wrap=True)
    for name, axis in axes.items():
        told = axis["parameters"]
        cells = [cell(p, told[p]["value"], half_of(told[p])) for p in PARAMETERS] if told else ["-"] * len(PARAMETERS)
        table.add_row(name, f"{axis['accepted']}/{axis['refused']}", str(axis["revision"] or "-"), *cells)
    return table


def narrow_table(title: str | None = None) -> Table:
    """Return a table whose columns of parameters fit 80 columns, and which says what ± means in it."""
    table = Table(title=title, title_justify="left", caption=MEANING, caption_justify="left", box=box.SIMPLE_HEAD)
    table.show_edge, table.pad_edge, table.collapse_padding = False, False, True
    return table


def sparkline(values: Sequence[float]) -> str:
    """Return values as a row of bars, the lowest to the highest."""
    low, high = min(values), max(values)
    span = high - low or 1.0
    return "".join(BARS[min(7, int((value - low) / span * 8))] for value in values)


def show_history(rows: Sequence[Mapping[str, Any]], console: Console | None = None, newest: int = 15) -> None:
    """Print the newest revisions of every axis, and each parameter's course over all of them."""
    out = console or open_console()
    for axis in sorted({row["axis"] for row in rows}):
        of_axis = [row for row in rows if row["axis"] == axis]
        names = list(of_axis[0]["parameters"])
        first, last = (of_axis[k]["time"][:10] for k in (0, -1))
        table = narrow_table(f"axis {axis}: {len(of_axis)} revisions, {first} to {last}")
        for text in ("rev", "time", "degC", "win", *map(head, names)):
            table.add_column(text, no_wrap=True)
        for row in of_axis[-newest:]:
            degrees = "-" if row["temperature_c"] is None else f"{row['temperature_c']:.1f}"
            cells = [cell(name, told["value"], half_of(told)) for name, told in row["parameters"].items()]
            time = row["time"][5:16].replace("T", "\n")
            table.add_row(str(row["revision"]), time, degrees, str(row["windows_used"]), *cells)
        courses = [sparkline([row["parameters"][name]["value"] for row in of_axis[-COURSE:]]) for name in names]
        table.add_section()
        table.add_row("", "course", "", "", *courses)
        out.print(table)
