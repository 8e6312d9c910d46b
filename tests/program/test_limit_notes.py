"""A recorded demand that exceeds the limits of its NC is reported with axis, figure and position."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fdhil.config import MachineConfig, parse_config
from fdhil.program import interpret, plan
from fdhil.program.limit_notes import find_limit_violations
from fdhil.records import Float, Reason, Trajectory, freeze_array, freeze_integers
from tests.bench import bench_document

PROFILES = ("trapezoidal", "jerk_limited", "linuxcnc")


def build_config(profile: str = "linuxcnc", **nc: Any) -> MachineConfig:
    document = bench_document("XY")
    for axis in "XY":
        document["axis"][axis] |= {"rapid_speed_mm_s": 100.0, "max_acceleration_mm_s2": 2000.0}
    document["nc"] = {"profile": profile, **nc}
    return parse_config(document)


def list_notes(x_mm: Float, y_mm: Float, config: MachineConfig) -> tuple[Reason, ...]:
    rows = np.arange(x_mm.size)
    still = freeze_integers(np.zeros(x_mm.size))
    position = {"X": freeze_array(x_mm), "Y": freeze_array(y_mm)}
    return find_limit_violations(
        Trajectory(0.001, freeze_array(rows * 0.001), position, np.zeros(x_mm.size, np.bool_), still), config
    )


def build_ramp(acceleration: float, top: float, rows: int = 600) -> Float:
    """Return a demand that accelerates to a speed, in mm."""
    speed = np.minimum(acceleration * np.arange(rows) * 0.001, top)
    return np.asarray(np.concatenate([np.zeros(50), np.cumsum(speed * 0.001)]))


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("resolution_mm", [0.0, 20 / 65536, 0.001])
def test_demand_within_limits_has_no_notes(profile: str, resolution_mm: float) -> None:
    config = build_config(profile, max_path_speed_mm_s=90.0)
    text = "G64 P0.05|G0 X60 Y60|G1 X120 Y0 F9000|G2 X100 Y-20 I-20|G61|G1 X0|G1 Y0"
    planned = plan(list(interpret(text.split("|"))), config).position_mm
    x, y = (np.round(v / resolution_mm) * resolution_mm if resolution_mm else np.array(v) for v in planned.values())
    assert list_notes(x, y, config) == ()


@pytest.mark.parametrize("resolution_mm", [0.0, 20 / 65536, 0.001])
@pytest.mark.parametrize(
    ("acceleration", "top", "words"),
    [
        (2600.0, 90.0, "axis Y accelerates by 26"),
        (1500.0, 115.0, "axis Y moves at 115"),
    ],
)
def test_a_demand_beyond_a_limit_is_reported(acceleration: float, top: float, words: str, resolution_mm: float) -> None:
    y = build_ramp(acceleration, top)
    y = np.round(y / resolution_mm) * resolution_mm if resolution_mm else y
    (note,) = [n for n in list_notes(np.zeros(y.size), y, build_config()) if n.text.startswith(words)]
    assert note.code == "DemandBeyondLimits"
    assert ", X 0.0 Y " in note.text
    assert list_notes(np.zeros(y.size), y, build_config("fir")) == ()


def test_a_path_faster_than_the_nc_allows_is_reported() -> None:
    x = build_ramp(1500.0, 80.0)
    (note,) = list_notes(x, x, build_config(max_path_speed_mm_s=100.0))
    assert note.text.startswith("the path speed is 113.")
    assert "nc.max_path_speed_mm_s is 100" in note.text
