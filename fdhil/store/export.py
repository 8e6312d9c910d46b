"""A stored window as CSV of the recording format, which ``fdhil identify`` and any other program read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fdhil.errors import RecordingError
from fdhil.records import Float, SlowVoltage, Window
from fdhil.store.output import open_output

TABLE = ("table_mm", "table_m_s2")
TIME, VOLTAGE, OTHERS = "time_s", "voltage_V", "current_A,speed_rad_per_s,position_m,demand_m"


def csv_lines(window: Window) -> Iterator[str]:
    """Yield the lines of a recording without line ends; a lost sample is a missing row, which readers see as a gap.

    The samples of a voltage sensor slower than the rows stand in headers, on their own grid and to the last bit; their
    column holds the sample under way, for programs that know no other. Without a voltage there is no such column, nor
    without sensors at the table; a row that these did not tell has ``nan`` there.
    """
    slow = window.slow_voltage
    voltage = _held(window, slow) if slow is not None else window.voltage_v
    rapid_m_s = window.rapid_speed_rad_s / (2 * math.pi) * window.pitch_mm / 1000
    headers = {
        "format": "fdhil-recording-1",
        "sample_rate_hz": f"{1 / window.dt_s:.12g}",
        "voltage_sampling": window.voltage_sampling,
        "axis": window.axis,
        "pitch_m_per_rev": f"{window.pitch_mm / 1000:.12g}",
        "rapid_speed_m_per_s": f"{rapid_m_s:.12g}",
        "temperature_C": _number(window.temperature_c),
        "voltage_delay_s": None if window.voltage_delay_s is None else repr(window.voltage_delay_s),
        "torque_constant_nm_per_a": _number(window.torque_constant_nm_per_a),
        "start_tick": str(window.start_tick),
        "source": window.source or None,
    } | (_samples(slow) if slow is not None else {})
    left_out = () if voltage is not None else ("voltage_sampling", "voltage_delay_s")
    yield from (f"# {key}: {value}" for key, value in headers.items() if value is not None and key not in left_out)
    seen = {name: values for name in TABLE if (values := getattr(window, name)) is not None}
    yield ",".join((*((TIME, OTHERS) if voltage is None else (TIME, VOLTAGE, OTHERS)), *seen))
    path_m = (window.position_mm / 1000, window.demand_mm / 1000)
    signals = (window.current_a, window.speed_rad_s, *path_m)
    rows = np.column_stack(signals if voltage is None else (voltage, *signals))
    whole = np.isfinite(rows).all(axis=1)
    rows = np.column_stack([rows, *seen.values()])  # of which a row may lack what the table's sensors tell
    for k in np.flatnonzero(whole):
        yield f"{k * window.dt_s:.9g}," + ",".join(repr(float(value)) for value in rows[k])


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:.12g}"


def _samples(slow: SlowVoltage) -> dict[str, str]:
    """Return the headers that hold a slow sensor's samples; times are those of the rows, the first at 0 s."""
    late = {} if slow.late_s is None else {"voltage_late_s": " ".join(repr(float(value)) for value in slow.late_s)}
    return late | {
        "voltage_begin_s": repr(slow.begin_s),
        "voltage_period_s": repr(slow.period_s),
        "voltage_error_s": repr(slow.error_s),
        "voltage_samples_V": " ".join(repr(float(value)) for value in slow.voltage_v),
    }


def _held(window: Window, slow: SlowVoltage) -> Float:
    """Return the sample (n,) under way at each row, the nearest known one where there is none."""
    known = np.flatnonzero(np.isfinite(slow.voltage_v))
    if known.size == 0:
        raise RecordingError("every voltage sample of this window is lost; see why the sensor gave none")
    running = np.floor((np.arange(window.n) * window.dt_s - slow.begin_s) / slow.period_s)
    at = np.searchsorted(known, running, side="right") - 1
    held: Float = slow.voltage_v[known[np.maximum(at, 0)]]
    return held


def export_csv(window: Window, path: Path) -> None:
    """Write a window as CSV, whole or not at all. OutputError when it cannot be written."""
    content = "\n".join(csv_lines(window)) + "\n"
    with open_output(path) as file:
        file.write(content.encode())
