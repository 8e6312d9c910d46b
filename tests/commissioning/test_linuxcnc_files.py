"""What LinuxCNC's own INI and HAL files tell; with the package installed, all of its sample machines are read."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.commissioning.init.linuxcnc import Machine, machine_of, read_linuxcnc
from fdhil.commissioning.init.linuxcnc_text import Hal, parse_hal, parse_ini
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
MAX_VELOCITY = 450
MAX_ACCELERATION = 2000   # mm/s2
FERROR = 5
SCALE = 1000
[JOINT_1]
MAX_VELOCITY = 300
MAX_ACCELERATION = 1800
SCALE = -819.2
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


def machine(folder: Path, ini: str = INI, **files: str) -> Machine:
    (folder / "mill.ini").write_text(ini)
    for name, text in ({"drives": HAL_TEXT} | files).items():
        (folder / f"{name}.hal").write_text(text)
    return read_linuxcnc(folder / "mill.ini")


def told(found: Machine) -> dict[str, object]:
    return {path: each.value for path, each in found.told.items()}


def test_a_machine_is_read(tmp_path: Path) -> None:
    found = machine(tmp_path)
    assert found.axes == ("X", "Y", "Z")
    assert told(found) == {
        "machine.name": "Mill No 3",
        "machine.sync_period_s": 0.002,
        "nc.profile": "linuxcnc",
        "axis.X.rapid_speed_mm_s": 400.0,
        "axis.X.max_acceleration_mm_s2": 1500.0,
        "axis.X.drive.following_error_window_mm": 5.0,
        "axis.Y.rapid_speed_mm_s": 300.0,
        "axis.Y.max_acceleration_mm_s2": 1800.0,
        "axis.Z.rapid_speed_mm_s": 100.0,
    }
    assert {axis: (scale.increments_per_mm, scale.source) for axis, scale in found.scales.items()} == {
        "X": (1000.0, "LinuxCNC: cia402.0.pos-scale"),
        "Y": (-819.2, "LinuxCNC: [JOINT_1] SCALE"),
    }
    assert found.told["axis.X.rapid_speed_mm_s"].source == "LinuxCNC: [TRAJ] MAX_LINEAR_VELOCITY"
    assert found.notes == []


def test_inches_become_millimetres(tmp_path: Path) -> None:
    found = machine(tmp_path, INI.replace("LINEAR_UNITS = mm", "LINEAR_UNITS = inch"))
    assert told(found)["axis.Y.rapid_speed_mm_s"] == pytest.approx(7620.0)
    assert found.scales["Y"].increments_per_mm == pytest.approx(-819.2 / 25.4)
    assert told(machine(tmp_path, INI.replace("= mm", "= 1.0")))["axis.Y.rapid_speed_mm_s"] == 300.0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("COORDINATES = X Y Z", "COORDINATES = X Y Y", "axis Y has joint 2 besides joint 1 (a gantry)"),
        ("COORDINATES = X Y Z", "COORDINATES = X Y A", "axis A (joint 2) is rotary"),
        ("KINEMATICS = trivkins", "KINEMATICS = xyzac-trt-kins", "takes each joint for the axis of its place"),
        ("FERROR = 5", "FERROR = 5\nBACKLASH = 0.02", "leave that on: fdhil sees it in the demand"),
        ("FERROR = 5", "FERROR = 5\nMIN_FERROR = 0.1", "an offset is a following error to LinuxCNC"),
        ("[AXIS_X]", "[AXIS_X]\nOFFSET_AV_RATIO = 0.2", "keep them off while a correction is armed"),
        (
            "[JOINT_1]",
            "MIN_LIMIT=-9\nMAX_LIMIT=300\n[AXIS_X]\nMAX_LIMIT=250\n[JOINT_1]",
            "lets go X -9 to 250 mm: give",
        ),
        ("HALFILE = drives.hal", "HALFILE = drives.tcl", "HALFILE drives.tcl was not read"),
        ("HALFILE = drives.hal", "HALFILE = lost.hal", "HALFILE lost.hal was not read (No such file or directory)"),
    ],
)
def test_what_matters_beside_fdhil_is_noted(old: str, new: str, words: str, tmp_path: Path) -> None:
    (note,) = machine(tmp_path, INI.replace(old, new)).notes
    assert words in note


def test_a_position_loop_in_hal_is_noted_with_its_gains(tmp_path: Path) -> None:
    loop = "net y joint.1.motor-pos-cmd => pid.y.command\nsetp pid.y.Pgain 40\nsetp pid.y.FF1 1\n"
    (note,) = machine(tmp_path, drives=HAL_TEXT + loop).notes
    assert "HAL's pid.y closes the position loop (Pgain 40, FF1 1)" in note
    assert "switch this loop off" in note


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "TRAJ.COORDINATES: names no linear axis"),
        ("[AXIS_0]\nSCALE = 1", "is of a LinuxCNC before 2.8"),
        (INI.replace("= mm", "= cubit"), "TRAJ.LINEAR_UNITS: is 'cubit'"),
        ("#INCLUDE lost.inc", r"lost.inc cannot be read: No such file"),
        ("#INCLUDE mill.ini", "include each other without end"),
    ],
)
def test_files_that_tell_no_machine_are_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        machine(tmp_path, text)


def test_hal_joins_pins_through_every_way_of_writing() -> None:
    ini = parse_ini("[J]\nS = 5\nS = 6\n", lambda _name: "")
    hal = Hal()
    more = "linksp sig here.in\n"
    text = "net sig a.out => b.in # c.in\nlinkps d.out => sig\nsetp b.scale [J](S)\nx.scale = [J]T\nsource more.hal\n"
    parse_hal(text, ini, {"more.hal": more}.__getitem__, hal)
    assert hal.joined("a.out") == ["b.in", "d.out", "here.in"]
    assert hal.given == {"b.scale": "5", "x.scale": "[J]T"}


@given(st.lists(st.tuples(st.integers(0, len(INI)), st.text(max_size=12)), max_size=6), st.integers(1, 9))
@settings(max_examples=150, deadline=None)
def test_spoilt_files_are_read_or_refused(spoilt: list[tuple[int, str]], step: int) -> None:
    text = INI
    for place, put in spoilt:
        text = text[:place] + put + text[place + step :]
    hal = Hal()
    ini = parse_ini(text, lambda _name: "")
    parse_hal(text + HAL_TEXT, ini, lambda _name: "", hal)
    with contextlib.suppress(ConfigError):
        found = machine_of(ini, hal, Path("mill.ini"))
        assert found.axes
        assert all(math.isfinite(scale.increments_per_mm) for scale in found.scales.values())


@pytest.mark.debian
def test_all_sample_machines_of_the_package_are_read_or_refused_by_name() -> None:
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
    named = ("COORDINATES", "before 2.8", "nosuchfile")  # robots, old files, and one that includes what is not there
    assert [text for text in refused if not any(word in text for word in named)] == []
