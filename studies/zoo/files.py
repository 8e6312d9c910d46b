"""Writes what a zoo's machine gives an engineer: recordings, a configuration and the demand of a program."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from studies.zoo.machines import Axis
from studies.zoo.plant import Array, Motion, run


def report_signals(axis: Axis, setpoint_m: Array, seed: int) -> dict[str, Array]:
    """Return the columns of a recording of one motion, SI units."""
    kind, rng = axis.kind, np.random.default_rng(seed)
    ahead = kind.reports.ahead
    followed = np.concatenate([np.full(ahead, setpoint_m[0]), setpoint_m[: len(setpoint_m) - ahead]])
    moved = run(axis.plant, axis.drive, followed, kind.period_s)
    return {
        "voltage_V": _add_noise(getattr(moved, kind.reports.voltage) * kind.reports.scale, kind.reports.noise, rng),
        "current_A": _add_noise(getattr(moved, kind.reports.current) * kind.reports.scale, kind.reports.noise, rng),
        "speed_rad_per_s": moved.speed,
        "position_m": convert_to_metres(axis, moved.motor),
        "demand_m": setpoint_m,
    }


def _add_noise(values: Array, share: float, rng: np.random.Generator) -> Array:
    return values + share * float(np.abs(values).max()) * rng.standard_normal(values.size)


def convert_to_metres(axis: Axis, angle_rad: Array) -> Array:
    """Return the travel (n,) in m of an angle at the motor."""
    return angle_rad * axis.plant.pitch_m / (2 * math.pi)


def write_recording(path: Path, name: str, axis: Axis, columns: Mapping[str, Array]) -> None:
    """Write a recording in the format that fdhil imports."""
    kind = axis.kind
    headers = {
        "format": "fdhil-recording-1",
        "sample_rate_hz": f"{1 / kind.period_s:g}",
        "voltage_sampling": kind.reports.sampling,
        "axis": name,
        "pitch_m_per_rev": f"{axis.plant.pitch_m:g}",
        "rapid_speed_m_per_s": f"{kind.rapids.speed:g}",
    }
    lines = [f"# {key}: {value}" for key, value in headers.items()]
    table = np.column_stack([np.arange(len(columns["demand_m"])) * kind.period_s, *columns.values()])
    rows = [",".join(f"{value:.8g}" for value in row) for row in table.round(7)]
    path.write_text("\n".join([*lines, ",".join(["time_s", *columns]), *rows]) + "\n", "utf-8")


def write_configuration(path: Path, axes: Mapping[str, Axis]) -> None:
    """Write the machine's configuration (TOML)."""
    period_s = next(iter(axes.values())).kind.period_s
    lines = ["[machine]", 'name = "zoo"', f"sync_period_s = {period_s}"]
    for name, axis in axes.items():
        lines += _format_table(f"axis.{name}", axis.section)
    path.write_text("\n".join(lines) + "\n", "utf-8")


def _format_table(name: str, values: Mapping[str, Any]) -> list[str]:
    lines = [f"[{name}]"]
    lines += [f"{key} = {value!r}".replace("'", '"') for key, value in values.items() if not isinstance(value, dict)]
    for key, value in values.items():
        if isinstance(value, dict):
            lines += _format_table(f"{name}.{key}", value)
    return lines


def write_demand(path: Path, path_m: Array, period_s: float) -> None:
    """Write the demand of a program as a CSV."""
    rows = [f"{k * period_s:.6f},{x:.6f},{y:.6f}" for k, (x, y) in enumerate(1e3 * path_m)]
    path.write_text("\n".join(["time_s,X_mm,Y_mm", *rows]) + "\n", "utf-8")


def simulate_cut(
    axes: Mapping[str, Axis], path_m: Array, offset_um: Mapping[str, Array] | None = None
) -> dict[str, Motion]:
    """Cut the path (n, 2), with offsets (n,) in um per axis where there are some."""
    offsets = offset_um or {}
    return {
        name: run(axis.plant, axis.drive, path_m[:, k] + 1e-6 * offsets.get(name, 0.0), axis.kind.period_s)
        for k, (name, axis) in enumerate(axes.items())
    }


def locate_table_m(axes: Mapping[str, Axis], moved: Mapping[str, Motion]) -> Array:
    """Return where the table is (n, d), m."""
    return np.column_stack([convert_to_metres(axis, moved[name].table) for name, axis in axes.items()])
