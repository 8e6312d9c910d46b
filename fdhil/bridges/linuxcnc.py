#!/usr/bin/python3
"""Publishes LinuxCNC's state, exact to a servo cycle, as JSON lines over TCP. It changes nothing in LinuxCNC.

LinuxCNC's own Python runs it, loaded by the last line of the HAL file that has the joints and the motion controller
(``python -m fdhil.bridges`` prints the line):

    loadusr -Wn fdhil-bridge /usr/bin/python3 /path/to/linuxcnc.py

It loads HAL's ``sampler`` after the motion controller and samples the joints' set-points, the kind of the motion, its
line and speed. Overrides, pause, tool and program come from LinuxCNC's status. Where it cannot work it reports the
reason, and LinuxCNC starts without it. Standard library and LinuxCNC's own modules only.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

SCHEMA = "fdhil-linuxcnc-1"
NAME = "fdhil-bridge"
KINDS = {0: "rest", 1: "rapid", 2: "feed", 3: "arc", 5: "feed"}  # motion.motion-type; 5 probes, others are unknown
LOOK_S = 0.005
STATUS_S = 0.02
MOVING_CYCLES, RESTING_CYCLES = 10, 200  # between states while nothing changes
STAMP_ERROR_NS = 2_000_000
FORGET = 0.02  # share of a late cycle forgotten per poll: two clocks drift apart
DEPTH = 8192
SEEN_READY_S = 1.0  # until halcmd has seen the bridge ready; it would end LinuxCNC otherwise
MOST_WAITING = 1 << 20  # unsent bytes per listener
MOST_LISTENERS = 32
VALUES = (
    ("motion.motion-type", "s"),
    ("motion.program-line", "s"),
    ("motion.current-vel", "f"),
    ("motion.requested-vel", "f"),
)
HOLDS = ("motion.feed-hold", "motion.feed-inhibit")  # sampled where HAL has linked them


class Status(NamedTuple):
    """LinuxCNC's status; None is what it does not report."""

    feed_override: float | None = None
    rapid_override: float | None = None
    paused: bool = False
    tool: int | None = None
    program: str | None = None


class Cycle(NamedTuple):
    """One servo cycle: the joints' set-points (machine units), and the motion controller's outputs."""

    number: int
    joints: tuple[float, ...]
    motion_type: int
    line: int
    speed: float
    programmed: float
    held: bool


class StatePublisher:
    """Selects the states to publish: each change with the cycle before it, and a few in between. Pure."""

    def __init__(self, axes: Sequence[str], mm_per_unit: float, period_ns: int) -> None:
        self._axes = axes
        self._mm = mm_per_unit
        self._period_ns = period_ns
        self._zero_ns: float | None = None  # time of cycle 0
        self._last: dict[str, Any] | None = None
        self._mark: Any = None
        self._published = -RESTING_CYCLES
        self._joints: tuple[float, ...] = ()

    def update_clock(self, number: int, now_ns: int) -> None:
        """Update the clock: cycle ``number`` was the newest at ``now_ns``; no cycle is later than its reception."""
        zero_ns = float(now_ns - number * self._period_ns)
        if self._zero_ns is None or zero_ns < self._zero_ns:
            self._zero_ns = zero_ns
        else:
            self._zero_ns += FORGET * min(zero_ns - self._zero_ns, STAMP_ERROR_NS)

    def select_states(self, cycle: Cycle, status: Status) -> list[dict[str, Any]]:
        """Return the states to publish at this cycle, the oldest first."""
        still = cycle.joints == self._joints
        self._joints = cycle.joints
        held = cycle.held or status.paused
        motion = "hold" if held and still else KINDS.get(cycle.motion_type, "unknown")
        mark = (motion, cycle.line, held, *status)
        state = self._build_state(cycle, motion, held, status)
        before, self._last = self._last, state
        states: list[dict[str, Any]] = []
        if mark != self._mark:
            if before is not None and self._published < cycle.number - 1:
                states.append(before)
            states.append(state)
        elif cycle.number - self._published >= (RESTING_CYCLES if still else MOVING_CYCLES):
            states.append(state)
        if states:
            self._published, self._mark = cycle.number, mark
        return states

    def _build_state(self, cycle: Cycle, motion: str, held: bool, status: Status) -> dict[str, Any]:
        assert self._zero_ns is not None
        places: dict[str, float] = {}
        for joint, axis in enumerate(self._axes):
            # the first of two joints of an axis; degrees for A, B and C
            places.setdefault(axis, cycle.joints[joint] * (1.0 if axis in "ABC" else self._mm))
        return {
            "cycle": cycle.number,
            "stamp_ns": round(self._zero_ns + cycle.number * self._period_ns),
            "error_ns": STAMP_ERROR_NS,
            "motion": motion,
            "line": cycle.line or None,
            "feed_mm_min": round(cycle.speed * self._mm * 60, 4),
            "programmed_feed_mm_min": round(cycle.programmed * self._mm * 60, 4),
            "feed_override": status.feed_override,
            "rapid_override": status.rapid_override,
            "feed_hold": held,
            "tool": status.tool,
            "program": status.program,
            "mm": places,
        }


class TcpBroadcast:
    """Sends lines to all TCP clients; drops one that does not keep up. Their input is ignored."""

    def __init__(self, host: str, port: int, greeting: bytes) -> None:
        self._socket = socket.create_server((host, port))
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]
        self._greeting = greeting
        self._waiting: dict[socket.socket, bytearray] = {}

    def send_lines(self, lines: bytes) -> None:
        """Accept new clients, and send the lines to all as far as they take them."""
        self._accept_listeners()
        for listener, waiting in list(self._waiting.items()):
            waiting += lines
            try:
                while waiting:
                    del waiting[: listener.send(waiting[: 1 << 16])]
            except BlockingIOError:
                if len(waiting) <= MOST_WAITING:
                    continue
                self._drop_listener(listener)
            except OSError:
                self._drop_listener(listener)

    def close(self) -> None:
        """Close all connections."""
        for listener in list(self._waiting):
            self._drop_listener(listener)
        self._socket.close()

    def _accept_listeners(self) -> None:
        while True:
            try:
                listener, _ = self._socket.accept()
            except OSError:  # no client is waiting
                return
            listener.setblocking(False)
            if len(self._waiting) >= MOST_LISTENERS:  # the slowest makes room, or the oldest
                self._drop_listener(max(self._waiting, key=lambda each: len(self._waiting[each])))
            self._waiting[listener] = bytearray(self._greeting)

    def _drop_listener(self, listener: socket.socket) -> None:
        del self._waiting[listener]
        listener.close()


class HalSampler:
    """HAL's sampler after the motion controller: every servo cycle once."""

    def __init__(self, hal: Any, component: Any, joints: int, channel: int, thread: str) -> None:
        pins = [(f"joint.{joint}.motor-pos-cmd", "f") for joint in range(joints)] + list(VALUES)
        pins += [(pin, "b") for pin in HOLDS if _find_signal(pin)]
        self._joints = joints
        kinds = "".join(kind for _, kind in pins)
        if not hal.component_exists("sampler"):
            _run_halcmd("loadrt", "sampler", f"depth={DEPTH}", f"cfg={kinds}")
        for k, (pin, _) in enumerate(pins):
            signal_name = _find_signal(pin) or f"fdhil-{pin.replace('.', '-')}"
            _run_halcmd("net", signal_name, pin, "=>", f"sampler.{channel}.pin.{k}")
        _run_halcmd("addf", f"sampler.{channel}", thread)
        self._stream = hal.stream(component, hal.sampler_base + channel, kinds)

    def read_cycles(self) -> Iterator[Cycle]:
        """Yield the cycles since the last call."""
        while self._stream.readable:
            row = self._stream.read()
            if row is None:
                return
            joints, rest = tuple(row[: self._joints]), row[self._joints :]
            yield Cycle(self._stream.sampleno, joints, rest[0], rest[1], rest[2], rest[3], any(rest[4:]))


def _run_halcmd(*words: str) -> str:
    done = subprocess.run(["halcmd", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"halcmd {' '.join(words)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


def _find_signal(pin: str) -> str:
    words = _run_halcmd("-s", "show", "pin", pin).split()
    arrows = [k for k, word in enumerate(words) if word in ("==>", "<==", "<=>")]
    return words[arrows[0] + 1] if arrows else ""


class StatusReader:
    """LinuxCNC's status, polled periodically; it starts later than the bridge."""

    def __init__(self, linuxcnc: Any) -> None:
        self._linuxcnc = linuxcnc
        self._stat: Any = None
        self._due_s = 0.0
        self.now = Status()

    def poll_status(self) -> None:
        """Poll when it is due."""
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + STATUS_S
        try:
            if self._stat is None:
                self._stat = self._linuxcnc.stat()
            self._stat.poll()
        except self._linuxcnc.error:
            self._stat, self.now = None, Status()
            return
        s = self._stat
        if not s.task_state:  # nothing was written there yet
            return
        self.now = Status(
            round(s.feedrate, 4), round(s.rapidrate, 4), bool(s.paused), s.tool_in_spindle, s.file or None
        )


def read_machine(linuxcnc: Any, path: str) -> tuple[list[str], float, int]:
    """Return the axis of each joint, millimetres per unit and the servo period (ns) from LinuxCNC's INI file."""
    ini = linuxcnc.ini(path)
    letters = [c for c in (ini.find("TRAJ", "COORDINATES") or "XYZ").upper() if c.isalpha()]
    kinematics = (ini.find("KINS", "KINEMATICS") or "").split()
    named = [word.split("=")[1].upper() for word in kinematics if word.lower().startswith("coordinates=")]
    axes = [c for c in named[0] if c.isalpha()] if named else letters
    joints = int(ini.find("KINS", "JOINTS") or len(axes))
    units = (ini.find("TRAJ", "LINEAR_UNITS") or "mm").lower()
    mm = 25.4 if units in ("in", "inch", "imperial") else 1.0
    return axes[:joints], mm, int(float(ini.find("EMCMOT", "SERVO_PERIOD") or 1_000_000))


def serve_states(options: argparse.Namespace, hal: Any, linuxcnc: Any, component: Any) -> NoReturn:
    """Set up and publish until the process ends."""
    axes, mm, period_ns = read_machine(linuxcnc, options.ini)
    axes = list(options.axes.upper()) if options.axes else axes
    greeting = {"schema": SCHEMA, "axes": axes, "servo_period_s": period_ns * 1e-9}
    listeners = TcpBroadcast(options.host, options.port, _encode_line(greeting))
    tap = HalSampler(hal, component, len(axes), options.channel, options.thread)
    publisher, status = StatePublisher(axes, mm, period_ns), StatusReader(linuxcnc)
    component.ready()
    _log_line(f"publishes LinuxCNC's state at {options.host}:{listeners.port}")
    while True:
        status.poll_status()
        cycles = list(tap.read_cycles())
        if cycles:
            publisher.update_clock(cycles[-1].number, time.monotonic_ns())
        listeners.send_lines(
            b"".join(_encode_line(state) for cycle in cycles for state in publisher.select_states(cycle, status.now))
        )
        time.sleep(LOOK_S)


def _log_line(text: str) -> None:
    sys.stderr.write(f"{NAME}: {text}\n")


def _encode_line(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode() + b"\n"


def _parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Publishes LinuxCNC's state to fdhil; loaded by LinuxCNC's HAL file.")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at; 0.0.0.0: also for other computers")
    parser.add_argument("--port", type=int, default=5571, help="TCP port, as in [nc_source.linuxcnc]")
    parser.add_argument("--axes", help="the axis of each joint, as XYYZ; left out: as the INI file says")
    parser.add_argument("--channel", type=int, default=0, help="sampler channel, where HAL has loaded sampler already")
    parser.add_argument("--thread", default="servo-thread", help="the thread of the motion controller")
    parser.add_argument("--ini", default=os.environ.get("INI_FILE_NAME"), help="LinuxCNC's INI file")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until LinuxCNC ends; report errors without keeping LinuxCNC from starting."""
    options = _parse_options(arguments)
    here = Path(__file__).resolve().parent
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != here]  # it has a linuxcnc.py
    # LinuxCNC's own modules, absent in tests
    import hal  # type: ignore[import-not-found]
    import linuxcnc  # type: ignore[import-not-found]

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    component = hal.component(NAME)
    try:
        serve_states(options, hal, linuxcnc, component)
    except KeyboardInterrupt:
        return 0
    except Exception as error:  # noqa: BLE001 - an error here must not end LinuxCNC
        _log_line(f"fdhil receives nothing ({error}); LinuxCNC starts without it")
        component.ready()
        time.sleep(SEEN_READY_S)
        return 0
    finally:
        component.exit()


if __name__ == "__main__":
    sys.exit(main())
