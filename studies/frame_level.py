"""The ramps of every fault at any time of a program: the guard's decisions in this process, checked by their frames."""

from __future__ import annotations

import copy
import socket
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from fdhil.guard.can_socket import CanSocket
from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.emergency_ramp import ramp_to_zero
from fdhil.guard.event_journal import SYSTEM
from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import GuardRequest, StepInputs, StepOutput
from fdhil.guard.interlocks import FACTS, Alarm
from studies.fault_rows import HIJACK, RAMPED, Descent, Row, Tamper, assess_ramp_down
from tests.guard import simulated_bus
from tests.guard.frame_checks import Wire
from tests.guard.simulated_bus import DIGEST, Bench

MOTOR: dict[str, Any] = {"speed_count": 1e-3, "speed_step": 44.0, "heartbeat_timeout_s": 0.1}
CLOCKS: dict[str, dict[str, Any]] = {"A7": {"offset_synchronous": False}, "A8": {"clock": "monotonic"}}
LIMIT = 400
SHARE = 0.15
"""Of the SYNC of a program a fault falls on so many; each has the machine to itself."""


class LateListener(FrameMonitor):
    """A listener whose SYNC comes ``estimate_current_lag_s`` after its time."""

    late_s = 0.0

    def receive_at_sync(self, data: bytes, stamp_s: float, now_s: float) -> tuple[Any, Any]:
        return super().receive_at_sync(data, stamp_s + self.late_s, now_s + self.late_s)


class Cut(Bench):
    """A machine in the cut whose frames are checked on the wire; ``tamper`` changes what the guard receives."""

    tamper: Tamper | None = None
    changed_at = 0
    withdrawn: tuple[Alarm, ...] = ()

    def start_checks(self) -> None:
        """Judge from here on, with ears that can be late."""
        self.listener = LateListener(self.settings)
        self.wires = [Wire(axis.limits, 0) for axis in self.settings.axes]
        self.wrong: list[str] = []
        self.series: list[tuple[int, ...]] = [(0, 0)]

    def receive_frames(self, cob_id: int, data: bytes) -> None:
        frames = [(cob_id, data)]
        if self.tamper is not None and cob_id not in (HIJACK, 0x764, 0x081):
            frames = self.tamper(self.tick - self.changed_at, (cob_id, data))
        for frame in frames:
            super().receive_frames(*frame)

    def decide_and_check(self, inputs: StepInputs) -> StepOutput:
        """Decide, and check the frames sent."""
        if inputs.unsent and self.outputs and self.outputs[-1].offsets is not None:
            for k in inputs.unsent:
                self.wires[k].lost()
            held = [self.series[-2 if k in inputs.unsent else -1][k] for k in range(len(self.wires))]
            self.series[-1] = tuple(held)
        held = [drive.offset for drive in self.drives]
        output = super().decide_and_check(inputs._replace(withdrawn=self.withdrawn))
        for k, wire in enumerate(self.wires):
            if output.offsets is None:
                wire.nothing()
            elif (wrong := wire.ours(output.offsets[k], held[k])) is not None:
                self.wrong.append(f"SYNC {self.tick}: {wrong}")
        self.series.append(self.series[-1] if output.offsets is None else output.offsets)
        return output

    def copy_state(self) -> Cut:
        """Return a machine of one's own in this state; what cannot change is shared, what was is forgotten."""
        self.outputs, self.frames, self.held = self.outputs[-1:], self.frames[-1:], []
        self.series, self.heartbeats = self.series[-2:], []
        unchanging = (self.settings, self.path, self.demand, self.state)
        return copy.deepcopy(self, {id(each): each for each in unchanging})

    def run_sync(self, request: GuardRequest | None = None, **how: Any) -> StepOutput:
        """One SYNC; the drives' heartbeats come with it."""
        for drive in self.drives:
            self.receive_frames(0x700 + drive.node_id, b"\x05")
        return super().run_sync(request, **how)


def start_cut(rng: np.random.Generator, clock: str) -> Cut:
    """A machine with a random program in which offsets are applied."""
    made = simulated_bus.bench(amplitude=int(rng.integers(100, 800)), **CLOCKS.get(clock, {}))
    axes = tuple(replace(axis, **MOTOR) for axis in made.settings.axes)
    cut = Cut(replace(made.settings, axes=axes), made.path, made.demand, made.drives)
    cut.start_checks()
    cut.settle()
    if refused := cut.arm():
        raise RuntimeError(f"cannot be armed: {refused}")
    cut.run(30)
    cut.play()
    cut.run_until(Mode.ACTIVE)
    return cut


def inject_fault(cut: Cut, row: str, rng: np.random.Generator) -> Descent | None:
    """Have a fault of this row, until zero; None when it was not reached."""
    of, k = RAMPED[row], 0
    first = len(cut.series) - 1
    rate = max(abs(b - a) for a, b in zip(*cut.series[-2:], strict=True))
    cut.alarms.clear()
    _begin(cut, row, of, rng)
    if row == "F20":
        _ramp_down(cut)
    while row != "F20" and k < LIMIT and (cut.mode is not Mode.OFF or any(cut.series[-1])):
        k += 1
        _run_one_sync(cut, row, k)
        if cut.mode is Mode.FROZEN:
            break
    codes = {alarm.code for alarm in cut.alarms}
    if of.code not in codes and row != "F20":
        cut.wrong.append(f"{row} was told as {sorted(codes)}")
    limits = cut.settings.axes[0].limits
    return assess_ramp_down(cut.series[first:], rate, limits, of.detected)


def _begin(cut: Cut, row: str, of: Row, rng: np.random.Generator) -> None:
    cut.changed_at = cut.tick
    if of.tamper is not None:
        cut.tamper = of.tamper(rng)
        if row == "A9":  # not to where the counter may begin again
            cut.counter = (cut.counter + int(rng.integers(4, 230))) % 240 or 100
    for cob_id, data in of.insert(rng) if of.insert is not None else ():
        cut.inject_frame(cob_id, data)
        if cob_id == HIJACK:
            value = int.from_bytes(data, "little", signed=True)
            cut.wires[0].foreign(value)
            cut.series[-1] = (value, *cut.series[-1][1:])
    if of.order in FACTS:
        cut.withdrawn = (Alarm(of.code),)
    if row in ("E1", "E2"):
        _corrupt_offsets(cut, 5000 if row == "E1" else 100)
    assert cut.path is not None
    match row:
        case "A2":
            cut.listener.set_controller_state("passive")
        case "A6":
            cut.listener.lost_frames += 1
        case "E5":
            cut.path = CorrectedPath(0, cut.path.demand, cut.path.offset, True, "another", 2)
        case "F15":
            cut.main_alive = False


class EverySync:
    """A bus whose SYNC always waits, for the guard's last way to zero: ``sent`` are the frames that left."""

    def __init__(self) -> None:
        self._near, self._far = socket.socketpair()
        self._far.send(b"x")
        self.sent: list[tuple[int, bytes]] = []

    def fileno(self) -> int:
        """A descriptor that is readable."""
        return self._near.fileno()

    def receive(self) -> list[tuple[int, bytes, float]]:
        """The next SYNC."""
        return [(0x080, b"", 0.0)]

    def send(self, cob_id: int, data: bytes) -> bool:
        """Take a frame."""
        self.sent.append((cob_id, data))
        return True

    def close(self) -> None:
        """Close both ends."""
        self._near.close()
        self._far.close()


def _ramp_down(cut: Cut) -> None:
    """What the guard's supervisor does when the loop itself has failed."""
    bus = EverySync()
    ramp_to_zero(cut.state, (), cut.settings, cast(CanSocket, bus), SYSTEM)
    bus.close()
    values = [int.from_bytes(data, "little", signed=True) for _, data in bus.sent]
    for offsets in batch_values(values, len(cut.wires)):
        for wire, offset, before in zip(cut.wires, offsets, cut.series[-1], strict=True):
            if (wrong := wire.ours(offset, before)) is not None:
                cut.wrong.append(wrong)
        cut.series.append(offsets)


def batch_values(values: Sequence[int], size: int) -> list[tuple[int, ...]]:
    """Return values in groups of ``size``."""
    return [tuple(values[k : k + size]) for k in range(0, len(values), size)]


def _corrupt_offsets(cut: Cut, by: int) -> None:
    """From the next row on the table asks for a step of this size, where there is room away from zero."""
    assert cut.path is not None
    row = cut.state.places[0].row + 1
    columns = [list(column) for column in cut.path.offset]
    most = cut.settings.axes[0].limits.offset
    room = by > most or abs(columns[0][row]) + by < most
    up = (columns[0][row] >= 0) == room
    columns[0][row:] = [value + (by if up else -by) for value in columns[0][row:]]
    cut.path = CorrectedPath(0, cut.path.demand, tuple(columns), True, DIGEST, 1)


def _run_one_sync(cut: Cut, row: str, k: int) -> None:
    match row:
        case "A7":
            cut.silence() if k < 100 else cut.run_sync()
        case "A5":
            cut.run_sync(unsent=() if k > 3 else (0, 1))
        case "A8":
            assert isinstance(cut.listener, LateListener)
            cut.listener.late_s += 5e-5
            cut.run_sync()
        case "F14":
            cut.run_sync(late=k <= 12)
        case "E18" | "F13" if k == 1:
            cut.run_sync(GuardRequest("disarm" if row == "E18" else "stop"))
        case _:
            cut.run_sync()


def simulate_ramp_downs(row: str, times: int, seed: int) -> tuple[list[Descent | None], list[str], int]:
    """Inject a fault ``times`` times, each at a random SYNC with an offset applied, before the path ends by itself.

    Returns the descents, what was wrong, and the SYNC judged.
    """
    rng = np.random.default_rng([seed, list(RAMPED).index(row)])
    found: list[Descent | None] = []
    wrong: list[str] = []
    judged = 0
    while len(found) < times:
        cut = start_cut(rng, row)
        while len(found) < times:
            cut.run_sync()
            if cut.mode is not Mode.ACTIVE:
                break
            left = cut.path.end - cut.state.places[0].row if cut.path is not None else 0
            if left > RAMPED[row].detected and any(cut.series[-1]) and rng.random() < SHARE:
                branch = cut.copy_state()
                found.append(inject_fault(branch, row, rng))
                judged += len(branch.series) - len(cut.series)
                wrong += [f"{row}: {each}" for each in branch.wrong[:1]]
    return found, wrong, judged
