"""Set-points and offsets fit into a drive's 32 bits, or the program is refused with axis, line and last position."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, reject
from hypothesis import strategies as st

from fdhil.config import MachineConfig, PositionRange, parse_config
from fdhil.errors import ConfigError, ProgramError, RecordingError
from fdhil.program import load_trajectory, plan
from fdhil.program.interpreter import interpret
from fdhil.program.position_range_check import find_first_out_of_range
from tests.bench import bench_document

PROFILES = ("fir", "trapezoidal", "jerk_limited", "linuxcnc")


def build_fine_config(per_mm: float = 1e6, sign: int = 1, corrected: bool = True, **nc: Any) -> MachineConfig:
    """Return the bench with one axis whose drive has ``per_mm`` increments per millimetre."""
    document = bench_document("X")
    document["axis"]["X"] |= {"screw_pitch_mm": 10.0, "drive": {"increments_per_rev": round(10 * per_mm), "sign": sign}}
    if not corrected:
        del document["axis"]["X"]["correction"]
    document["nc"] = nc
    return parse_config(document)


@given(
    per_rev=st.integers(1 << 16, (1 << 31) - 1),
    pitch_mm=st.floats(0.5, 400.0),
    sign=st.sampled_from([1, -1]),
    most_um=st.floats(1.0, 250.0),
    away=st.integers(-3000, 3000) | st.integers(-(1 << 40), 1 << 40),
    end=st.sampled_from([-1, 1]),
)
def test_largest_position_never_wraps_with_offset_and_next_is_refused(
    per_rev: int, pitch_mm: float, sign: int, most_um: float, away: int, end: int
) -> None:
    document = bench_document("X")
    document["axis"]["X"] |= {"screw_pitch_mm": pitch_mm, "drive": {"increments_per_rev": per_rev, "sign": sign}}
    document["axis"]["X"]["correction"]["max_offset_um"] = most_um
    try:
        config = parse_config(document)
    except ConfigError:  # limits that no such drive can keep
        reject()
    reach = PositionRange.build_for_axis("X", config.axis["X"], 0.001)
    scaling, most = config.axis["X"].scaling, math.floor(most_um * 1e-3 * per_rev / pitch_mm)
    position_mm = (end * (1 << 31) + away) / (scaling.sign * scaling.increments_per_mm)
    target = scaling.convert_to_increments(position_mm)
    fits = all(-(1 << 31) <= target + offset < 1 << 31 for offset in (-most, 0, most))
    assert reach.can_reach(position_mm) or not fits or most == 0
    if reach.can_reach(position_mm):
        for offset in (-most, most):
            wrapped = struct.unpack("<i", struct.pack("<I", target + offset & 0xFFFFFFFF))[0]
            assert wrapped == target + offset
        return
    assert reach.can_reach(reach.find_last_mm(position_mm))
    room_mm = (abs(away) + 2) / scaling.increments_per_mm + most_um * 1e-3 + 1e-4
    assert abs(reach.find_last_mm(position_mm) - position_mm) <= room_mm
    found = find_first_out_of_range({"X": np.array([0.0, position_mm, 0.0])}, config)
    assert found is not None
    assert (found.row, found.axis) == (1, "X")


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_program_beyond_32_bits_is_refused_with_axis_line_and_the_last_position(profile: str, sign: int) -> None:
    config = build_fine_config(1e6, sign, profile=profile, end_rest_s=0.0)
    last = 2147.2336  # (2^31 - 1 - 250000) / 1e6 mm
    program = ["G1 X10 F30000", f"G1 X{last:.4f}", "G1 X2147.24"]
    with pytest.raises(ProgramError, match=rf"line 3, 'X': axis X at 2147.24 mm: .* is {last:.4f} mm") as caught:
        plan(list(interpret(program)), config)
    assert caught.value.line == 3
    assert plan(list(interpret(program[:2])), config).position_mm["X"][-1] == pytest.approx(last)


def test_arc_out_of_range_between_valid_ends_is_refused() -> None:
    document = bench_document("XY")
    for axis in "XY":
        document["axis"][axis]["drive"] = {"increments_per_rev": (1 << 31) - 1}  # 107 million per mm: +-19.75 mm
    config = parse_config(document)
    program = ["G1 X19 Y0 F300", "G3 X19 Y2 J1 I0", "G1 X0"]
    with pytest.raises(ProgramError, match=r"line 2, 'X': axis X at 19\.75\d* mm: .* is 19\.75 mm"):
        plan(list(interpret(program)), config)


def test_only_set_point_must_fit_without_correction(tmp_path: Path) -> None:
    program = tmp_path / "far.ngc"
    program.write_text("G1 X2147.48 F30000\nM2\n")
    assert load_trajectory(program, build_fine_config(corrected=False)).position_mm["X"].max() == pytest.approx(2147.48)
    program.write_text("G1 X2147.484 F30000\nM2\n")
    with pytest.raises(ProgramError, match=r"the last position that fits is 2147\.4836 mm"):
        load_trajectory(program, build_fine_config(corrected=False))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_demand_beyond_32_bits_is_refused_with_its_line(sign: int, tmp_path: Path) -> None:
    rows = [f"{k / 1000:.3f},{2147.2 + 0.01 * k:.4f}" for k in range(10)]
    demand = tmp_path / "demand.csv"
    demand.write_text("time_s,X_mm\n" + "\n".join(rows) + "\n")
    with pytest.raises(RecordingError, match=r"demand.csv line 6: axis X at 2147.24 mm: .* is 2147.233\d mm"):
        load_trajectory(demand, build_fine_config(sign=sign))


def test_advice_of_message_resolves_error() -> None:
    reach = PositionRange.build_for_axis("X", build_fine_config().axis["X"], 0.001)
    reported = re.search(r"is (\S+) mm;", reach.describe_fault(1e6))
    assert reported is not None
    assert reach.can_reach(float(reported[1]))
