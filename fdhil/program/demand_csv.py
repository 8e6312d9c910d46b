"""Demand CSV: a recorded or exported reference, one row per SYNC period, ``time_s,X_mm,Y_mm[,Z_mm][,A_deg]``.

A gantry axis needs one column: the second drive has the same demand unless it has its own column.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np

from fdhil.config import MachineConfig
from fdhil.csv_text import check_lengths, decode_text, quote_cell, read_content
from fdhil.errors import ConfigError, ConfigFault, ProgramError, RecordingError
from fdhil.program.limit_notes import find_limit_violations
from fdhil.program.position_range_check import find_first_out_of_range
from fdhil.records import Float, Trajectory, freeze_array, freeze_integers

_STEP_TOLERANCE = 1e-3  # of the SYNC period, for the period itself
_JITTER_TOLERANCE = 0.01  # of the SYNC period, for one row
_ROUNDING_S = 1.1e-6  # times may be written with 6 decimals
_MOVED_MM = 1e-9
_TOO_FAST = 20.0  # times the rapid speed, over most of the rows that move
_TOO_SLOW, _SMALL_MM = 2e-3, 2.0  # of the rapid speed, and of travel: both is no job, but may be a test

_OTHER_MARKS = {";": "semicolons", "\t": "tabs", "|": "bars", '"': "quotes"}  # of other kinds of CSV


def require_digest(path: Path, found: str, sha256: str | None) -> None:
    """Raise ProgramError if the content of a file does not have the digest ``sha256``."""
    if sha256 is not None and found != sha256:
        raise ProgramError(0, "", f"{path} was modified while it was checked, so it was not armed; arm it again")


def read_demand_csv(path: Path, config: MachineConfig, sha256: str | None = None) -> Trajectory:
    """Read a demand CSV as the reference of a machine.

    RecordingError if it cannot be read: a missing or duplicate column, a truncated file, a cell that is not a number,
    non-uniform times, or motion of an axis that the machine lacks. ConfigError if its step is not the SYNC period.
    ProgramError if the file does not have the digest ``sha256``.
    """
    content = read_content(path)
    require_digest(path, hashlib.sha256(content).hexdigest(), sha256)
    text = decode_text(content, str(path))
    lines = text.splitlines() or [""]
    check_lengths(lines, 1, str(path))
    names = [name.strip() for name in lines[0].split(",")]
    wanted = ["time_s", *(f"{axis}_mm" for axis in config.axis if axis in "XYZ")]
    if absent := [name for name in wanted if name not in names]:
        found = [what for mark, what in _OTHER_MARKS.items() if mark in lines[0]]
        instead = f"; its first line has {' and '.join(found)}, but only commas separate names" if found else ""
        begins = f"a demand begins with the line {','.join(wanted)}"
        raise RecordingError(f"{path}: there is no column {', '.join(absent)}{instead}; {begins}")
    if twice := next((name for k, name in enumerate(names) if name in names[:k]), None):
        raise RecordingError(f"{path} has two columns {quote_cell(twice)}; remove one")
    if not text.endswith("\n"):
        cut = f"line {len(lines)} has no end of line, so its last number may be truncated"
        raise RecordingError(f"{path} is truncated: {cut}; copy it again")
    table = _parse_numbers(path, lines, names)
    columns = {name: table[:, k] for k, name in enumerate(names)}
    _check_times(path, lines, columns["time_s"], config.machine.sync_period_s)
    moved = {}
    for name, column in columns.items():
        axis, _, unit = name.rpartition("_")
        if unit in ("mm", "deg"):
            known = config.axis.get(axis)
            if known is None and np.ptp(column) > _MOVED_MM:
                text = f"axis {axis} moves, but the configuration lacks it; add [axis.{axis}]"
                raise RecordingError(f"{path}: {text}")
            if known is not None and known.unit != unit:
                text = f"has a column {name}, but the configuration has axis {axis} in {known.unit}"
                raise RecordingError(f"{path} {text}; write {axis}_{known.unit}, or correct unit in [axis.{axis}]")
            moved[axis] = column * known.mm_per_unit if known is not None else column
    moved |= {name: moved[name[0]] for name in config.axis if name not in moved and name[0] in moved}
    _check_speeds(path, {axis: moved[axis] for axis in config.axis if axis in moved}, config)
    still = np.zeros(len(table))
    rapid = still.astype(np.bool_)
    rapid.setflags(write=False)
    position_mm = {axis: freeze_array(moved.get(axis, still)) for axis in config.axis}
    if (beyond := find_first_out_of_range(position_mm, config)) is not None:
        raise RecordingError(f"{path} line {_find_line_number(lines, beyond.row)}: {beyond.text}")
    time_s = freeze_array(columns["time_s"])
    demand = Trajectory(
        config.machine.sync_period_s,
        time_s,
        position_mm,
        rapid,
        freeze_integers(still),
        mm_per_degree=config.mm_per_degree,
    )
    return replace(demand, notes=find_limit_violations(demand, config))


def _parse_numbers(path: Path, lines: Sequence[str], names: Sequence[str]) -> Float:
    rows = [line for line in lines[1:] if line.strip()]
    if not rows:
        raise RecordingError(f"{path}: there is no row of data; record or export it again")
    try:
        table = np.loadtxt(rows, delimiter=",", ndmin=2, comments=None)
    except ValueError:
        raise _find_bad_row(path, lines, names) from None
    if table.shape[1] != len(names) or not np.isfinite(table).all():
        raise _find_bad_row(path, lines, names)
    return np.asarray(table, dtype=np.float64)


def _find_bad_row(path: Path, lines: Sequence[str], names: Sequence[str]) -> RecordingError:
    for number, line in enumerate(lines[1:], 2):
        cells = line.split(",")
        if line.strip() and len(cells) != len(names):
            what = f"has {len(cells)} values in {len(names)} columns"
            return RecordingError(f"{path} line {number} {what}; record or export it again")
        for cell in cells if line.strip() else []:
            try:
                finite = math.isfinite(float(cell))
            except ValueError:
                finite = False
            if not finite:
                what = f"has {quote_cell(cell.strip())} instead of a finite number"
                return RecordingError(f"{path} line {number} {what}; record or export it again")
    return RecordingError(f"{path} cannot be read as numbers; export it again")


def _check_times(path: Path, lines: Sequence[str], time_s: Float, sync_period_s: float) -> None:
    if time_s.size < 2:
        raise RecordingError(f"{path}: a demand needs at least two rows; record or export it again")
    steps = np.diff(time_s)
    step = float(np.median(steps))
    if abs(step - sync_period_s) > _STEP_TOLERANCE * sync_period_s + _ROUNDING_S:
        fault = ConfigFault("machine.sync_period_s", f"is {sync_period_s:g} s, but the rows are {step:g} s apart",
                            "set it to the step of the demand")  # fmt: skip
        raise ConfigError(str(path), [fault])
    off = np.flatnonzero(np.abs(steps - sync_period_s) > _JITTER_TOLERANCE * sync_period_s + 2 * _ROUNDING_S)
    if off.size:
        number = _find_line_number(lines, int(off[0]) + 1)
        text = f"{path} line {number} is {steps[off[0]]:g} s after the row before it; rows must be one SYNC apart"
        raise RecordingError(text)


def _find_line_number(lines: Sequence[str], row: int) -> int:
    return [number for number, line in enumerate(lines, 1) if line.strip()][row + 1]


def _check_speeds(path: Path, columns: Mapping[str, Float], config: MachineConfig) -> None:
    """Refuse speeds that only a wrong unit explains; warn about a demand that hardly moves."""
    ratios, speeds = {}, {}
    for name, values in columns.items():
        steps = np.abs(np.diff(values))
        moving = steps[steps > _MOVED_MM]
        if moving.size:  # one or two steps may be a jump, which is checked elsewhere
            speeds[name] = float(np.median(moving)) / config.machine.sync_period_s
            ratios[name] = speeds[name] / config.axis[name].rapid_speed_mm_s
    if not ratios:
        return
    name = max(ratios, key=lambda axis: ratios[axis])
    if ratios[name] > _TOO_FAST:
        axis = config.axis[name]
        thousandths = "um" if axis.unit == "mm" else "mdeg"
        raise RecordingError(
            f"{path}: axis {name} moves at {speeds[name] / axis.mm_per_unit:.3g} {axis.unit}/s, {ratios[name]:.3g} "
            f"times its rapid speed; is {name}_{axis.unit} in {thousandths} or in increments? "
            f"convert it to {axis.unit}, or correct {axis.format_key('rapid_speed_mm_s')}"
        )
    if ratios[name] < _TOO_SLOW and max(float(np.ptp(values)) for values in columns.values()) < _SMALL_MM:
        text = (
            "%s: no axis moves by more than %g mm or faster than %.2g of its rapid speed; is it in m? convert it to mm"
        )
        logging.getLogger("fdhil").warning(text, path, _SMALL_MM, _TOO_SLOW)


def write_demand_csv(trajectory: Trajectory, file: Path | IO[bytes]) -> None:
    """Write a reference as demand CSV: mm and degrees with 9 decimals. RecordingError if it cannot be written."""
    decimals = max(6, min(12, 1 - math.floor(math.log10(trajectory.dt_s))))
    turn = trajectory.mm_per_degree
    moved = {f"{a}_deg" if a in turn else f"{a}_mm": p / turn.get(a, 1.0) for a, p in trajectory.position_mm.items()}
    table = np.column_stack([trajectory.time_s, *moved.values()])
    header = ",".join(["time_s", *moved])
    formats = [f"%.{decimals}f", *("%.9f" for _ in trajectory.axes)]
    try:
        np.savetxt(file, table, fmt=formats, delimiter=",", header=header, comments="")
    except OSError as error:
        raise RecordingError(f"{file} cannot be written ({error.strerror}); check the folder") from None
