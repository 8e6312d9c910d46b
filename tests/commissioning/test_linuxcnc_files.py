"""Import of LinuxCNC's INI and HAL files; with the package installed, all of its sample machines are read."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.commissioning.init.linuxcnc_import import LinuxcncMachine, build_machine, read_linuxcnc
from fdhil.commissioning.init.linuxcnc_text import HalNetlist, parse_hal, parse_ini
from fdhil.errors import ConfigError

SAMPLES = Path("/usr/share/doc/linuxcnc/examples/sample-configs")
INI = """
[EMC]
MACHINE = Mill No 3
[EMCMOT]
SERVO_PERIOD = 2000000
[HAL]
HALFILE = drives.hal
[TRAJ]
COORDINATES = X Y Z
LINEAR_UNITS = mm
MAX_LINEAR_VELOCITY = 400
[KINS]
KINEMATICS = trivkins
[AXIS_X]
MAX_VELOCITY = 500
MAX_ACCELERATION = 1500
[JOINT_0]
TYPE = LINEAR
MAX_VELOCITY = 550
MAX_ACCELERATION = 2000   # mm/s2
FERROR = 5
SCALE = 1000
[AXIS_Y]
MAX_VELOCITY = 300
MAX_ACCELERATION = 1800
[JOINT_1]
SCALE = -819.2
[AXIS_Z]
MAX_VELOCITY = 100
MAX_ACCELERATION = 500
[JOINT_2]
TYPE = LINEAR
MAX_VELOCITY = 100
"""
HAL_TEXT = """
# the drives of X
loadusr -W canopen_drives --conf \\
    bus.xml
setp cia402.0.pos-scale [JOINT_0]SCALE
net x-cmd joint.0.motor-pos-cmd => cia402.0.pos-cmd
net x-fb cia402.0.pos-fb => joint.0.motor-pos-fb
"""


def read_machine(folder: Path, ini: str = INI, **files: str) -> LinuxcncMachine:
    (folder / "mill.ini").write_text(ini)
    for name, text in ({"drives": HAL_TEXT} | files).items():
        (folder / f"{name}.hal").write_text(text)
    return read_linuxcnc(folder / "mill.ini")


def list_values(found: LinuxcncMachine) -> dict[str, object]:
    return {path: each.value for path, each in found.values.items()}


def test_machine_is_read_from_ini_and_hal(tmp_path: Path) -> None:
    found = read_machine(tmp_path)
    assert found.axes == ("X", "Y", "Z")
    assert list_values(found) == {
        "machine.name": "Mill No 3",
        "machine.sync_period_s": 0.002,
        "nc.profile": "linuxcnc",
        "nc.max_path_speed_mm_s": 400.0,
        "axis.X.rapid_speed_mm_s": 400.0,
        "axis.X.max_acceleration_mm_s2": 1500.0,
        "axis.X.drive.following_error_window_mm": 5.0,
        "axis.Y.rapid_speed_mm_s": 300.0,
        "axis.Y.max_acceleration_mm_s2": 1800.0,
        "axis.Z.rapid_speed_mm_s": 100.0,
        "axis.Z.max_acceleration_mm_s2": 500.0,
    }
    assert {axis: (scale.increments_per_unit, scale.source) for axis, scale in found.scales.items()} == {
        "X": (1000.0, "LinuxCNC: cia402.0.pos-scale"),
        "Y": (-819.2, "LinuxCNC: [JOINT_1] SCALE"),
    }
    assert found.values["axis.X.rapid_speed_mm_s"].source == "LinuxCNC: [TRAJ] MAX_LINEAR_VELOCITY"
    assert found.notes == []


ROTARY_AND_GANTRY = (
    INI.replace("COORDINATES = X Y Z", "COORDINATES = XYYA\nANGULAR_UNITS = degree").replace(
        "KINEMATICS = trivkins", "KINEMATICS = trivkins coordinates=XYYA"
    )
    + """
[AXIS_A]
MAX_VELOCITY = 90
MAX_ACCELERATION = 600
[JOINT_3]
TYPE = ANGULAR
FERROR = 2
SCALE = 8192
MIN_LIMIT = -720
MAX_LIMIT = 720
"""
)


def test_rotary_axis_is_read_in_degrees_and_gantry_joint_as_second_drive(tmp_path: Path) -> None:
    found = read_machine(tmp_path, ROTARY_AND_GANTRY.replace("[JOINT_2]", "[JOINT_2]\nSCALE = 819.2"))
    assert found.axes == ("X", "Y", "Y2", "A")
    of_table = {
        path.removeprefix("axis.A."): value for path, value in list_values(found).items() if path.startswith("axis.A.")
    }
    assert of_table == {
        "unit": "deg", "rapid_speed_deg_s": 90.0, "max_acceleration_deg_s2": 600.0,
        "drive.following_error_window_deg": 2.0,
    }  # fmt: skip
    assert not any(path.startswith("axis.Y2.") for path in list_values(found))
    assert {axis: scale.increments_per_unit for axis, scale in found.scales.items()} == {
        "X": 1000.0, "Y": -819.2, "Y2": 819.2, "A": 8192.0
    }  # fmt: skip
    assert found.notes == ["LinuxCNC allows A -720 to 720 deg: do not exceed that with `fdhil commission --room`"]


def test_wrapped_rotary_axis_is_recognised(tmp_path: Path) -> None:
    ini = ROTARY_AND_GANTRY.replace("[AXIS_A]", "[AXIS_A]\nWRAPPED_ROTARY = 1")
    assert list_values(read_machine(tmp_path, ini))["nc.wrapped_axes"] == ["A"]


def test_radians_are_converted_and_unknown_angular_units_refused(tmp_path: Path) -> None:
    ini = ROTARY_AND_GANTRY.replace("ANGULAR_UNITS = degree", "ANGULAR_UNITS = radian")
    assert list_values(read_machine(tmp_path, ini))["axis.A.rapid_speed_deg_s"] == pytest.approx(math.degrees(90.0))
    with pytest.raises(ConfigError, match=r"TRAJ\.ANGULAR_UNITS.*is 'turns'.*one of degree"):
        read_machine(tmp_path, ini.replace("= radian", "= turns"))


def test_inches_are_converted_to_millimetres(tmp_path: Path) -> None:
    found = read_machine(tmp_path, INI.replace("LINEAR_UNITS = mm", "LINEAR_UNITS = inch"))
    assert list_values(found)["axis.Y.rapid_speed_mm_s"] == pytest.approx(7620.0)
    assert found.scales["Y"].increments_per_unit == pytest.approx(-819.2 / 25.4)
    assert list_values(read_machine(tmp_path, INI.replace("= mm", "= 1.0")))["axis.Y.rapid_speed_mm_s"] == 300.0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("KINEMATICS = trivkins", "KINEMATICS = trivkins coordinates=yyy", "axis Y has a third joint, 2: ignored"),
        ("KINEMATICS = trivkins", "KINEMATICS = trivkins coordinates=XYA", "axis A is rotary and ignored: correct"),
        ("COORDINATES = X Y Z", "COORDINATES = X Y B", "axis B is joint 4 of trivkins without coordinates=, and there"),
        ("[AXIS_Z]\nMAX_VELOCITY = 100", "[AXIS_Z]", "axis Z: [AXIS_Z] has no MAX_VELOCITY, so LinuxCNC uses 1"),
        ("MAX_VELOCITY = 550", "MAX_VELOCITY = 450", "ignores it in programmed moves; make both equal"),
        ("FERROR = 5", "FERROR = 5\n[AXIS_X]\nMAX_VELOCITY = 9", "[AXIS_X] occurs twice in the INI"),
        ("COORDINATES = X Y Z", "COORDINATES = X Y Z\nPLANNER_TYPE = 1\nMAX_LINEAR_JERK = 9000", "S-curve planner of"),
        ("COORDINATES = X Y Z", "COORDINATES = X Y Z\nPLANNER_TYPE = 1\nMAX_LINEAR_JERK = 0.5", "trapezoidal planner"),
        ("COORDINATES = X Y Z", "COORDINATES = X Y Z\nPLANNER_TYPE = 7", "PLANNER_TYPE 7 is unknown"),
        ("KINEMATICS = trivkins", "KINEMATICS = xyzac-trt-kins", "fdhil assigns the joints to the axes in the order"),
        ("FERROR = 5", "FERROR = 5\nBACKLASH = 0.02", "leave that on: the demand contains it"),
        ("FERROR = 5", "FERROR = 5\nMIN_FERROR = 0.1", "an offset is a following error to LinuxCNC"),
        ("[AXIS_X]", "[AXIS_X]\nOFFSET_AV_RATIO = 0.2", "do not use them while a correction is armed"),
        (
            "[JOINT_0]",
            "MAX_LIMIT=250\n[JOINT_0]\nMIN_LIMIT=-9\nMAX_LIMIT=300",
            "allows X -9 to 250 mm: do not exceed",
        ),
        ("HALFILE = drives.hal", "HALFILE = drives.tcl", "HALFILE drives.tcl was not read"),
        ("HALFILE = drives.hal", "HALFILE = lost.hal", "HALFILE lost.hal was not read (No such file or directory)"),
    ],
)
def test_settings_that_affect_fdhil_are_noted(old: str, new: str, words: str, tmp_path: Path) -> None:
    (note,) = read_machine(tmp_path, INI.replace(old, new)).notes
    assert words in note


CASE = """
[TRAJ]
COORDINATES=X Y Z
LINEAR_UNITS=mm
{traj}
[KINS]
KINEMATICS=trivkins coordinates=xyz
[AXIS_X]
{x}
MAX_VELOCITY=100
MAX_ACCELERATION=2000
[AXIS_Y]
{y}
MAX_VELOCITY=100
MAX_ACCELERATION=2000
[AXIS_Z]
MAX_VELOCITY=100
MAX_ACCELERATION=2000
[JOINT_0]
MAX_VELOCITY=100
[JOINT_1]
MAX_VELOCITY=100
[JOINT_2]
MAX_VELOCITY=100
"""


@pytest.mark.parametrize(
    ("traj", "x", "y", "limits"),
    [  # path speed, then speed and acceleration of X and Y in LinuxCNC 2.9 with these files
        ("MAX_LINEAR_VELOCITY=100", "", "", (100.0, 100.0, 2000.0, 100.0, 2000.0)),
        ("MAX_LINEAR_VELOCITY=100\nMAX_LINEAR_ACCELERATION=100", "", "", (100.0, 100.0, 2000.0, 100.0, 2000.0)),
        (
            "MAX_LINEAR_VELOCITY=1000",
            "OFFSET_AV_RATIO=0.2",
            "OFFSET_AV_RATIO=0.95",
            (1000.0, 80.0, 1600.0, 90.0, 1800.0),
        ),
        ("", "OFFSET_AV_RATIO=-0.5", "OFFSET_AV_RATIO=0.9", (None, 90.0, 1800.0, 10.0, 200.0)),
        ("MAX_VELOCITY=50", "[AXIS_W]", "", (None, 1.0, 1.0, 100.0, 2000.0)),
    ],
)
def test_limits_are_those_that_linuxcnc_keeps(
    traj: str, x: str, y: str, limits: tuple[float | None, ...], tmp_path: Path
) -> None:
    found = list_values(read_machine(tmp_path, CASE.format(traj=traj, x=x, y=y)))
    keys = ["nc.max_path_speed_mm_s"]
    keys += [f"axis.{axis}.{key}" for axis in "XY" for key in ("rapid_speed_mm_s", "max_acceleration_mm_s2")]
    assert [found.get(key) for key in keys] == pytest.approx(list(limits))


def test_trivkins_without_coordinates_numbers_its_joints_by_the_alphabet_of_axes(tmp_path: Path) -> None:
    found = read_machine(
        tmp_path, INI.replace("COORDINATES = X Y Z", "COORDINATES = Z X").replace("SCALE = -819.2", "")
    )
    assert found.axes == ("X", "Z")
    assert "axis.Y.rapid_speed_mm_s" not in list_values(found)
    assert list_values(found)["axis.Z.rapid_speed_mm_s"] == 100.0


def test_s_curve_planner_is_imported_with_its_jerk(tmp_path: Path) -> None:
    curved = INI.replace("COORDINATES", "PLANNER_TYPE = 1\nMAX_LINEAR_JERK = 9000\nCOORDINATES")
    found = list_values(read_machine(tmp_path, curved))
    assert found["nc.profile"] == "jerk_limited"
    assert [found[f"axis.{axis}.max_jerk_mm_s3"] for axis in "XYZ"] == [9000.0] * 3
    weak = list_values(read_machine(tmp_path, curved.replace("9000", "0.9")))
    assert weak["nc.profile"] == "linuxcnc"
    assert "axis.X.max_jerk_mm_s3" not in weak


ADDER = "loadrt sum2 names=sum2.y,sum2.x\nnet y-cmd joint.1.motor-pos-cmd => sum2.y.in0\n"
ADDER += "net more sum2.y.in1 sum2.x.in1\nnet y-sum sum2.y.out => limit.y.in\nnet y-lim limit.y.out => y-pid.command\n"
ADDER += "net x-sum sum2.x.out => x-pid.command\n"


@pytest.mark.parametrize(
    ("hal", "loop"),
    [
        ("loadrt pid names=x-pid,y-pid\nnet y joint.1.motor-pos-cmd => y-pid.command\n", "y-pid"),
        ('loadrt pid names="y.loop"\nnet y joint.1.motor-pos-cmd => y.loop.command\n', "y.loop"),
        ("loadrt pid count=2\nnet y joint.1.motor-pos-cmd => pid.1.command\n", "pid.1"),
        ("loadrt at_pid names=servo\nnet y joint.1.motor-pos-cmd => servo.command\n", "servo"),
        ("newinst pid y-loop\nnet y joint.1.motor-pos-cmd => y-loop.command\n", "y-loop"),
        ("loadrt pid names=x-pid,y-pid\n" + ADDER, "y-pid"),
    ],
)
def test_position_loop_is_found_under_any_name_and_through_components(hal: str, loop: str, tmp_path: Path) -> None:
    (note,) = read_machine(tmp_path, drives=HAL_TEXT + hal).notes
    assert note.startswith(f"axis Y: HAL's {loop} closes the position loop")


def test_loop_without_position_command_is_not_a_position_loop(tmp_path: Path) -> None:
    """A spindle's loop, and one that gets only the position."""
    hal = "loadrt pid names=spindle,other\nnet s motion.spindle-speed-out => spindle.command\n"
    hal += "net y joint.1.motor-pos-cmd => sum2.y.in0\nnet fb sum2.y.out => other.feedback\n"
    assert read_machine(tmp_path, drives=HAL_TEXT + hal).notes == []


def test_hal_position_loop_is_noted_with_gains(tmp_path: Path) -> None:
    loop = "net y joint.1.motor-pos-cmd => pid.y.command\nsetp pid.y.Pgain 40\nsetp pid.y.FF1 1\n"
    (note,) = read_machine(tmp_path, drives=HAL_TEXT + loop).notes
    assert "HAL's pid.y closes the position loop (Pgain 40, FF1 1)" in note
    assert "remove this loop" in note


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "TRAJ.COORDINATES: has no linear axis"),
        ("[AXIS_0]\nSCALE = 1", "is for LinuxCNC before 2.8"),
        (INI.replace("= mm", "= cubit"), "TRAJ.LINEAR_UNITS: is 'cubit'"),
        ("#INCLUDE lost.inc", r"lost.inc cannot be read: No such file"),
        ("#INCLUDE mill.ini", "include each other endlessly"),
    ],
)
def test_files_without_machine_are_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        read_machine(tmp_path, text)


def test_hal_links_are_parsed_in_every_notation() -> None:
    ini = parse_ini("[J]\nS = 5\nS = 6\n", lambda _name: "")
    hal = HalNetlist()
    more = "linksp sig here.in\n"
    text = "net sig a.out => b.in # c.in\nlinkps d.out => sig\nsetp b.scale [J](S)\nx.scale = [J]T\nsource more.hal\n"
    parse_hal(text, ini, {"more.hal": more}.__getitem__, hal)
    assert hal.find_linked_pins("a.out") == ["b.in", "d.out", "here.in"]
    assert hal.given == {"b.scale": "5", "x.scale": "[J]T"}


@given(st.lists(st.tuples(st.integers(0, len(INI)), st.text(max_size=12)), max_size=6), st.integers(1, 9))
@settings(max_examples=150, deadline=None)
def test_corrupted_files_are_read_or_refused(spoilt: list[tuple[int, str]], step: int) -> None:
    text = INI
    for place, put in spoilt:
        text = text[:place] + put + text[place + step :]
    hal = HalNetlist()
    ini = parse_ini(text, lambda _name: "")
    parse_hal(text + HAL_TEXT, ini, lambda _name: "", hal)
    with contextlib.suppress(ConfigError):
        found = build_machine(ini, hal, Path("mill.ini"))
        assert found.axes
        assert all(math.isfinite(scale.increments_per_unit) for scale in found.scales.values())


@pytest.mark.debian
def test_sample_machines_are_read_or_refused_by_name() -> None:
    read, refused = 0, list[str]()
    for path in sorted(SAMPLES.rglob("*.ini")):
        try:
            found = read_linuxcnc(path)
        except ConfigError as error:
            refused.append(str(error))
        else:
            read += 1
            assert found.axes
    assert read > 250
    named = ("COORDINATES", "before 2.8", "nosuchfile")  # robots, old files, and one with a missing include
    assert [text for text in refused if not any(word in text for word in named)] == []
