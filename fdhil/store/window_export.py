"""Exports a stored window as a recording, for ``fdhil identify`` and other programs, in every recording format."""

import math
from pathlib import Path

import numpy as np

from fdhil import tables
from fdhil.errors import RecordingError
from fdhil.records import Float, SlowVoltage, Window
from fdhil.store.output_file import open_output
from fdhil.store.recording_table import RECORDING_FORMAT, SAMPLING, TABLE, VOLTAGE_COLUMN, RecordingTable


def convert_window(window: Window) -> RecordingTable:
    """Return a window as a recording; a lost sample is a missing row, which readers see as a gap.

    The samples of a voltage sensor slower than the rows are in headers, exactly and on their own grid; their column
    holds the latest sample, for programs without support for them. Without a voltage or sensors at the table there are
    no such columns; a lost sample of the latter is ``nan``.
    """
    slow = window.slow_voltage
    voltage = _hold_slow_voltage(window, slow) if slow is not None else window.voltage_v
    signals = {
        VOLTAGE_COLUMN: voltage,
        "current_A": window.current_a,
        "speed_rad_per_s": window.speed_rad_s,
        "position_m": window.position_mm / 1000,
        "demand_m": window.demand_mm / 1000,
    }
    known = {name: values for name, values in signals.items() if values is not None}
    whole = np.isfinite(np.column_stack([*known.values()])).all(axis=1)
    seen = {name: values for name in TABLE if (values := getattr(window, name)) is not None}
    time_s = {"time_s": np.round(np.arange(window.n) * window.dt_s, 9)}
    columns = {name: values[whole] for name, values in (time_s | known | seen).items()}
    return RecordingTable(_make_headers(window), columns)


def _make_headers(window: Window) -> dict[str, str]:
    slow, rapid_m_s = window.slow_voltage, window.rapid_speed_rad_s / (2 * math.pi) * window.pitch_mm / 1000
    has_no_voltage = window.voltage_v is None and slow is None
    headers = {
        "format": RECORDING_FORMAT,
        "sample_rate_hz": f"{1 / window.dt_s:.12g}",
        SAMPLING: None if has_no_voltage else window.voltage_sampling,
        "axis": window.axis,
        "pitch_m_per_rev": f"{window.pitch_mm / 1000:.12g}",
        "rapid_speed_m_per_s": f"{rapid_m_s:.12g}",
        "temperature_C": _format_number(window.temperature_c),
        "voltage_delay_s": None if has_no_voltage or window.voltage_delay_s is None else repr(window.voltage_delay_s),
        "torque_constant_nm_per_a": _format_number(window.torque_constant_nm_per_a),
        "start_tick": str(window.start_tick),
        "source": window.source or None,
    } | (_format_slow_voltage(slow) if slow is not None else {})
    return {key: value for key, value in headers.items() if value is not None}


def _format_number(value: float | None) -> str | None:
    return None if value is None else f"{value:.12g}"


def _format_slow_voltage(slow: SlowVoltage) -> dict[str, str]:
    """Return the headers with a slow sensor's samples; times are relative to the first row."""
    late = {} if slow.late_s is None else {"voltage_late_s": " ".join(map(repr, slow.late_s.tolist()))}
    return late | {
        "voltage_begin_s": repr(slow.begin_s),
        "voltage_period_s": repr(slow.period_s),
        "voltage_error_s": repr(slow.error_s),
        "voltage_samples_V": " ".join(map(repr, slow.voltage_v.tolist())),
    }


def _hold_slow_voltage(window: Window, slow: SlowVoltage) -> Float:
    known = np.flatnonzero(np.isfinite(slow.voltage_v))
    if known.size == 0:
        raise RecordingError("every voltage sample of this window is lost; check the sensor")
    running = np.floor((np.arange(window.n) * window.dt_s - slow.begin_s) / slow.period_s)
    at = np.searchsorted(known, running, side="right") - 1
    held: Float = slow.voltage_v[known[np.maximum(at, 0)]]
    return held


def export_table(table: RecordingTable, path: Path, format_name: str = "csv") -> None:
    """Write a recording in one of ``tables.RECORDING_FORMATS``, completely or not at all.

    Raises OutputError if it cannot be written, FdhilError if the format's library is not installed.
    """
    content: bytes = tables.load_entry(tables.RECORDING_FORMATS, format_name).encode(table)
    with open_output(path) as file:
        file.write(content)
