"""Runs the bus for the commissioning: produces SYNC, sends one drive its set-points, asks by SDO and hears the drive.

One thread turns the cycle: it sends what is due (heartbeat, SYNC, set-points), drains the bus and keeps what came.
Everything that is sent leaves from this turn, so a program that hangs sends nothing more.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Self

from fdhil import cia402
from fdhil.commissioning.bus_listener import shows_master
from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import MachineConfig
from fdhil.drivers.can.frames import ERROR_FLAG
from fdhil.drivers.can.sdo import SdoLink
from fdhil.drivers.cia402.profile import DriveProfile
from fdhil.drivers.cia402.profile_file import load_profile
from fdhil.errors import DeviceError, DeviceTimeout


@dataclass(slots=True)
class Heard:
    """The drive's newest: mapped objects by key, EMCY frames, its NMT state; and frames and error frames of the bus.

    ``master`` is what shows that another master runs the bus, None while nothing does.
    """

    objects: dict[tuple[int, int], int] = field(default_factory=dict)
    cycle: dict[tuple[int, int], int] = field(default_factory=dict)
    emergencies: list[bytes] = field(default_factory=list)
    nmt: int | None = None
    master: str | None = None
    frames: int = 0
    errors: int = 0


LOCKSTEP_WAIT_S = 8.0
LOCKSTEP_PATIENCE = 20.0  # times as long as on a real machine: a simulated one shares its computer


class AxisSdo(SdoLink):
    """The SDO channel of one axis of a node: objects of CiA 402 are named as the first axis has them."""

    profile: DriveProfile

    def read(self, index: int, sub: int = 0) -> bytes:
        """Read an object; SdoAbort, DeviceTimeout or ProtocolError."""
        return super().read(self.profile.object_index(index), sub)

    def write_int(self, index: int, sub: int, value: int, length: int) -> None:
        """Write an integer of ``length`` bytes."""
        super().write_int(self.profile.object_index(index), sub, value, length)


class Master:
    """A context manager around one bus and one drive; nothing is sent before ``produce_sync`` or an SDO call."""

    def __init__(self, config: MachineConfig, axis: str) -> None:
        settings = config.axis[axis]
        self.config, self.axis = config, axis
        self.node_id = config.node_id(axis)
        profile = load_profile(settings.drive)
        self.profile: DriveProfile = profile.with_feedforward() if settings.feedforward else profile
        self.period_s = config.machine.sync_period_s
        self.device = f"drive {axis}"
        self.bus = TransmitBus(settings.drive.bus, config.bus[settings.drive.bus])
        self._lockstep = config.guard.clock == "sync"
        self._patience = LOCKSTEP_PATIENCE if self._lockstep else 1.0
        self.sdo = AxisSdo(self.device, self.node_id, self.bus.send, self._patience)
        self.sdo.profile = self.profile
        self.heard = Heard()
        self.cycle = 0
        self.controlword = 0
        self.target: int | None = None
        self.offset = 0
        self.heartbeat = False
        self.fed: tuple[int, int] | None = None
        self._plan: deque[int] = deque()
        self._sync_counter = 0
        self._sync_overflow: int | None = None
        self._answered, self._wait_until = 0, 0.0
        self._heartbeat_due = 0.0
        self._lock = threading.Lock()
        self._failure: DeviceError | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._turn, name="fdhil-commissioning", daemon=True)
        self._thread.start()

    # the cycle ------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        due = time.monotonic()
        try:
            while not self._stopping.is_set():
                self._receive()
                self._send_heartbeat()
                if self._sync_overflow is not None and not self._awaits_drive():
                    self._send_cycle()
                due = max(due + self.period_s, time.monotonic() - self.period_s)
                time.sleep(max(0.0, due - time.monotonic()))
        except DeviceError as error:
            self._failure = error

    def _awaits_drive(self) -> bool:
        """Whether a simulated drive has yet to answer the last SYNC: its process may sleep, and time is the SYNC count.

        One that has not answered in ``LOCKSTEP_WAIT_S`` is not waited for until it answers again.
        """
        behind = self.cycle - self._answered
        return self._lockstep and 0 < behind <= 1 and time.monotonic() < self._wait_until

    def _send_heartbeat(self) -> None:
        now = time.monotonic()
        if self.heartbeat and now >= self._heartbeat_due:
            self._heartbeat_due = now + self.config.guard.heartbeat_s
            self.bus.send(cia402.COB_HEARTBEAT + self.config.guard.node_id, bytes([cia402.Nmt.OPERATIONAL]))

    def _send_cycle(self) -> None:
        """SYNC, then the set-points that the next SYNC latches."""
        if self._sync_overflow:
            self._sync_counter = self._sync_counter % self._sync_overflow + 1
            self.bus.send(cia402.COB_SYNC, bytes([self._sync_counter]))
        else:
            self.bus.send(cia402.COB_SYNC, b"")
        self.cycle += 1
        self._wait_until = time.monotonic() + LOCKSTEP_WAIT_S
        with self._lock:
            if self._plan:
                self.offset = self._plan.popleft()
            target, offset, controlword, fed = self.target, self.offset, self.controlword, self.fed
        if target is None:
            return
        profile = self.profile
        values = {profile.target: target, profile.offset: offset, profile.controlword: controlword}
        if fed is not None:
            values |= zip((profile.speed_offset, profile.torque_offset), fed, strict=True)
        for spec in profile.rpdos:
            if spec.valid and all((e.index, e.sub) in values for e in spec.entries):
                data = cia402.pack(spec.entries, [values[e.index, e.sub] for e in spec.entries])
                self.bus.send(spec.cob_base + self.node_id, data)

    def _receive(self) -> None:
        node, heard = self.node_id, self.heard
        tpdos = {spec.cob_base + node: spec for spec in self.profile.tpdos}
        for frame in self.bus.drain():
            can_id, length = int(frame["id"]), int(frame["dlc"])
            data = int(frame["data"]).to_bytes(8, "little")[:length]
            error = bool(can_id & ERROR_FLAG)
            heard.errors, heard.frames = heard.errors + error, heard.frames + (not error)
            if (sign := shows_master(can_id)) is not None:
                heard.master = heard.master or sign
            elif can_id in tpdos and length >= tpdos[can_id].length:
                spec, self._answered = tpdos[can_id], self.cycle
                for entry, value in zip(spec.entries, cia402.unpack(spec.entries, data), strict=True):
                    heard.objects[entry.index, entry.sub] = value
                    heard.cycle[entry.index, entry.sub] = self.cycle
            elif can_id == self.sdo.response_id:
                self.sdo.deliver(data)
            elif can_id == cia402.COB_EMCY + node:
                heard.emergencies.append(data)
            elif can_id == cia402.COB_HEARTBEAT + node and data:
                heard.nmt = data[0] & 0x7F

    # what the steps use ---------------------------------------------------------------------------------------

    def produce_sync(self, overflow: int) -> None:
        """Send SYNC from now on, with a counter up to ``overflow`` (0: without)."""
        self._sync_overflow = overflow

    @property
    def producing(self) -> bool:
        """Whether SYNC is being sent."""
        return self._sync_overflow is not None

    def stop_sync(self) -> None:
        """Send SYNC and set-points no more."""
        self._sync_overflow = None

    def nmt(self, command: cia402.NmtCommand) -> None:
        """Send an NMT command to the drive."""
        self.bus.send(cia402.COB_NMT, bytes([command, self.node_id]))

    def play_offset(self, values: Sequence[int]) -> int:
        """Send these offsets, one per cycle; returns the cycle after whose SYNC the first one goes out."""
        with self._lock:
            self._plan.extend(values)
            return self.cycle + 1

    @property
    def playing(self) -> bool:
        """Whether planned offsets still wait to be sent."""
        return bool(self._plan)

    def check(self) -> None:
        """Raise what ended the cycle thread or the bus."""
        if self._failure is not None:
            raise self._failure
        if self.bus.ended is not None:
            raise DeviceError(f"bus {self.bus.name}", f"{self.bus.ended}; start again when the bus is back")

    def wait(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Wait until ``condition`` holds; DeviceTimeout with the sentence ``otherwise`` when it does not in time."""
        deadline = time.monotonic() + timeout_s * self._patience
        while not condition():
            self.check()
            if time.monotonic() > deadline:
                raise DeviceTimeout(self.device, otherwise)
            time.sleep(0.002)

    def wait_cycles(self, cycles: int) -> None:
        """Wait for a number of SYNC cycles."""
        goal = self.cycle + cycles
        patience = 20 * cycles * self.period_s + 5.0
        self.wait(lambda: self.cycle >= goal, patience, "the computer does not keep up with SYNC; stop other programs")

    def hold_here(self) -> None:
        """Take the actual position as target, with offset 0."""
        with self._lock:
            self._plan.clear()
            self.offset = 0
            self.target = self.heard.objects[self.profile.position]

    def average(self, key: tuple[int, int], cycles: int) -> float:
        """Return the mean of a mapped object over so many cycles."""
        values, end = [], self.cycle + cycles
        seen = self.heard.cycle.get(key, 0)
        while self.cycle < end:
            self.check()
            time.sleep(self.period_s / 2)
            if self.heard.cycle.get(key, 0) > seen:
                seen = self.heard.cycle[key]
                values.append(self.heard.objects[key])
        if not values:
            raise DeviceTimeout(self.device, f"0x{key[0]:04X} does not come any more; check its TPDO")
        return sum(values) / len(values)

    def state(self) -> cia402.State:
        """The power state of the newest statusword."""
        return cia402.state_of(self.heard.objects.get(self.profile.statusword, 0))

    def close(self) -> None:
        """Stop sending and release the bus."""
        self._stopping.set()
        self._thread.join(timeout=2.0)
        self.bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
