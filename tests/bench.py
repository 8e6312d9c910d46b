"""The bench machine that the tests share: two equal axes, the paper's plant, the default NC and regulators."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

from fdhil import config

_AXIS = """
screw_pitch_mm = 20.0
rapid_speed_mm_s = 500.0
max_acceleration_mm_s2 = 4000.0
nominal = { R = 0.5, L = 0.005, K = 0.8, Jt = 0.075, ft = 0.05, Cd = 5.0 }
correction = { max_offset_um = 250.0, max_speed_mm_s = 20.0, max_acceleration_mm_s2 = 2000.0 }
[regulators]
position_gain_per_s = 50.0
speed_feedforward = 1.0
speed_kp = 23.562
speed_ki = 1184.35
speed_period_s = 0.00025
current_limit_a = 200.0
current_kp = 12.566
current_ki = 1256.64
current_period_s = 3.125e-5
voltage_limit_v = 300.0
"""


def bench_document(axes: str = "XY") -> dict[str, Any]:
    """Return the bench's configuration as a parsed TOML document, free to be changed."""
    axis = tomllib.loads(_AXIS)
    return {
        "machine": {"name": "bench", "sync_period_s": 0.001},
        "axis": {name: copy.deepcopy(axis) for name in axes},
    }


def bench_config(axes: str = "XY", folder: Path = Path()) -> config.MachineConfig:
    """Return the bench's configuration; its store is below ``folder``."""
    return config.parse(bench_document(axes), folder=folder)
