"""Shows the daemon's status and the history as text and tables."""

import shutil
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fdhil.cli.loops_view import format_loop_status
from fdhil.cli.printable_console import PrintableConsole
from fdhil.records import PARAMETERS
from fdhil.report import INTERVAL_MEANING, compute_half_width, format_cell, format_heading

BARS = "▁▂▃▄▅▆▇█"
COURSE = 7  # revisions in a sparkline, limited by the column width
SHOWN_PASSES = 3
LIVE_S = 1.0
GUARD_LIVE_S = 2.0  # the daemon polls it twice a second
COUNTED = {
    "records_dropped": "records dropped",
    "ring_overflow": "not read in time",
    "kernel_drops": "dropped by the kernel",
    "error_frames": "error frames",
    "sync_missed": "SYNC missed",
    "sync_duplicates": "SYNC doubled",
    "sync_out_of_order": "SYNC out of order",
    "pdo_lost": "PDO lost",
    "pdo_short": "PDO too short",
    "pdo_long": "PDO too long",
    "pdo_duplicates": "PDO doubled",
    "pdo_late": "PDO later than the next SYNC",
    "pdo_ambiguous": "PDO of uncertain SYNC",
    "failures": "polls failed",
}


def open_console() -> Console:
    """Return a console for stdout, as wide as the terminal or COLUMNS, else 80 columns."""
    return PrintableConsole(width=shutil.get_terminal_size((80, 24)).columns)


def show_status(status: Mapping[str, Any], console: Console | None = None) -> None:
    """Print the status document."""
    out = console or open_console()
    guard = status.get("guard") or {}
    out.print(
        f"[bold]{escape(status['machine'])}[/bold]: {_describe_source(status)}, up {_format_age(status['uptime_s'])}"
    )
    if difference := status.get("config_difference"):
        out.print(f"[red]{escape(difference)}[/red]")
    out.print(format_counters(status.get("counters", {})))
    if nc := status.get("nc"):
        out.print(escape(format_nc_state(nc)))
    loads = "".join(f", {bus} loaded {load:.0f} %" for bus, load in status["bus_load_percent"].items())
    out.print(escape(f"correction: {status['state']}, guard {_describe_guard(guard)}{loads}"))
    if lateness := guard.get("lateness"):
        out.print(format_lateness(lateness["recent"]))
    residual = status.get("may_stand", {"nothing": True})
    if guard.get("state") == "lost":
        out.print(f"[red]{escape(guard['text'])}[/red]")
    elif not residual["nothing"] and guard.get("state") in ("OFF", "FROZEN"):
        out.print(f"[red]{escape(residual['text'])}[/red]; hold the feed, then run fdhil adopt")
    if guard.get("shadow_um"):
        would = ", ".join(f"{axis} {offset:+.1f} um" for axis, offset in guard["shadow_um"].items())
        out.print(escape(f"shadow mode, not sent: {would}"))
    armed = status.get("armed") or {}
    if armed.get("promise"):
        out.print(escape(f"armed: {armed['program']}, {armed['promise']}"))
    for refused in (armed.get("check") or {}).get("refused", []):
        out.print(f"[red]the correction ends early: {escape(refused)}[/red]")
    for one in status.get("passes", [])[-SHOWN_PASSES:]:
        out.print(escape(one["text"]))
    if checking := status.get("checking"):
        out.print(escape(f"checking {checking['program']}: {checking['checked_s']:.0f} s, line {checking['line']}"))
    if status["store"]["fault"]:
        out.print(f"[red]store: {escape(status['store']['fault'])}[/red], in shadow")
    for trouble in status.get("troubles", []):
        where = f"{trouble['axis']}: " if trouble["axis"] else ""
        out.print(f"[red]{escape(where + trouble['code'])}[/red]: {escape(trouble['text'])}")
    for alarm in _select_other_alarms(status):
        where = f"{alarm['axis']}: " if alarm["axis"] else ""
        often = f", {alarm['count']} times since {alarm['first']}" if alarm["count"] > 1 else ""
        out.print(
            f"[red]{escape(where + alarm['code'])}[/red] active since {alarm['since']}{often}: {escape(alarm['text'])}"
        )
    out.print(_build_axes_table(status["axes"]))
    for axis, found in status["axes"].items():
        if unused := _describe_unused_moves(found):
            out.print(escape(f"{axis}: {unused}"))
        if text := describe_model(found):
            out.print(escape(f"{axis}: {text}"))
        if (loops := found.get("loops")) and (line := format_loop_status(loops)):
            out.print(escape(f"{axis}: {line}"))
    if (waiting := status.get("unacknowledged") or {}).get("count"):
        out.print(f"pending notices: {waiting['count']}, of them MAJOR {waiting['MAJOR']}")
    for notice in status["notices"][-5:]:
        out.print(escape(_format_notice(notice)))


def _select_other_alarms(status: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    # alarms that are also troubles are shown as troubles
    shown = {(trouble["code"], trouble["axis"]) for trouble in status.get("troubles", [])}
    alarms = (status.get("alarms") or {}).get("first", [])
    return [one for one in alarms if one["state"] == "active" and (one["code"], one["axis"]) not in shown]


def _format_notice(notice: Mapping[str, Any]) -> str:
    axis = f"{notice['axis']}: " if notice["axis"] else ""
    given = notice.get("acknowledged")
    seen = f" (acknowledged by {given['who']})" if given else ""
    number = f"  {notice['number']:>4}" if notice.get("number") is not None else "      "
    line = f"{_format_age(notice['age_s']):>9} ago{number}  {notice['severity']:5}  "
    return f"{line}{axis}{notice['code']}: {notice['text']}{seen}"


def _describe_source(status: Mapping[str, Any]) -> str:
    source, sync = status["source"], status["sync"]
    state = source["state"]
    if state != "listening":
        state = (
            f"[red]{state}[/red] for {_format_age(source['heard_s_ago'] if state == 'silent' else source['since_s'])}"
        )
    quiet = [f"{bus} silent for {_format_age(age_s)}" for bus, age_s in source["buses"].items() if age_s > LIVE_S]
    if state == "listening" and quiet:
        state = f"{state}, [red]{escape(', '.join(quiet))}[/red]"
    if sync["rate_hz"] is not None:
        return f"{state}, SYNC {sync['rate_hz']:.1f} Hz of {sync['expected_hz']:.0f}"
    last_s = sync["heard_s_ago"]
    return f"{state}, " + ("no SYNC yet" if last_s is None else f"no SYNC for {_format_age(last_s)}")


def _describe_guard(guard: Mapping[str, Any]) -> str:
    # an old answer may be outdated
    state, received_s = str(guard.get("state", "absent")), guard.get("heard_s_ago")
    if state == "absent" or received_s is None:
        return state
    if state == "lost":
        return f"lost, last seen {_format_age(received_s)} ago in state {guard.get('last_state')}"
    return state if received_s <= GUARD_LIVE_S else f"{state} at its last answer, {_format_age(received_s)} ago"


def format_lateness(recent: Mapping[str, Any]) -> str:
    """Return the lateness of this PC in the last minute or two, measured by the guard, as text."""
    worst = f"the slowest after {recent['worst_us'] / 1e3:.2f} ms"
    turns = group_digits(recent["turns"])
    if not recent["late"]:
        return f"this PC: none of the last {turns} offsets late, {worst}"
    return f"[red]this PC: {group_digits(recent['late'])} of the last {turns} offsets late[/red], {worst}"


def format_nc_state(nc: Mapping[str, Any]) -> str:
    """Return the state reported by the NC as text."""
    if nc["motion"] == "unknown":
        return f"NC: no data for {_format_age(nc['heard_s_ago'])}, its moves are unknown"
    program = (nc["program"] or "").rpartition("/")[2]
    line = "" if nc["line"] is None else f" line {nc['line']}" + (f" of {program}" if program else "")
    parts = [f"{nc['motion']}{line}"]
    parts += [
        f"{what.replace('_', ' ')} {100 * nc[what]:.0f} %"
        for what in ("feed_override", "rapid_override")
        if nc[what] is not None
    ]
    parts += ["feed hold"] if nc["feed_hold"] else []
    return "NC: " + ", ".join(parts)


def _format_age(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def group_digits(count: int) -> str:
    """Return a count with its digits in groups of three."""
    return f"{count:,}".replace(",", " ")


def format_counters(counters: Mapping[str, Any]) -> str:
    """Return the frame counters as text: received, lost, and all others that are not 0."""
    if not counters:
        return "frames: none"
    text = f"frames received {group_digits(counters.get('frames', 0))}, lost {group_digits(counters.get('lost', 0))}"
    parts = []
    for name, count in counters.items():
        where, _, what = name.rpartition(".")
        if count and what in COUNTED:
            parts.append(
                f"{where}: {COUNTED[what]} {group_digits(count)}" if where else f"{COUNTED[what]} {group_digits(count)}"
            )
    return escape(f"{text} ({'; '.join(parts)})" if parts else text)


def _describe_unused_moves(axis: Mapping[str, Any]) -> str:
    moves = axis.get("moves") or {}
    reasons = [f"{count} refused: {code}" for code, count in axis.get("refused_by", {}).items()]
    if moves.get("too_slow"):
        reasons.insert(
            0, f"{moves['too_slow']} slower than a rapid (the fastest of all reached {moves['fastest_mm_s']:.4g} mm/s)"
        )
    if moves.get("without_plateau"):
        reasons.append(f"{moves['without_plateau']} too short for a plateau")
    return f"{moves.get('seen', 0)} moves detected; not used: {', '.join(reasons)}" if reasons else ""


def describe_model(axis: Mapping[str, Any]) -> str:
    """Return additional terms, unexplained error at the table, and warnings of an axis as text."""
    terms = ", ".join(
        f"{name} {format_cell(name, term['value'], compute_half_width(term), ' ')} {term['unit']}"
        for name, term in (axis.get("terms") or {}).items()
    )
    left, table = axis.get("unexplained_um"), (axis.get("last_window") or {}).get("at_table")
    seen = f"table error of {table['error_rms_um']:.2f} um RMS in the last rapid" if table else ""
    parts = [terms, "" if left is None else f"{left:.2f} um of the rapids unexplained", seen, *axis.get("warnings", [])]
    return "; ".join(part for part in parts if part)


def _build_axes_table(axes: Mapping[str, Any]) -> Table:
    table = make_narrow_table()
    for text in ("axis", "windows\nok/not", "rev", *map(format_heading, PARAMETERS)):
        table.add_column(text, no_wrap=True)
    for name, axis in axes.items():
        found = axis["parameters"]
        cells = (
            [format_cell(p, found[p]["value"], compute_half_width(found[p])) for p in PARAMETERS]
            if found
            else ["-"] * len(PARAMETERS)
        )
        table.add_row(name, f"{axis['accepted']}/{axis['refused']}", str(axis["revision"] or "-"), *cells)
    return table


def make_narrow_table(title: str | None = None) -> Table:
    """Return a table whose parameter columns fit 80 columns, with a caption that explains ±."""
    table = Table(
        title=title, title_justify="left", caption=INTERVAL_MEANING, caption_justify="left", box=box.SIMPLE_HEAD
    )
    table.show_edge, table.pad_edge, table.collapse_padding = False, False, True
    return table


def draw_sparkline(values: Sequence[float]) -> str:
    """Return values as a row of bars, scaled from the lowest to the highest."""
    low, high = min(values), max(values)
    span = high - low or 1.0
    return "".join(BARS[min(7, int((value - low) / span * 8))] for value in values)


def show_history(rows: Sequence[Mapping[str, Any]], console: Console | None = None, newest: int = 15) -> None:
    """Print the newest revisions of every axis, and the trend of each parameter."""
    out = console or open_console()
    for axis in sorted({row["axis"] for row in rows}):
        of_axis = [row for row in rows if row["axis"] == axis]
        names = list(of_axis[0]["parameters"])
        first, last = (of_axis[k]["time"][:10] for k in (0, -1))
        table = make_narrow_table(f"axis {axis}: {len(of_axis)} revisions, {first} to {last}")
        for text in ("rev", "time\nUTC", "degC", "win", *map(format_heading, names)):
            table.add_column(text, no_wrap=True)
        for row in of_axis[-newest:]:
            degrees = "-" if row["temperature_c"] is None else f"{row['temperature_c']:.1f}"
            cells = [
                format_cell(name, found["value"], compute_half_width(found))
                for name, found in row["parameters"].items()
            ]
            time = row["time"][5:16].replace("T", "\n")
            table.add_row(str(row["revision"]), time, degrees, str(row["windows_used"]), *cells)
        courses = [draw_sparkline([row["parameters"][name]["value"] for row in of_axis[-COURSE:]]) for name in names]
        table.add_section()
        table.add_row("", "trend", "", "", *courses)
        out.print(table)
