"""The daemon's status and the stored history as tables for a person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

BARS = "▁▂▃▄▅▆▇█"
COURSE = 14  # revisions in a row of bars: what fits the column of a value with its interval


def open_console() -> Console:
    """Return a console for stdout: as wide as the terminal, or wide enough for the tables where there is none."""
    console = Console()
    return console if console.is_terminal else Console(width=150)


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
    table = Table(show_edge=False, pad_edge=False)
    for head in ("axis", "windows", "revision", "R ohm", "L mH", "K N.m/A", "Jt kg.m2", "ft N.m.s", "Cd N.m"):
        table.add_column(head)
    for name, axis in axes.items():
        windows = f"{axis['accepted']} accepted, {axis['refused']} refused"
        told = axis["parameters"]
        cells = [with_interval(told[p], 1e3 if p == "L" else 1) for p in told] if told else ["-"] * 6
        table.add_row(name, windows, str(axis["revision"] or "-"), *cells)
    return table


def with_interval(parameter: Mapping[str, Any], factor: float = 1.0) -> str:
    """Return ``value ±half`` of the 95 % interval, or why there is none."""
    if parameter["value"] is None:
        return "?"
    if parameter.get("low") is None:
        return f"{parameter['value'] * factor:.4g} (no interval)"
    half = (parameter["high"] - parameter["low"]) / 2 * factor
    return f"{parameter['value'] * factor:.4g} ±{half:.1g}"


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
        title = f"axis {axis}: {len(of_axis)} revisions, {first} to {last}"
        table = Table(title=title, show_edge=False, pad_edge=False)
        for head in ("revision", "time", "degC", "windows", *names):
            table.add_column(head)
        for row in of_axis[-newest:]:
            degrees = "-" if row["temperature_c"] is None else f"{row['temperature_c']:.2f}"
            cells = [with_interval(row["parameters"][name]) for name in names]
            time = row["time"][5:16].replace("T", " ")
            table.add_row(str(row["revision"]), time, degrees, str(row["windows_used"]), *cells)
        courses = [sparkline([row["parameters"][name]["value"] for row in of_axis[-COURSE:]]) for name in names]
        table.add_section()
        table.add_row("course", "", "", "", *courses)
        out.print(table)
