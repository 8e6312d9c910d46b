"""The bench machine that the tests share: two equal axes, the paper's plant, the default NC and regulators.

As a parsed document, as a configuration, and as the text of a file.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdhil import config
from fdhil.cli.demo.toml_writer import format_toml

AXIS: Mapping[str, Any] = {
    "screw_pitch_mm": 20.0,
    "rapid_speed_mm_s": 500.0,
    "max_acceleration_mm_s2": 4000.0,
    "nominal": {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0},
    "correction": {"max_offset_um": 250.0, "max_speed_mm_s": 20.0, "max_acceleration_mm_s2": 2000.0},
    "regulators": {
        "position_gain_per_s": 50.0,
        "speed_feedforward": 1.0,
        "speed_kp": 23.562,
        "speed_ki": 1184.35,
        "speed_period_s": 0.00025,
        "current_limit_a": 200.0,
        "current_kp": 12.566,
        "current_ki": 1256.64,
        "current_period_s": 3.125e-5,
        "voltage_limit_v": 300.0,
    },
}


def bench_axis(corrected: bool = True, **changes: Any) -> dict[str, Any]:
    """Return the table [axis.X] of one axis, free to be changed; ``changes`` are set in it."""
    axis = {**copy.deepcopy(dict(AXIS)), **changes}
    return axis if corrected else {key: value for key, value in axis.items() if key != "correction"}


def bench_document(axes: str = "XY") -> dict[str, Any]:
    """Return the bench's configuration as a parsed TOML document, free to be changed."""
    return {
        "machine": {"name": "bench", "sync_period_s": 0.001},
        "axis": {name: bench_axis() for name in axes},
    }


def axis_toml(name: str = "X", corrected: bool = True, **changes: Any) -> str:
    """Return the lines of [axis.NAME] and the tables in it."""
    return format_toml(bench_axis(corrected, **changes), f"axis.{name}")


def bench_toml(axes: str = "XY", corrected: bool = True, **changes: Any) -> str:
    """Return the file of the bench, to which other tables can be appended; ``changes`` are made in every axis."""
    head = '[machine]\nname = "bench"\nsync_period_s = 0.001\n'
    return head + "".join(axis_toml(name, corrected, **changes) for name in axes)


def bench_config(axes: str = "XY", folder: Path = Path()) -> config.MachineConfig:
    """Return the bench's configuration; its store is below ``folder``."""
    return config.parse_config(bench_document(axes), folder=folder)


def rotary_axis(radius_mm: float = 100.0, **changes: Any) -> dict[str, Any]:
    """Return the table of the bench's axis as a rotary one: a worm of 30 to 1, in degrees."""
    axis = bench_axis(False, unit="deg", radius_mm=radius_mm)
    for key in ("screw_pitch_mm", "rapid_speed_mm_s", "max_acceleration_mm_s2"):
        del axis[key]
    axis |= {"screw_pitch_deg": 12.0, "rapid_speed_deg_s": 280.0, "max_acceleration_deg_s2": 2300.0}
    axis["correction"] = {"max_offset_mdeg": 140.0, "max_speed_deg_s": 11.0, "max_acceleration_deg_s2": 1100.0}
    return axis | changes


def rotary_and_gantry_document(**nc: Any) -> dict[str, Any]:
    """Return a mill with X, a gantry axis Y of the drives Y and Y2, and a rotary axis A; ``nc`` is its [nc]."""
    document = bench_document("XY")
    document["axis"] |= {"Y2": {"drive": {"sign": -1}}, "A": rotary_axis()}
    return document | ({"nc": nc} if nc else {})
