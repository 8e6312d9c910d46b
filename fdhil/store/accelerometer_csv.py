"""Reads accelerometer recordings as 3D printers write them: a separate file with a clock of its own.

Klipper writes ``#time,accel_x,accel_y,accel_z`` in seconds and mm/s2, and omits lost samples. The file is aligned with
a recording of the drive by the acceleration that both contain; the correlation gives the time shift between the clocks,
the sensor axis along the machine axis, and its direction.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fdhil.csv_text import read_csv_text
from fdhil.errors import RecordingError
from fdhil.identification import filter_zero_phase, find_fft_size, interpolate_gaps
from fdhil.records import Float, Recording, freeze_array

LEAST_ROWS = 100
LEAST_CORRELATION = 0.7  # of recordings of the same moves
CORNER_HZ = 25.0  # below it table and motor move alike
LONGEST_STEP = 1.7  # of the sample period; a longer step means a lost sample
LONGEST_S = 3600.0
M_PER_MM = 1e-3


def add_accelerometer(recording: Recording, path: Path) -> Recording:
    """Return the recording with the table's acceleration from a file. RecordingError if they differ in their moves."""
    time_s, axes = _read_samples(path)
    wanted = np.gradient(interpolate_gaps(recording.speed_rad_s), recording.dt_s) * recording.pitch_mm / (2e3 * np.pi)
    grid = np.arange(0.0, time_s[-1] - time_s[0], recording.dt_s)
    measured = [np.interp(grid, time_s - time_s[0], values) for values in axes.T]
    found = [_find_time_shift(wanted, values - np.median(values), recording.dt_s) for values in measured]
    best = int(np.argmax([abs(correlation) for correlation, _ in found]))
    correlation, begin_s = found[best]
    if abs(correlation) < LEAST_CORRELATION:
        raise RecordingError(
            f"{path} does not match the moves of the recording (correlation {abs(correlation):.2f}, "
            f"{LEAST_CORRELATION} is required): use the file of the same run, with all its moves"
        )
    values = axes[:, best] if correlation > 0 else -axes[:, best]
    rows = freeze_array(np.arange(recording.speed_rad_s.size) * recording.dt_s)
    return replace(recording, table_m_s2=freeze_array(_average_at_samples(rows, time_s - time_s[0] + begin_s, values)))


def _read_samples(path: Path) -> tuple[Float, Float]:
    """Return times (n,) in s and accelerations (n, 3) in m/s2."""
    lines = read_csv_text(path).splitlines()
    rows = [line for line in lines if line.strip() and not line.startswith("#")]
    if rows and not rows[0].lstrip("-")[:1].isdigit():
        rows = rows[1:]  # a header without a comment sign
    try:
        table = np.loadtxt(rows, delimiter=",", comments=None, ndmin=2)
    except ValueError:
        table = np.zeros((0, 0))
    if table.shape[0] < LEAST_ROWS or table.shape[1] != 4 or not np.isfinite(table).all():
        raise RecordingError(
            f"{path} is not an accelerometer recording: rows of time_s, accel_x, accel_y, accel_z are expected, in s "
            f"and mm/s2, at least {LEAST_ROWS} of them"
        )
    time_s: Float = table[:, 0]
    if (np.diff(time_s) <= 0).any() or time_s[-1] - time_s[0] > LONGEST_S:
        raise RecordingError(f"{path}: its time must rise from row to row and last at most an hour: record it again")
    return time_s, table[:, 1:] * M_PER_MM


def _find_time_shift(wanted: Float, measured: Float, dt: float) -> tuple[float, float]:
    """Return the largest correlation, and the time (s) at which ``measured`` then begins on the clock of ``wanted``."""
    both = [filter_zero_phase(values - values.mean(), CORNER_HZ, dt) for values in (wanted, measured)]
    size = find_fft_size(wanted.size + measured.size)
    product = np.fft.irfft(np.fft.rfft(both[0], size) * np.conj(np.fft.rfft(both[1], size)), size)
    power = float(np.sqrt((both[0] @ both[0]) * (both[1] @ both[1])))
    k = int(np.argmax(np.abs(product)))
    side = np.array([product[(k + step) % size] for step in (-1, 0, 1)])
    curve = side[0] - 2 * side[1] + side[2]
    shift = k + (0.5 * (side[0] - side[2]) / curve if curve else 0.0)
    shift -= size if k > wanted.size else 0
    return float(product[k] / power) if power else 0.0, float(shift * dt)


def _average_at_samples(rows_s: Float, time_s: Float, values: Float) -> Float:
    """Return the mean (n,) around each sample time, NaN beyond the file's ends and over lost samples."""
    step, row = float(np.median(np.diff(time_s))), rows_s[1] - rows_s[0]
    summed = np.concatenate([[0.0], np.cumsum(np.diff(time_s) * (values[1:] + values[:-1]) / 2)])
    at = (np.interp(rows_s + row / 2, time_s, summed) - np.interp(rows_s - row / 2, time_s, summed)) / row
    k = np.clip(np.searchsorted(time_s, rows_s, side="right") - 1, 0, time_s.size - 2)
    outside = (rows_s < time_s[0]) | (rows_s > time_s[-1]) | (np.diff(time_s)[k] > LONGEST_STEP * step)
    return np.where(outside, np.nan, at)
