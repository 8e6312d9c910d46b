"""LinuxCNC as a whole, headless: the demand that its trajectory planner orders each millisecond for a program."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from fdhil.records import Float

HERE = Path(__file__).parent
NOBODY = 65534
AXIS = """
[AXIS_{letter}]
MAX_VELOCITY = {speed}
MAX_ACCELERATION = {acceleration}
MIN_LIMIT = -1000
MAX_LIMIT = 1000
[JOINT_{number}]
TYPE = {kind}
HOME = 0
HOME_SEARCH_VEL = 0
HOME_LATCH_VEL = 0
MAX_VELOCITY = {speed}
MAX_ACCELERATION = {acceleration}
MIN_LIMIT = -1000
MAX_LIMIT = 1000
FERROR = 10
MIN_FERROR = 10
"""
MACHINE = """
[EMC]
VERSION = 1.1
MACHINE = bench
[DISPLAY]
DISPLAY = {folder}/nobody_at_the_panel.py
PROGRAM_PREFIX = {folder}
[TASK]
TASK = milltask
CYCLE_TIME = 0.001
[RS274NGC]
PARAMETER_FILE = {folder}/machine.var
[EMCMOT]
EMCMOT = motmod
COMM_TIMEOUT = 1.0
SERVO_PERIOD = 1000000
[EMCIO]
EMCIO = io
CYCLE_TIME = 0.1
TOOL_TABLE = {folder}/machine.tbl
[HAL]
HALFILE = machine.hal
[KINS]
KINEMATICS = trivkins coordinates={axes}
JOINTS = {joints}
[TRAJ]
COORDINATES = {axes}
LINEAR_UNITS = mm
ANGULAR_UNITS = degree
NO_FORCE_HOMING = 1
DEFAULT_LINEAR_VELOCITY = {speed}
MAX_LINEAR_VELOCITY = 2000
DEFAULT_LINEAR_ACCELERATION = {acceleration}
DEFAULT_ANGULAR_VELOCITY = {speed}
MAX_ANGULAR_VELOCITY = 2000
MAX_LINEAR_ACCELERATION = {acceleration}
"""


def demand(
    program: str,
    speed_mm_s: float = 500.0,
    acceleration_mm_s2: float = 2000.0,
    axes: str = "XYZ",
    limit_s: float = 60.0,
) -> Float:
    """Return the commanded ``axes`` (n, 3), mm or degrees, of each servo cycle of a program while it moves.

    AssertionError with LinuxCNC's own words when it did not run, or a cycle was not recorded.
    """
    with tempfile.TemporaryDirectory(prefix="fdhil-linuxcnc-") as name:
        folder = Path(name)
        _write(folder, program, speed_mm_s, acceleration_mm_s2, axes)
        command = ["linuxcnc", str(folder / "machine.ini")]
        if os.geteuid() == 0:  # it refuses to run as root
            for path in (folder, *folder.iterdir()):
                os.chown(path, NOBODY, NOBODY)
            command = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", *command]
        environment = os.environ | {
            "HOME": name, "PROGRAM": str(folder / "program.ngc"), "DEMAND": str(folder / "demand.txt"),
            "JOINTS": str(len(axes)), "LIMIT_S": str(limit_s),
        }  # fmt: skip
        environment.pop("DISPLAY", None)
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
        )
        recorded = folder / "demand.txt"
        assert recorded.exists(), f"LinuxCNC did not run:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        lines = [line.split() for line in recorded.read_text().splitlines()]
        assert not any("overrun" in line for line in lines), "the sampler lost cycles; the computer is overloaded"
    table = np.array([[float(word) for word in line] for line in lines if len(line) == 4])
    assert (np.diff(table[:, 0]) == 1).all(), "a cycle is missing in the recorded demand"
    moving = np.flatnonzero(np.abs(np.diff(table[:, 1:], axis=0)).max(axis=1) > 0.0)
    assert moving.size, f"nothing moved:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return np.asarray(table[moving[0] : moving[-1] + 2, 1:])


def _write(folder: Path, program: str, speed_mm_s: float, acceleration_mm_s2: float, axes: str) -> None:
    for file in ("nobody_at_the_panel.py", "machine.hal"):
        shutil.copy(HERE / file, folder)
    (folder / "nobody_at_the_panel.py").chmod(0o755)
    hal = folder / "machine.hal"
    hal.write_text(hal.read_text().replace("=xyz", f"={axes}").replace("num_joints=3", f"num_joints={len(axes)}"))
    ini = MACHINE.format(folder=folder, speed=speed_mm_s, acceleration=acceleration_mm_s2, axes=axes, joints=len(axes))
    ini += "".join(
        AXIS.format(
            letter=letter,
            number=number,
            speed=speed_mm_s,
            acceleration=acceleration_mm_s2,
            kind="ANGULAR" if letter in "ABC" else "LINEAR",
        )
        for number, letter in enumerate(axes)
    )
    (folder / "machine.ini").write_text(ini)
    (folder / "machine.tbl").touch()
    (folder / "machine.var").touch()
    (folder / "program.ngc").write_text(program)
