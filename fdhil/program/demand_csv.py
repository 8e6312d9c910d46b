"""Demand CSV: a recorded or exported reference, a row per SYNC period, ``time_s,X_mm,Y_mm[,Z_mm]``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import IO

import numpy as np

from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault, RecordingError
from fdhil.records import Float, Trajectory, frozen, frozen_ints

_STEP_TOLERANCE = 1e-3  # of the SYNC period, for the period itself
_JITTER_TOLERANCE = 0.01  # of the SYNC period, for one row
_ROUNDING_S = 1.1e-6  # times may be written with 6 decimals
_MOVED_MM = 1e-9


def read_demand_csv(path: Path, config: MachineConfig) -> Trajectory:
    """Read a demand CSV as the reference of a machine.

    RecordingError when it cannot be read: a column is missing, text or nothing stands where a number belongs, times are
    not uniform, or an axis moves that the machine lacks. ConfigError when its step is not the SYNC period.
    """
    columns = _columns(path)
    missing = [f"{name}_mm" for name in config.axis if f"{name}_mm" not in columns and name in "XYZ"]
    if "time_s" not in columns or missing:
        absent = ", ".join((["time_s"] if "time_s" not in columns else []) + missing)
        wanted = ",".join(["time_s", *(f"{name}_mm" for name in config.axis if name in "XYZ")])
        raise RecordingError(f"{path}: there is no column {absent}; a demand begins with the line {wanted}")
    table = _numbers(path, len(columns))
    time_s = table[:, columns.index("time_s")]
    _check_times(path, time_s, config.machine.sync_period_s)
    for place, name in enumerate(columns):
        axis = name.removesuffix("_mm")
        if name.endswith("_mm") and axis not in config.axis and np.ptp(table[:, place]) > _MOVED_MM:
            raise RecordingError(f"{path}: axis {axis} moves, which the configuration lacks; add [axis.{axis}] to it")
    n = time_s.size
    position = {
        axis: frozen(table[:, columns.index(f"{axis}_mm")]) if f"{axis}_mm" in columns else frozen(np.zeros(n))
        for axis in config.axis
    }
    rapid = np.zeros(n, dtype=np.bool_)
    rapid.setflags(write=False)
    return Trajectory(config.machine.sync_period_s, frozen(time_s), position, rapid, frozen_ints(np.zeros(n)))


def _columns(path: Path) -> list[str]:
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = file.readline(4096)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}); check the path") from None
    except UnicodeDecodeError:
        raise RecordingError(f"{path} is no text; give a demand as CSV or an NC program") from None
    return [name.strip() for name in header.split(",")]


def _numbers(path: Path, width: int) -> Float:
    try:
        with path.open(encoding="utf-8-sig") as file:
            next(file)
            if not any(line.strip() for line in file):
                raise RecordingError(f"{path}: there is no row of data; record or export it again")
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2, comments=None, encoding="utf-8-sig")
    except (ValueError, StopIteration) as error:
        raise RecordingError(f"{path} cannot be read ({error}); each row wants {width} numbers") from None
    if table.shape[1] != width:
        raise RecordingError(f"{path}: {table.shape[1]} numbers a row under {width} columns; export it again")
    wrong = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if wrong.size:
        raise RecordingError(f"{path}: row {int(wrong[0]) + 2} holds a value that is no finite number; record it again")
    return np.asarray(table, dtype=np.float64)


def _check_times(path: Path, time_s: Float, sync_period_s: float) -> None:
    if time_s.size < 2:
        raise RecordingError(f"{path}: one row is no demand; record or export it again")
    steps = np.diff(time_s)
    step = float(np.median(steps))
    if abs(step - sync_period_s) > _STEP_TOLERANCE * sync_period_s + _ROUNDING_S:
        fault = ConfigFault("machine.sync_period_s", f"is {sync_period_s:g} s, but the rows are {step:g} s apart",
                            "set it to the step of the demand")  # fmt: skip
        raise ConfigError(str(path), [fault])
    off = np.flatnonzero(np.abs(steps - sync_period_s) > _JITTER_TOLERANCE * sync_period_s + 2 * _ROUNDING_S)
    if off.size:
        row = int(off[0]) + 3
        raise RecordingError(
            f"{path}: row {row} is {steps[off[0]]:g} s after the one before it; rows must be one SYNC apart"
        )


def write_demand_csv(trajectory: Trajectory, file: Path | IO[bytes]) -> None:
    """Write a reference as demand CSV: mm with 9 decimals."""
    decimals = max(6, min(12, 1 - math.floor(math.log10(trajectory.dt_s))))
    table = np.column_stack([trajectory.time_s, *trajectory.position_mm.values()])
    header = ",".join(["time_s", *(f"{axis}_mm" for axis in trajectory.axes)])
    formats = [f"%.{decimals}f", *("%.9f" for _ in trajectory.axes)]
    np.savetxt(file, table, fmt=formats, delimiter=",", header=header, comments="")
