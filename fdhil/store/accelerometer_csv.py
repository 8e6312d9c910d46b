"""Recordings of an accelerometer as printers make them: a file of its own, on a clock of its own.

Klipper writes ``#time,accel_x,accel_y,accel_z`` in seconds and mm/s2, and leaves out what was lost. Beside a recording
of the drive such a file is laid on its rows by what both have in common, the acceleration: this tells the time between
the clocks, which of its axes lies along the machine's, and its direction.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fdhil.csv_text import read_csv_text
from fdhil.errors import RecordingError
from fdhil.identification.filtering import quick_size, zero_phase
from fdhil.identification.windows import bridged
from fdhil.records import Float, Recording, frozen

LEAST_ROWS = 100
LIKENESS = 0.7  # correlation from which both are taken for the same moves
CORNER_HZ = 25.0  # below it table and motor do the same
LONGEST_STEP = 1.7  # of a sample; beyond it one was lost
LONGEST_S = 3600.0
M_PER_MM = 1e-3


def with_accelerometer(recording: Recording, path: Path) -> Recording:
    """Return the recording with the table's acceleration from a file; RecordingError where they are not of one run."""
    time_s, axes = _read(path)
    wanted = np.gradient(bridged(recording.speed_rad_s), recording.dt_s) * recording.pitch_mm / (2e3 * np.pi)
    grid = np.arange(0.0, time_s[-1] - time_s[0], recording.dt_s)
    told = [np.interp(grid, time_s - time_s[0], values) for values in axes.T]
    found = [_placed(wanted, values - np.median(values), recording.dt_s) for values in told]
    best = int(np.argmax([abs(likeness) for likeness, _ in found]))
    likeness, begin_s = found[best]
    if abs(likeness) < LIKENESS:
        raise RecordingError(
            f"{path} does not show the moves of the recording (its likest axis correlates by {abs(likeness):.2f}, "
            f"{LIKENESS} is needed): give the file of the same run, from before its first move to after its last"
        )
    values = axes[:, best] if likeness > 0 else -axes[:, best]
    rows = frozen(np.arange(recording.speed_rad_s.size) * recording.dt_s)
    return replace(recording, table_m_s2=frozen(_at(rows, time_s - time_s[0] + begin_s, values)))


def _read(path: Path) -> tuple[Float, Float]:
    lines = read_csv_text(path).splitlines()
    rows = [line for line in lines if line.strip() and not line.startswith("#")]
    if rows and not rows[0].lstrip("-")[:1].isdigit():
        rows = rows[1:]  # a header without its sign of a comment
    try:
        table = np.loadtxt(rows, delimiter=",", comments=None, ndmin=2)
    except ValueError:
        table = np.zeros((0, 0))
    if table.shape[0] < LEAST_ROWS or table.shape[1] != 4 or not np.isfinite(table).all():
        raise RecordingError(
            f"{path} is no recording of an accelerometer: rows of time_s, accel_x, accel_y, accel_z are expected, in s "
            f"and mm/s2, at least {LEAST_ROWS} of them"
        )
    time_s: Float = table[:, 0]
    if (np.diff(time_s) <= 0).any() or time_s[-1] - time_s[0] > LONGEST_S:
        raise RecordingError(f"{path}: its time does not rise from row to row within an hour: record it again")
    return time_s, table[:, 1:] * M_PER_MM


def _placed(wanted: Float, told: Float, dt: float) -> tuple[float, float]:
    both = [zero_phase(values - values.mean(), CORNER_HZ, dt) for values in (wanted, told)]
    size = quick_size(wanted.size + told.size)
    product = np.fft.irfft(np.fft.rfft(both[0], size) * np.conj(np.fft.rfft(both[1], size)), size)
    power = float(np.sqrt((both[0] @ both[0]) * (both[1] @ both[1])))
    k = int(np.argmax(np.abs(product)))
    side = np.array([product[(k + step) % size] for step in (-1, 0, 1)])
    curve = side[0] - 2 * side[1] + side[2]
    shift = k + (0.5 * (side[0] - side[2]) / curve if curve else 0.0)
    shift -= size if k > wanted.size else 0
    return float(product[k] / power) if power else 0.0, float(shift * dt)


def _at(rows_s: Float, time_s: Float, values: Float) -> Float:
    step, row = float(np.median(np.diff(time_s))), rows_s[1] - rows_s[0]
    summed = np.concatenate([[0.0], np.cumsum(np.diff(time_s) * (values[1:] + values[:-1]) / 2)])
    at = (np.interp(rows_s + row / 2, time_s, summed) - np.interp(rows_s - row / 2, time_s, summed)) / row
    k = np.clip(np.searchsorted(time_s, rows_s, side="right") - 1, 0, time_s.size - 2)
    outside = (rows_s < time_s[0]) | (rows_s > time_s[-1]) | (np.diff(time_s)[k] > LONGEST_STEP * step)
    return np.where(outside, np.nan, at)
