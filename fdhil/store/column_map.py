"""A column map (TOML) says which column of another program's file is which signal, in which unit, and of which axis.

Without a speed, it is the difference of positions; without a demand, none can be replayed and the map is refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from fdhil.config.reading import read_toml
from fdhil.config.section import Finite, Section
from fdhil.csv_text import shown
from fdhil.errors import ConfigError, ConfigFault, RecordingError
from fdhil.records import Float
from fdhil.store.recording_table import COLUMNS, FORMAT, REQUIRED, SAMPLING, VOLTAGE, RecordingTable
from fdhil.store.trace_text import TraceText

SHOWN_NAMES = 12
PER_REVOLUTION = {"mm/s": 1e-3, "mm/min": 1e-3 / 60, "m/min": 1 / 60, "m/s": 1.0}  # of the table: by pitch to rad/s
FACTORS: Mapping[str, Mapping[str, float]] = {
    "time_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "100ns": 1e-7},
    "voltage_V": {"V": 1.0, "mV": 1e-3},
    "current_A": {"A": 1.0, "mA": 1e-3},
    "speed_rad_per_s": {"rad/s": 1.0, "rpm": 2 * math.pi / 60, "1/min": 2 * math.pi / 60, "rev/s": 2 * math.pi,
                        "deg/s": math.pi / 180},
    "position_m": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "demand_m": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "table_mm": {"mm": 1.0, "m": 1e3, "um": 1e-3},
    "table_m_s2": {"m/s2": 1.0, "mm/s2": 1e-3, "g": 9.80665},
}  # fmt: skip
Signal = Literal[
    "time_s", "voltage_V", "current_A", "speed_rad_per_s", "position_m", "demand_m", "table_mm", "table_m_s2"
]


class Column(Section):
    """A column of the file: value = (number * factor + offset) in ``unit``."""

    name: str = Field(min_length=1, description="as it stands above the column, or #1, #2 ... from the left")
    unit: str = Field(description="unit of the number after factor and offset")
    factor: Finite = 1.0
    offset: Finite = 0.0


def _as_tuple(value: Column | tuple[Column, ...]) -> tuple[Column, ...]:
    return value if isinstance(value, tuple) else (value,)


Columns = Annotated[Column | tuple[Column, ...], AfterValidator(_as_tuple)]


class ColumnMap(Section):
    """A whole map: ``columns`` of which several are added (a position and its following error make a demand)."""

    headers: dict[str, str | float] = Field(default_factory=dict, description="what the file does not say")
    columns: dict[Signal, Columns]
    text: TraceText = TraceText()


def read_column_map(path: Path) -> ColumnMap:
    """Read a map; ConfigError with every fault of it."""
    try:
        told = ColumnMap.model_validate(read_toml(path, "a column map"))
    except ValidationError as error:
        items = error.errors(include_url=False)
        faults = [ConfigFault(".".join(map(str, e["loc"])), e["msg"], "see the how-to on recordings") for e in items]
        raise ConfigError(str(path), faults) from None
    if faults := [*_faults(told)]:
        raise ConfigError(str(path), faults)
    return told


def _faults(told: ColumnMap) -> list[ConfigFault]:
    faults = [
        ConfigFault(f"columns.{signal}", "is missing", "say which column it is")
        for signal in COLUMNS
        if signal not in told.columns and signal not in ("time_s", "speed_rad_per_s")
    ]
    for signal, columns in told.columns.items():
        units = {**FACTORS[signal], **(PER_REVOLUTION if signal == "speed_rad_per_s" else {})}
        faults += [
            ConfigFault(f"columns.{signal}.unit", f"{shown(c.unit)} is no unit of it", f"one of {', '.join(units)}")
            for c in _as_tuple(columns)
            if c.unit not in units
        ]
    wanted = [key for key in REQUIRED if key not in ("format", "sample_rate_hz")]
    wanted += [SAMPLING] if VOLTAGE in told.columns else []
    missing = [key for key in wanted if key not in told.headers]
    return faults + [ConfigFault(f"headers.{key}", "is missing", "the file does not say it") for key in missing]


def mapped(raw: RecordingTable, told: ColumnMap, source: str) -> RecordingTable:
    """Return the recording that a file is by its map; rows that lack a value are left out, which makes a gap.

    RecordingError when a column is not in the file, or the rest is wrong.
    """
    headers = {"format": FORMAT, **raw.headers, **{key: _text(value) for key, value in told.headers.items()}}
    pitch_m = _number(headers.get("pitch_m_per_rev"), source)
    columns: dict[str, Float] = {
        signal: np.sum([_column(raw, c, _factor(signal, c.unit, pitch_m), source) for c in _as_tuple(of)], axis=0)
        for signal, of in told.columns.items()
    }
    if "time_s" not in columns:
        columns["time_s"] = _column(raw, Column(name="time_s", unit="s"), 1.0, source)
    whole = np.isfinite(np.column_stack([columns[name] for name in columns if not name.startswith("table_")])).all(1)
    columns = {name: values[whole] for name, values in columns.items()}
    if columns["time_s"].size < 2:
        raise RecordingError(f"{source} has no row in which every mapped column has a number: correct the column map")
    columns["time_s"] = np.round(columns["time_s"] - columns["time_s"][0], 9)
    step_s = float(np.median(np.diff(columns["time_s"])))
    if "sample_rate_hz" not in headers and step_s > 0:
        headers["sample_rate_hz"] = f"{1 / step_s:.9g}"
    if "speed_rad_per_s" not in columns:
        turned = np.diff(columns["position_m"]) / np.diff(columns["time_s"]) * 2 * math.pi / pitch_m
        columns["speed_rad_per_s"] = np.concatenate([[0.0], turned])
        headers["speed_source"] = "difference"
    return RecordingTable(headers, columns)


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else repr(value)


def _number(text: str | None, source: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not value > 0:
        raise RecordingError(f"{source}: header pitch_m_per_rev of the column map must be a length above 0, in m")
    return value


def _factor(signal: str, unit: str, pitch_m: float) -> float:
    if signal == "speed_rad_per_s" and unit in PER_REVOLUTION:
        return PER_REVOLUTION[unit] * 2 * math.pi / pitch_m
    return FACTORS[signal][unit]


def _column(raw: RecordingTable, column: Column, factor: float, source: str) -> Float:
    if column.name not in raw.columns:
        names = [shown(name) for name in raw.columns if not name.startswith("#")][:SHOWN_NAMES]
        raise RecordingError(
            f"{source} has no column {shown(column.name)}, or one sampled at other times; it has {', '.join(names)}: "
            "correct the column map"
        )
    values: Float = (raw.columns[column.name] * column.factor + column.offset) * factor
    return values
