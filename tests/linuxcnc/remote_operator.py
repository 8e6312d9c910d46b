#!/usr/bin/python3
"""The operator of a headless LinuxCNC machine: switches it on, homes it, and executes orders received by TCP.

LinuxCNC starts this in place of its display, with the system's Python; it ends with the connection, and LinuxCNC with
it. Orders and answers are lines of JSON: ``{"order": "run", "program": "/a/part.ngc"}`` gives ``{"done": "run"}`` or
``{"failed": ...}`` in LinuxCNC's own words.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

import linuxcnc  # type: ignore[import-not-found]  # the package's own module, for the system's Python alone

AXES = os.environ["AXES"]
JOINTS = len(AXES)
PATIENCE_S = 300.0
LOOK_S = 1.0
# a program may have changed these; the axes return to zero
ZERO = " ".join(f"{axis}0" for axis in AXES)
POWER_UP = ["M64 P0", "G54 G92.1 G49 G40 G80 G8", *(f"G10 L2 P{system} {ZERO} R0" for system in range(1, 10))]
POWER_UP += [f"G53 G0 {ZERO}", "G64 G17 G21 G90 G91.1 G94 G97 G98", "M5 M9 M48", "M65 P0"]


class OrderFailed(Exception):
    """LinuxCNC did not execute the order."""


class Operator:
    """Gives orders and waits, by LinuxCNC's status only, until they are done."""

    def __init__(self, wire: socket.socket) -> None:
        self._wire = wire
        self.command, self.status, self.errors = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()
        self._said: list[str] = []

    def send_order(self, what: Callable[..., None], *arguments: Any) -> None:
        what(*arguments)
        end = time.monotonic() + PATIENCE_S
        while (result := self.command.wait_complete(LOOK_S)) == -1 and time.monotonic() < end:
            self._leave_when_alone()
        if result in (-1, linuxcnc.RCS_ERROR):
            raise OrderFailed(f"{what.__name__}{arguments} was not done; {self._read_errors()}")

    def wait_until(self, ready: Callable[[Any], bool]) -> None:
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            with contextlib.suppress(
                linuxcnc.error
            ):  # on a busy host the status may be locked for longer than the wait
                self.status.poll()
                if ready(self.status):
                    return
            self._leave_when_alone()
            time.sleep(0.005)
        now = self.status
        state = f"interpreter {now.interp_state}, task {now.exec_state}, queue {now.queue}, paused {now.paused}"
        raise OrderFailed(f"the machine did not get there ({state}); {self._read_errors()}")

    def _leave_when_alone(self) -> None:
        """End, together with LinuxCNC, when the client has ended."""
        with contextlib.suppress(BlockingIOError):
            if not self._wire.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT):
                sys.exit(1)

    def _has_failed(self) -> bool:
        while (error := self.errors.poll()) is not None:
            self._said.append(str(error[1]).strip())
        return bool(self._said)

    def _read_errors(self) -> str:
        text = "; ".join(self._said) if self._has_failed() else "nothing"
        self._said.clear()
        return f"LinuxCNC says: {text}"

    def prepare_machine(self) -> None:
        """Switch the machine on and home it at its position."""
        self.send_order(self.command.state, linuxcnc.STATE_ESTOP_RESET)
        self.send_order(self.command.state, linuxcnc.STATE_ON)
        self.send_order(self.command.mode, linuxcnc.MODE_MANUAL)
        for joint in range(JOINTS):
            self.command.home(joint)
        self.wait_until(lambda status: all(status.homed[:JOINTS]))
        self.send_order(self.command.mode, linuxcnc.MODE_AUTO)

    def reset_machine(self) -> None:
        """Move the machine to zero, and the interpreter to its state after power-up."""
        self.enter_blocks(*POWER_UP)

    def enter_blocks(self, *blocks: str) -> None:
        self.send_order(self.command.mode, linuxcnc.MODE_MDI)
        for block in blocks:
            self.send_order(self.command.mdi, block)
        self.send_order(self.command.mode, linuxcnc.MODE_AUTO)
        if self._has_failed():
            raise OrderFailed(self._read_errors())

    def run_program(self, program: str) -> None:
        """Start a program from its first line; return when it runs, or has ended."""
        self.send_order(self.command.program_open, program)
        self.command.auto(linuxcnc.AUTO_RUN, 0)  # completed with the program
        self.wait_until(lambda status: status.interp_state != linuxcnc.INTERP_IDLE or self._is_complete(status))

    def _is_complete(self, status: Any) -> bool:
        """Return whether LinuxCNC has completed the last order, or failed."""
        return bool(status.echo_serial_number == self.command.serial and status.state != linuxcnc.RCS_EXEC)

    def wait_for_rest(self) -> None:
        """Wait until the program has ended and the machine is at standstill."""
        self.wait_until(lambda status: status.interp_state == linuxcnc.INTERP_IDLE and bool(status.inpos))
        if self._has_failed():
            raise OrderFailed(self._read_errors())

    def execute_order(self, order: dict[str, Any]) -> None:
        match order["order"]:
            case "run":
                self.run_program(order["program"])
            case "reset":
                self.reset_machine()
            case "mark":
                self.enter_blocks("M64 P0")
            case "rest":
                self.wait_for_rest()
            case "override":
                self.command.feedrate(order["value"])  # done at once, but complete only with the running program
                self.wait_until(lambda status: abs(status.feedrate - order["value"]) < 1e-6)
            case "rapid_override":
                self.command.rapidrate(order["value"])
                self.wait_until(lambda status: abs(status.rapidrate - order["value"]) < 1e-6)
            case "pause":
                self.command.auto(linuxcnc.AUTO_PAUSE)
            case "resume":
                self.command.auto(linuxcnc.AUTO_RESUME)
            case "abort":
                self.command.abort()
            case "estop":
                self.send_order(self.command.state, linuxcnc.STATE_ESTOP)
            case other:
                raise OrderFailed(f"nobody knows the order {other!r}")


def main() -> None:
    """Serve the process that started LinuxCNC."""
    with (
        socket.create_connection(("127.0.0.1", int(os.environ["OPERATOR_PORT"]))) as wire,
        wire.makefile("rw") as lines,
    ):

        def send_answer(**what: Any) -> None:
            lines.write(json.dumps(what) + "\n")
            lines.flush()

        try:
            operator = Operator(wire)
            operator.prepare_machine()
            send_answer(done="prepare")
        except (OrderFailed, linuxcnc.error) as error:
            send_answer(failed=str(error))
            sys.exit(1)
        for line in lines:
            order = json.loads(line)
            try:
                operator.execute_order(order)
                send_answer(done=order["order"])
            except (OrderFailed, linuxcnc.error) as error:
                send_answer(failed=str(error))


main()
