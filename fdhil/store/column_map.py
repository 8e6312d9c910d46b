"""Maps another program's file to a recording: a column map (TOML) names signal, unit and axis of each column.

Without a speed, it is derived from positions or angles; a torque can replace a current. A part of a heading is enough
to name a column, if only one column has it.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from fdhil.config import Finite, Section, read_toml
from fdhil.csv_text import quote_cell
from fdhil.errors import ConfigError, ConfigFault, RecordingError
from fdhil.records import Float
from fdhil.store.counter_wraps import jump_of_reading, unwrap_counter, unwrap_turns
from fdhil.store.derived_columns import TORQUE, check_sizes, derive_columns
from fdhil.store.recording_table import (
    ANGLE,
    IMPORT_NOTES,
    PATH,
    PITCH_KEY,
    RECORDING_FORMAT,
    SAMPLING,
    VOLTAGE_COLUMN,
    RecordingTable,
    make_length_error,
)
from fdhil.store.sample_times import compute_usual_step, find_even_times
from fdhil.store.trace_text import TraceText

SHOWN_NAMES = 12
LEAST_PART = 3  # letters of a heading that suffice to name its column
SHORTEST_S = 0.01  # of a recording
PER_REVOLUTION = {"mm/s": 1e-3, "mm/min": 1e-3 / 60, "m/min": 1 / 60, "m/s": 1.0}  # of the table: by pitch to rad/s
FACTORS: Mapping[str, Mapping[str, float]] = {
    "time_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "100ns": 1e-7},
    "voltage_V": {"V": 1.0, "mV": 1e-3},
    "current_A": {"A": 1.0, "mA": 1e-3},
    "speed_rad_per_s": {"rad/s": 1.0, "rpm": 2 * math.pi / 60, "1/min": 2 * math.pi / 60, "rev/s": 2 * math.pi,
                        "deg/s": math.pi / 180},
    "angle_rad": {"rad": 1.0, "deg": math.pi / 180, "rev": 2 * math.pi},
    "torque_Nm": {"N.m": 1.0, "mN.m": 1e-3},
    "position_m": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "demand_m": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "table_mm": {"mm": 1.0, "m": 1e3, "um": 1e-3},
    "table_m_s2": {"m/s2": 1.0, "mm/s2": 1e-3, "g": 9.80665},
}  # fmt: skip
COUNTED = ("time_s", "angle_rad", "position_m", "demand_m")  # signals that may come from a counter
SYNONYMS = {"sec": "s", "msec": "ms", "U/min": "rpm", "r/min": "rpm", "min-1": "rpm", "m/s^2": "m/s2", "m/s²": "m/s2"}
_MICRO = str.maketrans({"\u00b5": "u", "\u03bc": "u"})
# a unit at the end of a name: in brackets, "Current / mA", "Current, mA", "C1 in A", "Current mA", "current_mA"
_IN_NAME = (
    re.compile(r"[\[(]([^\[\]()]+)[\])]$"),
    re.compile(r"(?:/|,|\sin\s)\s*(\S+)$"),
    re.compile(r"[\s_](\S{2,})$"),  # a single letter may also name a channel or the motor
)
Signal = Literal[
    "time_s", "voltage_V", "current_A", "torque_Nm", "speed_rad_per_s", "angle_rad", "position_m", "demand_m",
    "table_mm", "table_m_s2",
]  # fmt: skip


class Column(Section):
    """A column of the file: value = (number * factor + offset) in ``unit``."""

    name: str = Field(min_length=1, description="the heading above the column, or #1, #2 ... from the left")
    unit: str = Field(description="unit of the number after factor and offset")
    factor: Finite = 1.0
    offset: Finite = 0.0


def _make_tuple(value: Column | tuple[Column, ...]) -> tuple[Column, ...]:
    return value if isinstance(value, tuple) else (value,)


Columns = Annotated[Column | tuple[Column, ...], AfterValidator(_make_tuple)]


class ColumnMap(Section):
    """A complete map; several ``columns`` of a signal are added (position and following error make a demand)."""

    headers: dict[str, str | float] = Field(default_factory=dict, description="headers that the file lacks")
    columns: dict[Signal, Columns]
    text: TraceText = TraceText()


def read_column_map(path: Path) -> ColumnMap:
    """Read a map. Raises ConfigError with all its faults."""
    return check_map(read_toml(path, "a column map"), str(path))


def check_map(document: Mapping[str, Any], source: str) -> ColumnMap:
    """Return the map of a document. Raises ConfigError with all its faults."""
    try:
        column_map = ColumnMap.model_validate(document)
    except ValidationError as error:
        items = error.errors(include_url=False)
        faults = [ConfigFault(".".join(map(str, e["loc"])), e["msg"], "see the how-to on recordings") for e in items]
        raise ConfigError(source, faults) from None
    if faults := [*_find_faults(column_map)]:
        raise ConfigError(source, faults)
    return column_map


def _find_faults(column_map: ColumnMap) -> list[ConfigFault]:
    needed = {"current_A": (TORQUE,), "speed_rad_per_s": (ANGLE, "position_m")}
    faults = [
        ConfigFault(f"columns.{signal}", "is missing", f"name its column, or that of {' or '.join(instead)}")
        for signal, instead in needed.items()
        if not column_map.columns.keys() & {signal, *instead}
    ]
    for signal, columns in column_map.columns.items():
        units = {**FACTORS[signal], **(PER_REVOLUTION if signal == "speed_rad_per_s" else {})}
        faults += [
            ConfigFault(
                f"columns.{signal}.unit", f"{quote_cell(c.unit)} is not a unit of it", f"use one of {', '.join(units)}"
            )
            for c in _make_tuple(columns)
            if c.unit not in units
        ]
    per_revolution = [
        c.unit for c in _make_tuple(column_map.columns.get("speed_rad_per_s", ())) if c.unit in PER_REVOLUTION
    ]
    wanted = ["axis", *([PITCH_KEY] if per_revolution or column_map.columns.keys() & {*PATH} else [])]
    wanted += [SAMPLING] if VOLTAGE_COLUMN in column_map.columns else []
    missing = [key for key in wanted if key not in column_map.headers]
    return faults + [
        ConfigFault(f"headers.{key}", "is missing", "add it: the file does not contain it") for key in missing
    ]


def apply_column_map(raw: RecordingTable, column_map: ColumnMap, source: str) -> RecordingTable:
    """Return the recording that a file contains by its map; rows that lack a value are left out, which makes a gap.

    Conversions of the numbers are listed in the header ``import_notes``. Raises RecordingError if a column is missing
    or the rest is wrong.
    """
    headers = {
        "format": RECORDING_FORMAT,
        **raw.headers,
        **{key: _format_header(value) for key, value in column_map.headers.items()},
    }
    pitch_m = math.nan
    if PITCH_KEY in headers:
        pitch_m = _parse_positive(headers[PITCH_KEY], PITCH_KEY, "a length above 0, in m", source)
    rate_hz = None
    if "sample_rate_hz" in headers:
        rate_hz = _parse_positive(headers["sample_rate_hz"], "sample_rate_hz", "a number above 0", source)
    column_map = _complete_names(raw, column_map, source)
    raw = _select_sample_group(raw, column_map, source)
    columns, notes = _convert_signals(raw, column_map, pitch_m, source)
    if "time_s" not in columns:
        columns = {"time_s": _find_time(raw, rate_hz, len(next(iter(columns.values()))), source), **columns}
    columns = _select_complete_rows(columns, source)
    if 0 < (lasts_s := np.ptp(columns["time_s"])) < SHORTEST_S:
        lasts = f"lasts only {lasts_s:.3g} s by its times, too short for a move"
        raise RecordingError(f"{source} {lasts}: correct the unit of time_s, or sample_rate_hz")
    time_s, note = find_even_times(np.round(columns["time_s"] - columns["time_s"][0], 9), rate_hz, source)
    columns["time_s"] = np.round(time_s, 9)
    _check_rising_time(columns["time_s"], source)
    if rate_hz is None:
        headers["sample_rate_hz"] = f"{1 / compute_usual_step(columns['time_s']):.9g}"
    if "speed_rad_per_s" not in columns and ANGLE not in columns:
        columns[ANGLE] = columns["position_m"] * (2 * math.pi / pitch_m)
    derive_columns(headers, columns)
    check_sizes(columns, source)
    if notes := [*notes, *([note] if note else [])]:
        headers[IMPORT_NOTES] = "; ".join(notes)
    return RecordingTable(headers, columns)


def _select_complete_rows(columns: Mapping[str, Float], source: str) -> dict[str, Float]:
    _check_lengths(columns, source)
    complete = np.isfinite(np.column_stack([columns[name] for name in columns if not name.startswith("table_")])).all(1)
    if np.count_nonzero(complete) < 2:
        raise RecordingError(f"{source} has no row with a number in every mapped column: correct the column map")
    return {name: values[complete] for name, values in columns.items()}


def complete_heading(raw: RecordingTable, name: str, source: str) -> str:
    """Return the heading that contains ``name``, else ``name`` itself. RecordingError if several contain it."""
    names = list(dict.fromkeys(n for table in (raw, *raw.others) for n in (*table.columns, *table.doubts)))
    if name in names or name.startswith("#") or len(name) < LEAST_PART:
        return name
    found = [each for each in names if name.lower() in each.lower()]
    if len(found) > 1:
        listed = " and ".join(map(quote_cell, found[:SHOWN_NAMES]))
        raise RecordingError(f"{source}: {quote_cell(name)} is a part of {listed}: write more of the intended heading")
    return found[0] if found else name


def _complete_names(raw: RecordingTable, column_map: ColumnMap, source: str) -> ColumnMap:
    columns = {
        signal: tuple(c.model_copy(update={"name": complete_heading(raw, c.name, source)}) for c in _make_tuple(of))
        for signal, of in column_map.columns.items()
    }
    return column_map.model_copy(update={"columns": columns})


def _select_sample_group(raw: RecordingTable, column_map: ColumnMap, source: str) -> RecordingTable:
    names = dict.fromkeys(column.name for columns in column_map.columns.values() for column in _make_tuple(columns))
    tables = [raw, *raw.others]
    having = [table for table in tables if all(name in table.columns or name in table.doubts for name in names)]
    if len(having) == 1:
        return having[0]
    for name in names:
        if not any(name in table.columns or name in table.doubts for table in tables):
            raise RecordingError(
                f"{source} has no column {quote_cell(name)}; it has {_list_columns(*tables)}: correct the column map"
            )
    listed = ", ".join(map(quote_cell, names))
    if not having:
        raise RecordingError(
            f"{source} has no group with all of {listed}: they have different sample times; record or export them with "
            "one sample time"
        )
    sizes = " and ".join(f"{table.columns['time_s'].size} rows" for table in having)
    raise RecordingError(
        f"{source} has {listed} in {len(having)} groups of samples ({sizes}): export only the intended one"
    )


def _convert_signals(
    raw: RecordingTable, column_map: ColumnMap, pitch_m: float, source: str
) -> tuple[dict[str, Float], list[str]]:
    signals: dict[str, Float] = {}
    notes: dict[str, None] = {}  # in order, each once
    _check_distinct_columns(raw, column_map, source)
    for signal, of in column_map.columns.items():
        parts: dict[str, Float] = {}
        for k, column in enumerate(_make_tuple(of)):
            values = _get_column(raw, column.name, source)
            bits = None
            if signal in COUNTED:
                values, bits = unwrap_counter(values)
            if signal in ("position_m", "demand_m") and bits is None:
                values, is_turn = _unwrap_position(values, column, pitch_m / FACTORS[signal][column.unit], source)
                if is_turn:
                    notes[f"{column.name} wraps at each turn of the screw and was unwrapped"] = None
            if bits is not None:
                notes[f"{column.name} wraps like a counter of {bits} bits and was unwrapped"] = None
            is_clock = column.name in raw.clocks
            if is_clock and signal != "time_s":
                raise RecordingError(
                    f"{source}: {quote_cell(column.name)} is a time, not {signal}: correct the column map"
                )
            factor = 1.0 if is_clock else _find_factor(signal, column.unit, pitch_m)
            _check_unit(raw, signal, column, source)
            parts[f"{column.name} ({k + 1})"] = (values * column.factor + column.offset) * factor
        _check_lengths(parts, source)
        signals[signal] = np.sum([*parts.values()], axis=0)
    return signals, [*notes]


def _unwrap_position(values: Float, column: Column, pitch: float, source: str) -> tuple[Float, bool]:
    """Return a position within one turn unwrapped over all turns, and whether it was one; ``pitch`` in the map's unit.

    Raises RecordingError for a position that wraps at another length than the pitch.
    """
    turn = pitch / abs(column.factor or 1.0)
    values, is_turn = unwrap_turns(values, turn)
    jump = None if is_turn else jump_of_reading(values)
    if jump is not None:
        raise RecordingError(
            f"{source}: {quote_cell(column.name)} jumps by {jump:g}, like a position within one turn, "
            f"but one turn is {turn:g} by the column map: correct pitch_m_per_rev, unit and factor, or export a "
            "position over all turns"
        )
    return values, is_turn


def _check_distinct_columns(raw: RecordingTable, column_map: ColumnMap, source: str) -> None:
    """Refuse two names of one column, as of a head that lists its signals one a line."""
    found: dict[int, str] = {}
    for column in (column for columns in column_map.columns.values() for column in _make_tuple(columns)):
        if column.name.startswith("#") or column.name not in raw.columns:
            continue
        other = found.setdefault(id(raw.columns[column.name]), column.name)
        if other != column.name:
            raise RecordingError(
                f"{source} has {quote_cell(other)} and {quote_cell(column.name)} above one column: its head lists one "
                f"signal a "
                "line; name the columns #1, #2 ... from the left instead"
            )


def _check_unit(raw: RecordingTable, signal: str, column: Column, source: str) -> None:
    """Refuse a unit that differs from the one above the column, unless the map itself scales it."""
    known = {**FACTORS[signal], **(PER_REVOLUTION if signal == "speed_rad_per_s" else {})}
    units = [unit for unit in find_heading_units(raw, column.name) if unit in known]
    wrong = units and not any(math.isclose(known[unit], known[column.unit]) for unit in units)
    if wrong and "factor" not in column.model_fields_set and column.name not in raw.clocks:
        raise RecordingError(
            f"{source} has {quote_cell(column.name)} in {units[0]}, the column map has {column.unit}: correct unit in "
            f"the "
            "map, or set factor = 1 if the file is wrong"
        )


def find_heading_units(raw: RecordingTable, heading: str) -> list[str]:
    """Return the possible units of a column: the file's texts about it, and the ends of its heading."""
    names = [heading.strip(), *raw.texts.get(heading, ())]
    ends = (found[1] for name in names for form in _IN_NAME if (found := form.search(name.strip())))
    return [_normalise_unit(text) for text in (*names, *ends)]


def _normalise_unit(text: str) -> str:
    unit = text.strip("[]() ").translate(_MICRO)
    return SYNONYMS.get(unit, unit)


def _find_time(raw: RecordingTable, rate_hz: float | None, rows: int, source: str) -> Float:
    is_doubtful = "time_s" in raw.doubts
    if ("time_s" in raw.columns and not is_doubtful) or (is_doubtful and rate_hz is None):
        return _get_column(raw, "time_s", source)
    if rate_hz is None:
        raise RecordingError(
            f"{source} has no column 'time_s'; it has {_list_columns(raw)}: name the column of "
            "time_s in the column map, or give sample_rate_hz under [headers] if there is none"
        )
    if raw.interruption:
        raise RecordingError(
            f"{source}: {raw.interruption}, and without times the number of lost samples is unknown: export it "
            "with a time"
        )
    return np.arange(rows) / rate_hz


def _check_rising_time(time_s: Float, source: str) -> None:
    steps = np.diff(time_s)
    if (steps > 0).all():
        return
    at_s = time_s[1 + int(np.argmax(steps <= 0))]
    todo = "sort or record it again"
    if not (steps < 0).any() and 2 * np.count_nonzero(steps) < steps.size:
        todo = "its resolution is too low; remove time_s from the map and give sample_rate_hz"
    raise RecordingError(f"{source}: time does not rise at {at_s:g} s: {todo}")


def _check_lengths(columns: Mapping[str, Float], source: str) -> None:
    sizes = {name: values.size for name, values in columns.items()}
    if len(set(sizes.values())) > 1:
        raise make_length_error(sizes, source)


def _format_header(value: str | float) -> str:
    return value if isinstance(value, str) else repr(value)


def _parse_positive(text: str | None, key: str, what: str, source: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise RecordingError(f"{source}: header {key} of the column map must be {what}")
    return value


def _find_factor(signal: str, unit: str, pitch_m: float) -> float:
    if signal == "speed_rad_per_s" and unit in PER_REVOLUTION:
        return PER_REVOLUTION[unit] * 2 * math.pi / pitch_m
    return FACTORS[signal][unit]


def _get_column(raw: RecordingTable, name: str, source: str) -> Float:
    if name in raw.doubts:
        raise RecordingError(f"{source}: {quote_cell(name)} {raw.doubts[name]}")
    return raw.columns[name]


def _list_columns(*tables: RecordingTable) -> str:
    names_of_all = dict.fromkeys(name for table in tables for name in (*table.columns, *table.doubts))
    names = [quote_cell(name) for name in names_of_all if not name.startswith("#")]
    places = [name for name in names_of_all if name.startswith("#")]
    listed = [", ".join(names[:SHOWN_NAMES])] if names else []
    if places:
        listed.append(f"{places[0]} to {places[-1]}" if len(places) > 1 else places[0])
    return " and ".join(listed) or "no columns of numbers"
