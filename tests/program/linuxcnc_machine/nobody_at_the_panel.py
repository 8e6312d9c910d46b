#!/usr/bin/python3
"""The operator of a LinuxCNC machine without a screen: homes the joints, runs PROGRAM to its end, then leaves.

LinuxCNC starts this in place of its display, with the system's Python. The demand goes to DEMAND meanwhile.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import linuxcnc  # type: ignore[import-not-found]  # the package's own module, for the system's Python alone

JOINTS = int(os.environ["JOINTS"])
LIMIT_S = float(os.environ["LIMIT_S"])


def order(command: Any, what: Callable[..., None], *arguments: Any) -> None:
    """Give an order and wait until it is done."""
    what(*arguments)
    if command.wait_complete(15.0) in (-1, linuxcnc.RCS_ERROR):
        sys.exit(f"{what.__name__}{arguments} was not done")


def wait_for(status: Any, ready: Callable[[], bool]) -> None:
    """Poll until something is so; exit 1 when it takes too long."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        with contextlib.suppress(linuxcnc.error):  # the status may be locked for longer than it waits
            status.poll()
            if ready():
                return
        time.sleep(0.005)
    sys.exit("the machine did not get there in time")


def prepare(command: Any, status: Any) -> None:
    """Switch the machine on and home it where it stands."""
    order(command, command.state, linuxcnc.STATE_ESTOP_RESET)
    order(command, command.state, linuxcnc.STATE_ON)
    order(command, command.mode, linuxcnc.MODE_MANUAL)
    for joint in range(JOINTS):
        command.home(joint)
    wait_for(status, lambda: all(status.homed[:JOINTS]))
    order(command, command.mode, linuxcnc.MODE_AUTO)


def main() -> None:
    """Run the program of the environment and record every servo cycle of it."""
    command, status = linuxcnc.command(), linuxcnc.stat()
    prepare(command, status)
    wait_for(status, lambda: True)
    begin = tuple(status.position)
    with Path(os.environ["DEMAND"]).open("w") as out:
        recorder = subprocess.Popen(["halsampler", "-t"], stdout=out)
        time.sleep(0.3)
        command.program_open(os.environ["PROGRAM"])
        command.auto(linuxcnc.AUTO_RUN, 0)
        # a short program may be over before a busy computer looks
        wait_for(status, lambda: status.interp_state != linuxcnc.INTERP_IDLE or tuple(status.position) != begin)
        wait_for(status, lambda: status.interp_state == linuxcnc.INTERP_IDLE and bool(status.inpos))
        time.sleep(1.0)  # by which the recorder may be behind
        recorder.terminate()
        recorder.wait()


main()
