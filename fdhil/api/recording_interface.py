"""Recordings from arrays and from files, for ``fdhil.identify``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fdhil.errors import RecordingError
from fdhil.records import Float, Window
from fdhil.records import Recording as RecordedSignals
from fdhil.store import (
    IMPORT_NOTES,
    RECORDING_FORMAT,
    VOLTAGE_COLUMN,
    RecordingTable,
    apply_column_map,
    check_map,
    check_sizes,
    compute_usual_step,
    derive_columns,
    find_even_times,
    make_recording,
    propose_for_table,
    read_column_map,
    read_raw,
    read_recording,
    read_stored_window,
)

PROPOSE = "?"
SIGNALS: Mapping[str, str] = {  # short names of columns=
    "time": "time_s",
    "voltage": "voltage_V",
    "current": "current_A",
    "torque": "torque_Nm",
    "speed": "speed_rad_per_s",
    "angle": "angle_rad",
    "position": "position_m",
    "demand": "demand_m",
}

Array = npt.ArrayLike
"""A sequence of numbers (n,): a list, a NumPy array, a column of pandas, polars or xarray."""


class Recording:
    """Signals of one drive over time, on one clock: arrays (n,), SI units.

    Voltage, current and speed are sufficient; ``position`` (m), ``demand`` (m) and ``pitch_m_per_rev`` are needed only
    to assess the model at the table. An ``angle`` may replace the speed (rad, or any unit with ``angle_scale``: 2 pi /
    4096 for the counts of an encoder); a speed may have another unit with ``speed_scale`` (rad/s per unit, such as a
    tacho's V). A ``torque`` (N.m) may replace the current: with ``torque_constant_nm_per_a`` both equations are fitted,
    without it [2] alone. Columns of pandas, polars and xarray are accepted as arrays.

    ``voltage_sampling`` is "interval_mean" where sample k is the mean over [t_k, t_k + dt), as for a PWM drive or a
    simulation with a held voltage, else "instant". The wrong one makes L wrong. Leave out incomplete samples: a longer
    time step is a gap.

    Raises :class:`fdhil.errors.RecordingError` for different lengths, numbers that are not finite, times that do not
    increase, and impossible magnitudes.

    >>> import numpy as np, fdhil
    >>> time = np.arange(0, 1, 1e-3)
    >>> fdhil.Recording(time, voltage=12 + 0 * time, current=0.1 + 0 * time, speed=50 + 0 * time)
    <fdhil.Recording axis X: 1000 samples at 1000 Hz, 1 s; voltage, current, speed>
    >>> fdhil.Recording(time, voltage=12 + 0 * time, current=0 * time, speed=time[1:])
    Traceback (most recent call last):
    ...
    fdhil.errors.RecordingError: recording has columns of different lengths, ...
    """

    def __init__(
        self,
        time: Array,
        voltage: Array | None = None,
        current: Array | None = None,
        speed: Array | None = None,
        position: Array | None = None,
        demand: Array | None = None,
        torque: Array | None = None,
        axis: str = "X",
        pitch_m_per_rev: float | None = None,
        *,
        angle: Array | None = None,
        angle_scale: float = 1.0,
        speed_scale: float = 1.0,
        voltage_sampling: Literal["interval_mean", "instant"] = "interval_mean",
        torque_constant_nm_per_a: float | None = None,
        rapid_speed_m_per_s: float | None = None,
        speed_source: Literal["sensor", "difference", "filtered"] | None = None,
        voltage_source: Literal["terminals", "command"] | None = None,
        temperature_c: float | None = None,
        name: str = "recording",
    ) -> None:
        given = {
            "time_s": (time, 1.0),
            VOLTAGE_COLUMN: (voltage, 1.0),
            "current_A": (current, 1.0),
            "torque_Nm": (torque, 1.0),
            "speed_rad_per_s": (speed, speed_scale),
            "angle_rad": (angle, angle_scale),
            "position_m": (position, 1.0),
            "demand_m": (demand, 1.0),
        }
        columns = {key: _convert_column(key, v, name) * scale for key, (v, scale) in given.items() if v is not None}
        options = {
            "pitch_m_per_rev": pitch_m_per_rev,
            "torque_constant_nm_per_a": torque_constant_nm_per_a,
            "rapid_speed_m_per_s": rapid_speed_m_per_s,
            "speed_source": speed_source,
            "voltage_source": voltage_source,
            "temperature_C": temperature_c,
            "voltage_sampling": None if voltage is None else voltage_sampling,
        }
        headers = {"format": RECORDING_FORMAT, "axis": axis, **{k: str(v) for k, v in options.items() if v is not None}}
        self._set_signals(make_recording(_build_table(headers, columns, name), name), name)

    def _set_signals(self, signals: RecordedSignals | Window, name: str) -> None:
        self.signals, self.name = signals, name

    @classmethod
    def of(cls, signals: RecordedSignals | Window, name: str) -> Recording:
        """Return a recording of signals that were read."""
        made = cls.__new__(cls)
        made._set_signals(signals, name)
        return made

    @property
    def axis(self) -> str:
        """The name of the axis."""
        return self.signals.axis

    @property
    def time(self) -> Float:
        """The times of the samples (n,) in s, lost ones included."""
        return np.arange(self.speed.size, dtype=np.float64) * self.signals.dt_s

    @property
    def voltage(self) -> Float | None:
        """The voltage (n,) in V, None where it was not recorded."""
        return self.signals.voltage_v

    @property
    def current(self) -> Float:
        """The current (n,) in A."""
        return self.signals.current_a

    @property
    def speed(self) -> Float:
        """The speed of the motor (n,) in rad/s."""
        return self.signals.speed_rad_s

    def __repr__(self) -> str:
        """Return a summary in one line."""
        n, dt = self.speed.size, self.signals.dt_s
        what = ", ".join((*(("voltage",) if self.voltage is not None else ()), "current", "speed"))
        return f"<fdhil.Recording axis {self.axis}: {n} samples at {1 / dt:.6g} Hz, {n * dt:.3g} s; {what}>"


def read(path: str | Path, columns: str | Path | Mapping[str, Any] | None = None, **headers: str | float) -> Recording:
    """Read a recording from CSV, MATLAB, Parquet, MDF 4 or HDF5.

    Another program's file needs ``columns``: the path of a column map (TOML); or a mapping such as ``{"time": "Time",
    "voltage": "CH1", "current": "CH2", "speed": "n_act"}``, where a part of a heading is sufficient and ``("CH2",
    "mA")`` adds a unit that the file lacks; or ``"?"``, which proposes all by headings, units and physics. ``headers``
    add what the file lacks: ``axis``, ``voltage_sampling``, ``pitch_m_per_rev``.

    Raises :class:`fdhil.errors.RecordingError` or :class:`fdhil.errors.ConfigError`.
    """
    path = Path(path)
    if columns is None:
        stored = read_stored_window(path)
        return Recording.of(stored if stored is not None else read_recording(path), str(path))
    if isinstance(columns, str | Path) and str(columns) != PROPOSE:
        return Recording.of(read_recording(path, read_column_map(Path(columns))), str(path))
    raw = read_raw(path)
    wanted = columns if isinstance(columns, Mapping) else {}
    proposed = propose_for_table(
        raw, {SIGNALS.get(signal, signal): heading for signal, heading in wanted.items()}, str(path)
    )
    if isinstance(columns, str) and proposed.faults:
        raise RecordingError(f"{path}: {'; '.join(proposed.faults)}: give columns as a mapping")
    found = {each.signal: {"name": each.heading, "unit": each.unit} for each in proposed.columns}
    document = {"headers": {**proposed.headers, **headers}, "columns": found}
    return Recording.of(
        make_recording(apply_column_map(raw, check_map(document, str(path)), str(path)), str(path)), str(path)
    )


def _convert_column(key: str, values: Array, name: str) -> Float:
    try:
        array = np.asarray(values)
        if key == "time_s" and array.dtype.kind in "mM" and array.size:
            array = (array - array[0]) / np.timedelta64(1, "s")
        array = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{name}: {key} is not an array of numbers ({error}): convert it first") from None
    if array.ndim != 1:
        raise RecordingError(f"{name}: {key} has shape {array.shape}: give one dimension, (n,)")
    return array


def _build_table(headers: dict[str, str], columns: dict[str, Float], name: str) -> RecordingTable:
    sizes = {key: values.size for key, values in columns.items()}
    if len(set(sizes.values())) > 1:
        raise RecordingError(f"{name} has columns of different lengths, {sizes}: give all n samples of each")
    for key, values in columns.items():
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            raise RecordingError(f"{name} has a {key} that is not finite at index {row}: leave out lost samples")
    time_s = columns["time_s"]
    if time_s.size > 1 and (wrong := np.diff(time_s) <= 0).any():
        row = int(np.argmax(wrong)) + 1
        raise RecordingError(
            f"{name}: time does not increase at index {row} ({time_s[row]:g} s): sort or cut the samples"
        )
    if time_s.size > 1:
        columns["time_s"], note = find_even_times(time_s, None, name)
        headers["sample_rate_hz"] = repr(1.0 / compute_usual_step(columns["time_s"]))
        if note:
            headers[IMPORT_NOTES] = note
    else:
        headers["sample_rate_hz"] = "1000"
    if "speed_rad_per_s" not in columns and "angle_rad" not in columns and "position_m" in columns:
        if "pitch_m_per_rev" not in headers:
            raise RecordingError(
                f"{name}: pitch_m_per_rev is needed to derive a speed from the position: give it, or an angle"
            )
        columns["angle_rad"] = columns["position_m"] * (2 * math.pi / float(headers["pitch_m_per_rev"]))
    derive_columns(headers, columns)
    check_sizes(columns, name)
    return RecordingTable(headers, columns)
