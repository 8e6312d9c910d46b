"""A guard, a daemon and the simulated machine as they run, one SYNC at a time, and the trace of the bus between them.

The guard is the product's process on a hub or a CAN interface, the daemon a process of its own that holds the product's
client of the guard. The machine, its NC and the bus trace are here, so that a fault falls between two SYNC on purpose
and "SYNC until" is counted exactly. While the guard sends, the next SYNC waits for its frames, as the twin's lockstep
does.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fdhil import config as machine_config
from fdhil.arming.guard_client import GuardClient
from fdhil.arming.guard_configuration import make_guard_settings
from fdhil.config import MachineConfig
from fdhil.guard.guard_settings import GuardSettings, encode_settings
from fdhil.guard.transmit_socket import greet_hub, open_transmit_socket
from fdhil.records import Float, Trajectory
from fdhil.sim.frame_types import Frame
from fdhil.sim.simulated_machine import SimulatedMachine
from fdhil.sim.wire.can_buses import attach_bus
from tests.bench import bench_document
from tests.guard.frame_checks import Wire
from tests.guard.simulated_bus import FACTS_GIVEN, commissioned

AXES = "XY"
TOKEN = "the operator's"
DIGEST = "program-1"
ROWS, RESTING = 280, 20
WAYS_MM = (8.0, 3.0)
PERIOD_S = 0.001
IDLE_S = {"socketcand": 0.005, "socketcan": 0.02}
ADOPTING = 150  # SYNC after a guard's start, until it has looked at what the drives hold and sends, or sends nothing
ALIVE_S = 0.5  # on a busy host SYNC is slower than the clock; more often, and words would wait in front of the end
PATIENCE_S = 300.0
QUIET_S = {"socketcand": 0.02, "socketcan": 0.3}  # a kernel with CAN is often an emulated machine
TRIES = 20
LATE_S = 9.0  # less than the ten seconds after which the guard takes the bus for dead
Tamper = Callable[[int, Frame], list[Frame]]
Column = list[int]


def make_wave(rng: np.random.Generator, limit: int) -> tuple[Float, list[Column]]:
    """Return the way (0 to 1) and the offsets (increments) of a program: each axis its own height and waves.

    An offset's wave is at most as steep as a third of the rate allowed, so that it turns round in four SYNC, and three
    programs in a second do not travel more than allowed.
    """
    part = np.clip((np.arange(ROWS) - RESTING) / (ROWS - 2 * RESTING), 0.0, 1.0)
    smooth = part**3 * (10 - 15 * part + 6 * part**2)
    offsets = []
    for _ in AXES:
        turns = int(rng.integers(1, 3))
        height = int(rng.integers(limit // 4, limit)) // turns
        column = rng.choice((-1, 1)) * height * 0.5 * (1 - np.cos(2 * math.pi * turns * part))
        offsets.append(np.rint(column).astype(int).tolist())
    return smooth, offsets


class Daemon:
    """A forked process that loads the table, arms and sends its heartbeat, until it is killed or the study ends."""

    def __init__(self, folder: Path, demand: list[Column], offsets: list[Column]) -> None:
        self._told, telling = os.pipe()
        hearing, self._orders = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            _become_daemon(folder, demand, offsets, telling, hearing)
        os.close(telling)
        os.close(hearing)
        self.armed = False

    def fileno(self) -> int:
        """Return the pipe on which it reports that it has armed."""
        return self._told

    def receive_report(self, word: bytes = b"armed") -> bool:
        """Receive its report; it has armed when it reports so. RuntimeError for any other report."""
        text = os.read(self._told, 4096)
        if text != word:
            raise RuntimeError(f"the daemon: {text.decode() or 'has ended'}")
        self.armed = True
        return True

    def send_request(self, word: bytes) -> None:
        """Have it ask the guard for something: ``disarm``, or the name of a fact that it no longer vouches for.

        Returns when the guard's socket holds it: until then no SYNC passes, however late the daemon gets the processor.
        """
        os.write(self._orders, word)
        self.receive_report(b"asked")

    def kill(self) -> None:
        """Kill it, and return when it is dead."""
        if self.pid:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
            self.pid = 0
            os.close(self._told)
            os.close(self._orders)


def _become_daemon(folder: Path, demand: list[Column], offsets: list[Column], telling: int, hearing: int) -> None:
    """Never returns."""
    try:
        os.dup2(telling, 3, inheritable=False)
        os.dup2(hearing, 4, inheritable=False)
        os.closerange(5, 1024)
        _serve(folder, demand, offsets)
    except BaseException as error:  # noqa: BLE001 - a fork must not run the study's code a second time
        os.write(3, repr(error).encode())
    finally:
        os._exit(0)


def _serve(folder: Path, demand: list[Column], offsets: list[Column]) -> None:
    client = GuardClient(folder, timeout_s=PATIENCE_S)
    ways, corrections = (dict(zip(AXES, rows, strict=True)) for rows in (demand, offsets))
    while not client.load_table(AXES, ways, corrections, DIGEST)["ok"]:
        time.sleep(0.01)
    while not client.arm(TOKEN, DIGEST, FACTS_GIVEN)["ok"]:
        time.sleep(0.01)
    os.write(3, b"armed")
    while True:
        client.send_alive()
        if select.select([4], (), (), ALIVE_S)[0]:
            word = os.read(4, 64).decode()
            if not word:
                return
            if word == "disarm":
                client._send_message({"request": "disarm"})  # its answer comes with the next SYNC
            else:
                client.send_alive({word: False})
            os.write(3, b"asked")


class LiveGuard:
    """``cycle`` is one SYNC; ``offsets`` the last value on the wire of each axis, ``wrong`` what broke a limit.

    ``stops`` are cycles that the guard missed: the offset stood for one.
    ``sent`` counts the frames with one of the guard's COB-IDs, ``trace`` has (SYNC, offsets) since it was emptied.
    ``waits`` False: the next SYNC does not wait for the guard, whatever it did at the last.
    ``tamper`` makes what the guard hears of each frame, with the number of SYNC since it was set.
    """

    def __init__(self, folder: Path, seed: int = 1, interface: str = "socketcand") -> None:
        self.folder, self.rng = folder, np.random.default_rng(seed)
        self._quiet_s, self._idle_s = QUIET_S[interface], IDLE_S[interface]
        bus = {"interface": interface} | ({"channel": "vcan0"} if interface == "socketcan" else {})
        document = bench_document(AXES) | {
            "sim": {"pace": "lockstep", "modbus": False, "seed": seed},
            "guard": {"clock": "sync"},
            "bus": {"can0": bus},
        }
        self.config: MachineConfig = machine_config.parse_config(document, folder=folder)
        self.machine = SimulatedMachine(self.config)
        self._bus = attach_bus("can0", self.config.bus["can0"])
        place = {key: value for key, value in self._bus.settings.items() if key in ("port", "host")}
        self._place = self.config.bus["can0"].model_copy(update=place)
        made = make_guard_settings(self.config, "can0", folder, hashlib.sha256(TOKEN.encode()).hexdigest())
        self.settings: GuardSettings = commissioned(made)
        (folder / "guard.json").write_text(encode_settings(self.settings))
        self._nodes = {axis.offset.cob_id: k for k, axis in enumerate(self.settings.axes)}
        self._scale = [axis.increments_per_mm for axis in self.settings.axes]
        self._journal, self._journal_end = os.pipe()
        os.set_blocking(self._journal, False)
        self._lines = b""
        self.guard = 0
        self.daemon: Daemon | None = None
        self.tick = self.sent = self.frames = self.stops = self.changed_at = 0
        self.offsets = [0] * len(AXES)
        self.heard: dict[int, int] = {}
        self.trace: list[tuple[int, tuple[int, ...]]] = []
        self.wrong: list[str] = []
        self.events: list[dict[str, Any]] = []
        self.wires = [Wire(axis.limits, 0) for axis in self.settings.axes]
        self.state = ""
        self.playing = self.idle = False
        self.waits, self.tamper, self.insert = True, None, []
        self._next_s = self._heard_s = 0.0
        self._send([frame for _, frame in self.machine.power_on()])
        self.machine.nc.switch_on_off(True)
        self.run_until(lambda: self.machine.nc.phase.name == "READY", "the NC has the drives")

    tamper: Tamper | None
    insert: list[Frame]

    # --- one SYNC ---

    def run_cycle(self) -> None:
        """Send one SYNC with all that belongs to it, and wait for what the guard answers."""
        self.tick += 1
        before, self.heard = self.heard, {}
        frames = [frame for _, frame in self.machine.run_nc_cycle()]
        if self.tamper is not None:
            k = self.tick - self.changed_at
            frames = [heard for frame in frames for heard in self.tamper(k, frame)]
        inserted, self.insert = self.insert, []
        self._send([*frames, *inserted])
        self._listen(before)
        self.waits = True
        for event in self.machine.take_events():
            self.playing = self.playing and event["event"] != "finished"
        if not before and not self.heard:
            for wire in self.wires:
                wire.nothing()
        self.trace.append((self.tick, tuple(self.offsets)))

    def _send(self, frames: list[Frame]) -> None:
        self._bus.queue_frames(frames)
        self._bus.flush_frames(time.monotonic())

    def _listen(self, before: Mapping[int, int]) -> None:
        """Receive until a period has passed and, of a guard that continues sending, until its frames have arrived.

        One that begins may lag behind: the next SYNC waits until nothing of it comes any more.
        """
        begin_s = time.monotonic()
        due_s = max(self._next_s, begin_s)
        self._next_s = due_s + (self._idle_s if self.idle else PERIOD_S)
        while (now_s := time.monotonic()) - begin_s < LATE_S:
            if self.heard and not before:
                due_s = max(due_s, self._heard_s + self._quiet_s)
            answered = not (before and self.waits and self.sending) or len(self.heard) == len(self._nodes)
            if answered and now_s >= due_s:
                return
            self._turn_over(max(0.0, due_s - now_s) if answered else 0.1)

    def drain(self) -> None:
        """Take what waits on the bus already: a computer that was held up has not read it yet."""
        before = -1
        while before != (before := self.sent):
            self._turn_over(0.0)

    def _turn_over(self, wait_s: float) -> None:
        readers: list[Any] = [*self._bus.list_readers(), self._journal]
        if self.daemon is not None and not self.daemon.armed:
            readers.append(self.daemon)
        ready, _, _ = select.select(readers, self._bus.list_writers(), (), wait_s)
        self._bus.receive_frames(ready, self._receive_frame)
        self._bus.flush_frames(time.monotonic())
        if self.daemon is not None and self.daemon in ready:
            self.daemon.receive_report()
        if self._journal in ready:
            self._read_journal()

    def _receive_frame(self, frame: Frame) -> None:
        cob_id, data = frame
        if cob_id in self.settings.sent_ids:
            self.sent += 1
        if cob_id in self._nodes:
            self._check_frame(self._nodes[cob_id], int.from_bytes(data, "little", signed=True))
        self._send(self.machine.receive_frame("can0", frame))

    def _read_journal(self) -> None:
        """Follow the guard's state to decide whether to wait for a frame; no check depends on it."""
        *lines, self._lines = (self._lines + os.read(self._journal, 1 << 16)).split(b"\n")
        for line in lines:
            event = json.loads(line)
            self.events.append(event)
            self.state = event.get("state", self.state)

    @property
    def sending(self) -> bool:
        """Whether the guard sends offsets, as far as its journal was read."""
        return self.state not in ("", "OFF", "FROZEN")

    def _check_frame(self, axis: int, value: int) -> None:
        """Check a frame by those before it on the wire and by the drive's offset.

        One that goes on from rest where the offset was moving follows a cycle that the guard missed: it is counted.
        """
        self.frames += 1
        before, self.offsets[axis] = self.offsets[axis], value
        self.heard[axis], self._heard_s = value, time.monotonic()
        wrong = self.wires[axis].ours(value, self.read_held_offsets()[axis])
        if wrong is not None and abs(value - before) <= self.settings.axes[axis].limits.hard_acceleration:
            self.stops += 1
            self.wires[axis].stood(before)
        elif wrong is not None:
            self.wrong.append(f"SYNC {self.tick}, {AXES[axis]}: {wrong}")

    def read_held_offsets(self) -> list[int]:
        """Return the offsets that the drives hold, in increments."""
        return [unit.drive.dictionary.get_number(0x60B0, 0) for unit in self.machine.units.values()]

    def start_new_trace(self) -> None:
        """Begin a new trace with what is on the wire now."""
        self.trace = [(self.tick, tuple(self.offsets))]

    def expect(self) -> None:
        """The next SYNC waits for frames of the guard, though none came with the last."""
        self.heard = dict(enumerate(self.offsets))

    def queue_foreign_frames(self, frames: list[Frame]) -> None:
        """Put another node's frames on the bus in the next cycle; the drives take an offset among them."""
        for frame in frames:
            if frame[0] in self._nodes:
                self.make_foreign_offset(*frame)
                self.waits = False
            else:
                self.insert.append(frame)

    def make_foreign_offset(self, cob_id: int, data: bytes) -> None:
        """Another node's offset."""
        axis, value = self._nodes[cob_id], int.from_bytes(data, "little", signed=True)
        self._send([(cob_id, data), *self.machine.receive_frame("can0", (cob_id, data))])
        self.wires[axis].foreign(value)
        self.offsets[axis] = value
        self.trace = [(self.tick, tuple(self.offsets))]

    def write_foreign_offset(self, value: int) -> None:
        """Another node's offset on the first axis, and the SYNC that latches it."""
        self.make_foreign_offset(self.settings.axes[0].offset.cob_id, value.to_bytes(4, "little", signed=True))
        self.run_cycle()

    def has_journal_state(self, states: str, since: int) -> bool:
        """Return whether the guard's journal reported one of these states after this many lines."""
        return any(event.get("state", "-") in states.split() for event in self.events[since:])

    def run_cycles(self, cycles: int) -> None:
        """Run this many SYNC."""
        for _ in range(cycles):
            self.run_cycle()

    def run_until(self, reached: Callable[[], bool], what: str, limit: int = 20_000) -> int:
        """SYNC until something has come about; how many. RuntimeError when it does not."""
        for taken in range(limit):
            if reached():
                return taken
            self.run_cycle()
        raise RuntimeError(f"{what}: did not come about in {limit} SYNC; {self.events[-5:]}")

    # --- what is started, and what is done to it ---

    def start_guard(self) -> None:
        """Start the guard on a descriptor of its own, as fdhil-guard does by exec."""
        seen, self.idle = len(self.events), True
        self.guard = os.fork()
        if self.guard == 0:
            self._become_guard()
        self.run_until(lambda: any(e["event"] == "ready" for e in self.events[seen:]), "the guard is ready")
        self.run_cycles(ADOPTING)
        self.idle = False

    def _become_guard(self) -> None:
        """Never returns."""
        try:
            os.dup2(self._journal_end, 1)
            bus = open_transmit_socket("can0", self._place)
            greet_hub("can0", self._place, bus)
            bus.setblocking(True)
            bus.set_inheritable(True)
            arguments = ["--settings", str(self.folder / "guard.json"), "--descriptor", str(bus.fileno())]
            os.closerange(bus.fileno() + 1, 1024)
            os.execv(sys.executable, [sys.executable, "-m", "fdhil.guard", *arguments])
        finally:
            os._exit(70)

    def kill_guard(self) -> None:
        """Kill it, and return when it is dead."""
        os.kill(self.guard, signal.SIGKILL)
        self.guard_ended()
        self.state = ""

    def guard_ended(self) -> int:
        """Wait for its end; its exit code."""
        _, status = os.waitpid(self.guard, 0)
        self.guard = 0
        return os.waitstatus_to_exitcode(status)

    def arm(self) -> None:
        """Start a new daemon, armed for the next program from the current position."""
        self.machine.nc.stop_path()
        self.run_until(lambda: not self.machine.nc.is_busy, "the NC stands")
        self.run_cycles(5)
        here = self.machine.nc.in_force
        assert here is not None
        part, offsets = make_wave(self.rng, self.settings.axes[0].limits.offset)
        ways = [way if at < 0 else -way for way, at in zip(WAYS_MM, here.position_mm, strict=True)]
        demand = [at + way * part for at, way in zip(here.position_mm, ways, strict=True)]
        increments = [[round(mm * scale) for mm in column] for column, scale in zip(demand, self._scale, strict=True)]
        nothing = np.zeros(ROWS, dtype=np.int64)
        places = dict(zip(AXES, demand, strict=True))
        time_s: Float = np.arange(ROWS, dtype=np.float64) * PERIOD_S
        self.program = Trajectory(PERIOD_S, time_s, places, nothing.astype(bool), nothing)
        self.idle = True  # the client that arms has the processor to itself
        seen = len(self.events)
        daemon = self.daemon = Daemon(self.folder, increments, offsets)
        self.run_until(lambda: daemon.armed and self.has_journal_state("ARMED", seen), "armed")
        self.idle = False

    def play_program(self) -> None:
        """Let the NC play the program of the last arming."""
        self.machine.nc.play_demand("program", self.program)
        self.playing = True

    def run_into_cut(self) -> None:
        """Armed, and at any place of the program where an offset is applied.

        A guard that was held up and lost frames ends a correction before it begins, as it should: it is armed again.
        """
        for _ in range(TRIES):
            self.arm()
            self.play_program()
            self.run_until(lambda: any(self.offsets) or not self.sending, "an offset")
            if any(self.offsets):
                self.run_cycles(int(self.rng.integers(0, ROWS - 2 * RESTING - 40)))
                return
            self.give_up()
        raise RuntimeError(f"no program began in {TRIES} tries; {self.events[-5:]}")

    def give_up(self) -> None:
        """End the daemon whose correction the guard has ended, and a guard that is frozen."""
        if self.daemon is not None:
            self.daemon.kill()
        if self.state == "FROZEN":
            self.kill_guard()
            self.start_guard()

    def close(self) -> None:
        """End what still runs."""
        if self.daemon is not None:
            self.daemon.kill()
        if self.guard:
            os.kill(self.guard, signal.SIGKILL)
            self.guard_ended()
        self._bus.close()
        self.machine.abandon_trace()
        os.close(self._journal)
        os.close(self._journal_end)
