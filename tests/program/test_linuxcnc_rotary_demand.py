"""The demand of mixed moves of linear and rotary axes, compared with LinuxCNC's own trajectory planner."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from fdhil.config import parse_config
from fdhil.program import interpret, plan
from tests.bench import bench_document, rotary_axis
from tests.program.test_linuxcnc_demand import ACCELERATION_MM_S2, Theirs, open_recorder

pytestmark = pytest.mark.debian

TURNING = {
    "mixed": "G1 X20 A90\nX40 A0\nY20\nA45\nX0 Y0 A0\n",
    "alone": "G1 A90\nA30\nA180\n",
    "rapid": "G0 X50 A180\nG0 X0 Y10 A0\n",
    "slow table": "G1 X1 A300\nX20\n",
    "arcs": "G1 X10\nG3 X30 Y0 R12\nG1 A50\nX0 A0\n",
    "inverse time": "G93\nG1 X20 A90 F60\nG1 A0 F30\nG94 F3000\nG1 X0 Y5\n",
}


@pytest.fixture(scope="module")
def record_reference() -> Iterator[Theirs]:
    with open_recorder("XYA") as recorded:
        yield recorded


@pytest.mark.parametrize(("mode", "feed", "most"), [("G61", 6e3, 0.05), ("G64", 6e3, 0.6), ("G64 P0.05", 2e4, 1.5)])
@pytest.mark.parametrize("path", TURNING)
def test_linuxcnc_profile_matches_rotary_demand(
    path: str, mode: str, feed: float, most: float, record_reference: Theirs
) -> None:
    """X, Y in mm and A in degrees at the same millisecond: under G61 exactly, under G64 within a few cycles."""
    text = f"G21 G90 G17 {mode}\nF{feed:g}\n{TURNING[path]}M2\n"
    document = bench_document("XY")
    limits = {"rapid_speed_deg_s": 500.0, "max_acceleration_deg_s2": ACCELERATION_MM_S2, "screw_pitch_deg": 20.0}
    document["axis"]["A"] = rotary_axis(**limits)
    for axis in "XY":
        document["axis"][axis]["max_acceleration_mm_s2"] = ACCELERATION_MM_S2
    document["nc"] = {"profile": "linuxcnc", "rapid_stop": False, "end_rest_s": 0.0}
    config = parse_config(document)
    planned = plan(interpret(text.splitlines()), config).position_mm
    a = np.column_stack([planned[axis] / config.axis[axis].mm_per_unit for axis in "XYA"])
    b = record_reference(text, len(a))
    rows = min(len(a), len(b))
    assert float(np.abs(a[:rows] - b[:rows]).max()) <= most
    assert a[-1] == pytest.approx(b[-1], abs=1e-6)
