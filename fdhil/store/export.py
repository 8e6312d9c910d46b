"""A stored window as CSV of the recording format, which ``fdhil identify`` and any other program read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fdhil.errors import RecordingError
from fdhil.records import Window
from fdhil.store.atomic import write_file

COLUMNS = "time_s,voltage_V,current_A,speed_rad_per_s,position_m,demand_m"


def csv_lines(window: Window) -> Iterator[str]:
    """Yield the lines of a recording without line ends; a lost sample is a missing row, which readers see as a gap.

    RecordingError when the window has no voltage.
    """
    rapid_m_s = window.rapid_speed_rad_s / (2 * math.pi) * window.pitch_mm / 1000
    headers = {
        "format": "fdhil-recording-1",
        "sample_rate_hz": f"{1 / window.dt_s:.12g}",
        "voltage_sampling": window.voltage_sampling,
        "axis": window.axis,
        "pitch_m_per_rev": f"{window.pitch_mm / 1000:.12g}",
        "rapid_speed_m_per_s": f"{rapid_m_s:.12g}",
        "temperature_C": None if window.temperature_c is None else f"{window.temperature_c:.12g}",
        "voltage_delay_s": None if window.voltage_delay_s is None else repr(window.voltage_delay_s),
        "start_tick": str(window.start_tick),
        "source": window.source or None,
    }
    yield from (f"# {key}: {value}" for key, value in headers.items() if value is not None)
    yield COLUMNS
    if window.voltage_v is None:
        raise RecordingError("this window has no voltage, which a recording needs; see why the sensor gave none")
    path_m = (window.position_mm / 1000, window.demand_mm / 1000)
    rows = np.column_stack((window.voltage_v, window.current_a, window.speed_rad_s, *path_m))
    for k in np.flatnonzero(np.isfinite(rows).all(axis=1)):
        yield f"{k * window.dt_s:.9g}," + ",".join(repr(float(value)) for value in rows[k])


def export_csv(window: Window, path: Path) -> None:
    """Write a window as CSV, whole or not at all. StoreError when it cannot be written."""
    write_file(path, ("\n".join(csv_lines(window)) + "\n").encode())
