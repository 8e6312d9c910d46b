"""Programs with A B C words: the demand of a rotary axis, alone and with X Y Z, by each profile."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fdhil.config import MachineConfig, parse_config
from fdhil.errors import ProgramError, RecordingError
from fdhil.program import Budget, Rapid, interpret, plan
from fdhil.program.demand_csv import read_demand_csv, write_demand_csv
from fdhil.records import Float, Trajectory
from tests.bench import bench_document, rotary_and_gantry_document, rotary_axis

PROFILES = ("fir", "trapezoidal", "jerk_limited", "linuxcnc")


def build_machine(profile: str = "fir", **nc: object) -> MachineConfig:
    return parse_config(rotary_and_gantry_document(profile=profile, **nc))


def plan_program(text: str, config: MachineConfig) -> Trajectory:
    return plan(list(interpret(text.split("|"))), config)


def list_angles_deg(demand: Trajectory, config: MachineConfig) -> Float:
    return demand.position_mm["A"] / config.axis["A"].mm_per_unit


@pytest.mark.parametrize("profile", PROFILES)
def test_mixed_move_turns_the_table_in_the_time_of_its_feed_along_xyz(profile: str) -> None:
    """RS274: F applies to X Y Z if they move; A follows in proportion."""
    config = build_machine(profile)
    demand = plan_program("G94 F600|G1 X30 Y40 A90", config)
    x, a = demand.position_mm["X"], list_angles_deg(demand, config)
    assert a == pytest.approx(3.0 * x, abs=1e-6)
    assert a[-1] == pytest.approx(90.0)
    assert np.hypot(np.diff(x), np.diff(demand.position_mm["Y"])).max() / 0.001 == pytest.approx(10.0, rel=1e-6)


@pytest.mark.parametrize("profile", PROFILES)
def test_feed_of_a_rotary_axis_alone_is_in_degrees_per_minute(profile: str) -> None:
    config = build_machine(profile)
    a = list_angles_deg(plan_program("G94 F3000|G1 A180", config), config)
    assert np.diff(a).max() / 0.001 == pytest.approx(50.0, rel=1e-6)


@pytest.mark.parametrize("profile", PROFILES)
def test_inverse_time_feed_gives_each_mixed_move_its_time(profile: str) -> None:
    """G93 F30: each move lasts two seconds, whatever it moves."""
    config = build_machine(profile, rapid_stop=False)
    a = list_angles_deg(plan_program("G93|G1 A60 F30|G1 X10 A0 F30", config), config)
    assert np.diff(a).max() / 0.001 == pytest.approx(30.0, rel=0.02)
    assert np.diff(a).min() / 0.001 == pytest.approx(-30.0, rel=0.02)


@pytest.mark.parametrize("profile", PROFILES)
def test_rapid_keeps_the_limits_of_the_rotary_axis(profile: str) -> None:
    config = build_machine(profile)
    demand = plan_program("G0 X10 A180", config)
    speed = np.diff(list_angles_deg(demand, config)) / 0.001
    assert speed.max() == pytest.approx(280.0, rel=0.01)
    assert np.abs(np.diff(speed)).max() / 0.001 <= 2300.0 * 1.02
    assert demand.rapid.any()


@pytest.mark.parametrize("profile", PROFILES)
def test_feed_that_the_table_cannot_follow_is_lowered_to_its_limit(profile: str) -> None:
    config = build_machine(profile)
    speed = np.diff(list_angles_deg(plan_program("G94 F6000|G1 X10 A360", config), config)) / 0.001
    assert speed.max() <= 280.0 * 1.001


@pytest.mark.parametrize("profile", PROFILES)
def test_arc_with_a_rotary_word_turns_evenly_along_it(profile: str) -> None:
    config = build_machine(profile)
    demand = plan_program("G94 F1200|G2 X40 Y0 I20 A30", config)
    x, y = demand.position_mm["X"], demand.position_mm["Y"]
    along = (np.pi - np.arctan2(y, x - 20.0)) / np.pi * 30.0
    inside = (list_angles_deg(demand, config) > 1.0) & (list_angles_deg(demand, config) < 29.0)
    assert list_angles_deg(demand, config)[inside] == pytest.approx(along[inside], abs=0.2)


@pytest.mark.parametrize("profile", PROFILES)
def test_both_drives_of_a_gantry_axis_get_one_demand(profile: str) -> None:
    demand = plan_program("F1000|G1 X5 Y20|G0 Y0", build_machine(profile))
    assert np.array_equal(demand.position_mm["Y"], demand.position_mm["Y2"])
    assert (demand.axes, demand.table_axes) == (("X", "Y", "Y2", "A"), ("X", "Y", "A"))
    assert demand.path_mm.shape[1] == 3


def test_path_speed_limits_lengths_and_no_angles() -> None:
    config = build_machine("trapezoidal", max_path_speed_mm_s=20.0)
    mixed, alone = (list_angles_deg(plan_program(text, config), config) for text in ("G0 X10 A10", "G0 A180"))
    assert np.diff(mixed).max() / 0.001 == pytest.approx(20.0, rel=1e-3)
    assert np.diff(alone).max() / 0.001 == pytest.approx(280.0, rel=1e-3)


def test_position_text_is_in_degrees() -> None:
    demand = plan_program("F1000|G1 X10 A45", build_machine())
    assert demand.describe_position(len(demand.time_s) - 1) == "X 10.0 Y 0.0 A 45.0"


def test_position_beyond_32_bits_is_refused_in_degrees() -> None:
    with pytest.raises(ProgramError, match=r"axis A at 400000 deg: .* \(5461\.333333 per deg\)"):
        plan_program("G0 A400000", build_machine())


@pytest.mark.parametrize("axis", ["U", "V", "W"])
def test_further_linear_axes_are_planned(axis: str) -> None:
    document = bench_document(f"X{axis}")
    demand = plan_program(f"F600|G1 X10 {axis}5", parse_config(document))
    assert demand.position_mm[axis][-1] == pytest.approx(5.0)


def test_demand_file_has_degrees_and_is_read_again(tmp_path: Path) -> None:
    config = build_machine()
    demand = plan_program("F1000|G1 X10 Y5 A45", config)
    write_demand_csv(demand, tmp_path / "demand.csv")
    lines = (tmp_path / "demand.csv").read_text().splitlines()
    assert lines[0] == "time_s,X_mm,Y_mm,Y2_mm,A_deg"
    assert lines[-1].endswith(",45.000000000")
    read = read_demand_csv(tmp_path / "demand.csv", config)
    for axis, position_mm in demand.position_mm.items():
        assert read.position_mm[axis] == pytest.approx(position_mm, abs=1e-8)


def test_demand_file_of_a_gantry_needs_one_column(tmp_path: Path) -> None:
    path = tmp_path / "demand.csv"
    path.write_text("time_s,X_mm,Y_mm\n" + "".join(f"{k / 1000:.3f},0,{k / 100}\n" for k in range(9)))
    read = read_demand_csv(path, build_machine())
    assert np.array_equal(read.position_mm["Y2"], read.position_mm["Y"])
    assert not read.position_mm["A"].any()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("A_mm", "has a column A_mm, but the configuration has axis A in deg; write A_deg"),
        ("X_mm,X_deg", "has a column X_deg, but the configuration has axis X in mm; write X_mm"),
        ("C_deg", r"axis C moves, but the configuration lacks it; add \[axis\.C\]"),
    ],
)
def test_demand_file_in_another_unit_is_refused(name: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "demand.csv"
    names = ["time_s", *dict.fromkeys(["X_mm", "Y_mm", *name.split(",")])]
    rows = "".join(f"{k / 1000:.3f}" + f",{k / 100}" * (len(names) - 1) + "\n" for k in range(9))
    path.write_text(",".join(names) + "\n" + rows)
    with pytest.raises(RecordingError, match=expected):
        read_demand_csv(path, build_machine())


def test_demand_in_thousandths_of_a_degree_is_refused_with_that_unit(tmp_path: Path) -> None:
    path = tmp_path / "demand.csv"
    path.write_text("time_s,X_mm,Y_mm,A_deg\n" + "".join(f"{k / 1000:.3f},0,0,{90 * k}\n" for k in range(99)))
    with pytest.raises(RecordingError, match=r"axis A moves at 9e\+04 deg/s, .* is A_deg in mdeg or in increments"):
        read_demand_csv(path, build_machine())


def test_demand_beyond_the_limits_of_a_rotary_axis_is_noted_in_degrees(tmp_path: Path) -> None:
    document = bench_document("XY")
    document["axis"]["A"] = rotary_axis()
    document["nc"] = {"profile": "trapezoidal"}
    path = tmp_path / "demand.csv"
    path.write_text("time_s,X_mm,Y_mm,A_deg\n" + "".join(f"{k / 1000:.3f},0,0,{0.4 * k}\n" for k in range(99)))
    texts = [note.text for note in read_demand_csv(path, parse_config(document)).notes]
    assert any(text.startswith("axis A moves at 400 deg/s at") and "rapid_speed_deg_s is 280" in text for text in texts)


WRAPPED = (["A90", "A270", "A10", "A-350", "A-10", "A0", "A-0"], [90.0, 270.0, 370.0, 350.0, 10.0, 360.0, 360.0])
"""Words, and where LinuxCNC 2.9 goes with WRAPPED_ROTARY = 1 (rs274 -i)."""


def test_absolute_words_of_a_wrapped_axis_turn_by_their_sign() -> None:
    config = build_machine(wrapped_axes=["A"])
    words, ends = WRAPPED
    found = list(interpret([f"G0 {word}" for word in words], Budget.create_from_config(config.nc)))
    assert [motion.rotary[0].end for motion in found if isinstance(motion, Rapid)] == ends
    demand = plan(found, config)
    assert list_angles_deg(demand, config)[-1] == pytest.approx(360.0)


def test_absolute_word_of_more_than_one_turn_is_refused_on_a_wrapped_axis() -> None:
    budget = Budget.create_from_config(build_machine(wrapped_axes=["A"]).nc)
    with pytest.raises(ProgramError, match="line 1, 'A400': 400 is not a position of a wrapped rotary axis"):
        list(interpret(["G90 G0 A400"], budget))
    assert [motion.rotary[0].end for motion in interpret(["G91 G0 A400"], budget) if isinstance(motion, Rapid)] == [
        400.0
    ]
