"""Derives missing columns of a recording: speed from an angle, current from a torque."""

import math

import numpy as np

from fdhil.errors import RecordingError
from fdhil.records import Float
from fdhil.store.recording_table import ANGLE, IMPORT_NOTES, SAMPLING, VOLTAGE_COLUMN

TORQUE = "torque_Nm"
CONSTANT = "torque_constant_nm_per_a"
LARGEST = {  # limit of real drives -> likely unit beyond it
    "voltage_V": (3e3, "mV (multiply by 1e-3)"),
    "current_A": (3e3, "mA (multiply by 1e-3)"),
    "speed_rad_per_s": (6e3, "1/min (multiply by 2 pi / 60) or degrees per second (by pi / 180)"),
}
LONGEST_STEP_S = 0.2


def derive_columns(headers: dict[str, str], columns: dict[str, Float]) -> None:
    """Replace an angle (rad) by its speed, and a torque (N.m) by its current, in columns (n,).

    A torque is divided by the header's torque constant. Without one it counts as the current of a motor with a constant
    of 1; a voltage, which belongs to the real constant, is then dropped with a note.
    """
    angle, torque = columns.get(ANGLE), columns.pop(TORQUE, None)
    if angle is not None and "speed_rad_per_s" not in columns:
        columns["speed_rad_per_s"] = compute_rate(angle, columns["time_s"])
        headers["speed_source"] = "difference"
    if torque is None or "current_A" in columns:
        return
    if CONSTANT in headers:
        columns["current_A"] = torque / float(headers[CONSTANT])
        return
    columns["current_A"], headers[CONSTANT] = torque, "1"
    if columns.pop(VOLTAGE_COLUMN, None) is not None:
        headers.pop(SAMPLING, None)
        note = f"the voltage was dropped: with a torque it needs {CONSTANT}"
        headers[IMPORT_NOTES] = "; ".join(filter(None, [headers.get(IMPORT_NOTES, ""), note]))


def compute_rate(positions: Float, time_s: Float) -> Float:
    """Return the mean rate (n,) of positions (n,) over the interval before each sample; 0 in the first."""
    return np.concatenate([[0.0], np.diff(positions) / np.diff(time_s)])


def check_sizes(columns: dict[str, Float], source: str) -> None:
    """Refuse numbers beyond those of drives, naming the unit that they may be in."""
    for name, (largest, meant) in LARGEST.items():
        top = float(np.abs(columns[name]).max()) if name in columns and columns[name].size else 0.0
        if math.isfinite(top) and top > largest:
            raise RecordingError(
                f"{source}: {name} reaches {top:.4g}, above the {largest:g} of any drive: is it in {meant}?"
            )
    step = float(np.median(np.diff(columns["time_s"]))) if columns["time_s"].size > 1 else 0.0
    if step >= LONGEST_STEP_S:
        raise RecordingError(
            f"{source}: samples are {step:.4g} s apart, too far for a drive's acceleration: is time in ms "
            "(multiply by 1e-3)? Otherwise record at 1000 Hz or faster"
        )
