"""Writes a trace in the formats of other programs: a dialect is one choice of each habit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fdhil.records import Float

SIGNALS = ("Voltage", "Current", "Velocity", "Position", "Command")
ROWS = 60


@dataclass(frozen=True)
class Dialect:
    separator: str = ";"
    quotes: str = ""  # "", "names", "all", "needed"
    decimal: str = "."
    thousands: str = ""
    names: str = "plain"  # "plain", "blanks", "unit", "comma"
    head: str = ""  # "", "remark", "list", "keys", "sep", "group"
    units: bool = False
    comment: str = ""
    footer: str = ""  # "", "remark", "statistics", "EOF", "cut"
    end: str = "\n"
    encoding: str = "utf-8"
    time: str = "ms"  # "ms", "s", "us", "clock", "date", "us date", "none"
    minus: str = "-"
    form: str = ".4f"
    trailing: bool = False
    extra: str = ""  # "", "text", "index"
    lost: str = ""  # "", or what stands in a cell without a value
    begins_s: float = 0.0
    repeated: bool = False


def make_signals() -> dict[str, Float]:
    k = np.arange(ROWS)
    bell = np.sin(np.pi * k / (ROWS - 1)) ** 2
    return {
        "Voltage": 90.0 * bell - 3.0 * np.cos(k),
        "Current": -12.5 * bell + 0.05 * np.sin(7.0 * k),
        "Velocity": 1300.0 * bell,
        "Position": 5.0 + 0.2 * np.cumsum(bell),
        "Command": 5.1 + 0.2 * np.cumsum(bell),
    }


def get_name(dialect: Dialect, signal: str) -> str:
    forms = {"plain": signal, "blanks": f"Axis {signal}", "unit": f"{signal} [x]", "comma": f"{signal}, actual"}
    return forms[dialect.names]


def format_number(value: float, dialect: Dialect) -> str:
    text = format(value, f",{dialect.form}" if dialect.thousands else dialect.form)
    table: dict[str, str | int | None] = {",": dialect.thousands, ".": dialect.decimal, "-": dialect.minus}
    return text.translate(str.maketrans(table))


def count_kept_rows(dialect: Dialect) -> list[int]:
    return [k for k in range(ROWS) if not (dialect.lost and k in (20, 21))]


def format_time(k: int, dialect: Dialect) -> str:
    seconds = dialect.begins_s + k * 1e-3
    if dialect.time in ("clock", "date", "us date"):
        of_day = (23 * 3600 + 59 * 60 + 59.97 + k * 1e-3) % 86400
        day = 5 if of_day > 43200 else 6
        minutes, rest = divmod(of_day, 60.0)
        clock = f"{int(minutes // 60):02d}:{int(minutes % 60):02d}:{rest:06.3f}".replace(".", dialect.decimal)
        before = {"clock": "", "date": f"2025-03-{day:02d}T", "us date": f"3/{day}/2025 "}[dialect.time]
        return before + clock
    form = {"ms": (1e3, ".1f"), "s": (1.0, ".6f"), "us": (1e6, ".0f")}[dialect.time]
    return format_number(float(format(seconds * form[0], form[1])), Dialect(decimal=dialect.decimal, form=form[1]))


def get_time_unit(dialect: Dialect) -> str:
    return dialect.time if dialect.time in ("ms", "us") else "s"


def write_trace(dialect: Dialect, values: dict[str, Float]) -> bytes:
    has_time = dialect.time != "none"
    names = [*(["Time"] if has_time else []), *(get_name(dialect, signal) for signal in values)]
    records = []
    for k in range(len(values["Voltage"])):
        cells = [format_time(k, dialect)] if has_time else []
        for signal in values:
            is_lost = dialect.lost and k in (20, 21) and signal == "Current"
            cells.append(dialect.lost.replace("empty", "") if is_lost else format_number(values[signal][k], dialect))
        records.append(cells)
    units = [*([get_time_unit(dialect)] if has_time else []), *("x" for _ in values)]
    if dialect.extra:
        names, units = [*names, "State"], [*units, "-"]
        records = [[*cells, "OK" if dialect.extra == "text" else str(k)] for k, cells in enumerate(records)]
    above = [_join_cells(names, dialect, is_name=True)] + (
        [_join_cells(units, dialect, is_name=True)] if dialect.units else []
    )
    lines = [*_write_head(dialect, names), *(dialect.comment + line for line in above)]
    for k, cells in enumerate(records):
        lines += above[:1] if dialect.repeated and k == 30 else []
        lines.append(_join_cells(cells, dialect))
    text = dialect.end.join([*lines, *_write_footer(dialect, names)])
    return (text if dialect.footer == "cut" else text + dialect.end).encode(dialect.encoding)


def _write_head(dialect: Dialect, names: list[str]) -> list[str]:
    separator = dialect.separator.strip() or dialect.separator[:1]
    match dialect.head:
        case "remark":
            return ["Recorder, version 2.1 of 2025-03-05", ""]
        case "list":
            return ["Signal" + separator + "Unit", *(f"{name}{separator}x" for name in names), ""]
        case "keys":
            return [f"Sample rate{separator}1000", f"Trigger{separator}20", "Axis: X", ""]
        case "sep":
            return [f"sep={separator}"]
        case "group":
            return [separator.join(["", "Axis X", *("" for _ in names[2:])])]
    return []


def _write_footer(dialect: Dialect, names: list[str]) -> list[str]:
    match dialect.footer:
        case "remark":
            return ["", "Exported 2025-03-05, 10:22:03; 60 rows"]
        case "statistics":
            return [_join_cells([word, *("1" for _ in names[1:])], dialect) for word in ("Mean", "Max")]
        case "EOF":
            return ["EOF"]
        case "cut":
            return [_join_cells([format_time(ROWS, dialect) if dialect.time != "none" else "1", "7"], dialect)]
    return []


def _join_cells(cells: list[str], dialect: Dialect, is_name: bool = False) -> str:
    quoted = dialect.quotes == "all" or (dialect.quotes == "names" and is_name)
    mark = dialect.separator.strip() or " "
    written = [f'"{c}"' if quoted or (dialect.quotes == "needed" and mark in c) else c for c in cells]
    return dialect.separator.join(written) + (dialect.separator if dialect.trailing else "")


def make_column_map(dialect: Dialect) -> dict[str, Any]:
    of = dict(zip(("voltage_V", "current_A", "speed_rad_per_s", "position_m", "demand_m"), SIGNALS, strict=True))
    columns: dict[str, Any] = {
        signal: {"name": get_name(dialect, name), "unit": {"V": "V", "A": "A", "s": "rad/s", "m": "m"}[signal[-1]]}
        for signal, name in of.items()
    }
    headers: dict[str, Any] = {"axis": "X", "pitch_m_per_rev": 0.02, "voltage_sampling": "instant"}
    if dialect.time == "none":
        headers["sample_rate_hz"] = 1000.0
    else:
        columns["time_s"] = {"name": "Time", "unit": get_time_unit(dialect)}
    return {"headers": headers, "columns": columns}


def compute_written_values(dialect: Dialect, values: dict[str, Float]) -> dict[str, Float]:
    return {name: np.array([float(format(v, dialect.form)) for v in column]) for name, column in values.items()}
