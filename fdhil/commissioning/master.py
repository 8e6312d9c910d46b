"""Leads one drive for the commissioning and for what is played: asks it by SDO, gives it its set-points and hears it.

What is sent in time leaves from the turn of the :class:`Cycle` that runs its bus.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Self

from fdhil import cia402
from fdhil.commissioning.bus_watch import offset_ids
from fdhil.commissioning.cycle import Cycle
from fdhil.config import MachineConfig
from fdhil.drivers.can.frames import ERROR_FLAG
from fdhil.drivers.can.sdo import SdoLink
from fdhil.drivers.cia402.profile import DriveProfile
from fdhil.drivers.cia402.profile_file import load_profile
from fdhil.errors import DeviceTimeout, ForeignMaster


@dataclass(slots=True)
class Heard:
    """The drive's newest: mapped objects by key, EMCY frames, its NMT state; and frames and error frames of the bus.

    ``boots`` counts its boot-ups. ``ids`` are the COB-IDs of all frames.
    """

    objects: dict[tuple[int, int], int] = field(default_factory=dict)
    cycle: dict[tuple[int, int], int] = field(default_factory=dict)
    emergencies: list[bytes] = field(default_factory=list)
    nmt: int | None = None
    boots: int = 0
    frames: int = 0
    errors: int = 0
    ids: set[int] = field(default_factory=set)


FIRST_VALUE_S = 0.5  # an object of a TPDO that every tenth SYNC or so brings comes in this time
LOCKSTEP_PATIENCE = 20.0  # times as long as on a real machine: a simulated one shares its computer
CATCH_UP_S = 0.25  # a simulated drive that was not waited for has no SYNC left to answer when it is silent for so long


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
    """A context manager around one drive; nothing is sent before ``loop.produce_sync`` or an SDO call.

    Without a ``cycle`` that is shared with other drives it runs the drive's bus itself. The offset is sent, too, but
    where a guard does that.
    """

    def __init__(self, config: MachineConfig, axis: str, cycle: Cycle | None = None) -> None:
        settings = config.axis[axis]
        self.config, self.axis = config, axis
        self.node_id = config.node_id(axis)
        profile = load_profile(settings.drive)
        self.profile: DriveProfile = profile.with_feedforward() if settings.feedforward else profile
        self.period_s = config.machine.sync_period_s
        self.device = f"drive {axis}"
        self.loop = cycle or Cycle(config, (settings.drive.bus,))
        self.bus = self.loop.buses[settings.drive.bus]
        self._own_loop = cycle is None
        self.patience = LOCKSTEP_PATIENCE if self.loop.lockstep else 1.0
        self.sdo = AxisSdo(self.device, self.node_id, self.bus.send, self.patience)
        self.sdo.profile = self.profile
        self.heard = Heard()
        self.controlword = 0
        self.target: int | None = None
        self.offset = 0
        self.fed: tuple[int, int] | None = None
        self._offset_ids = set(offset_ids(self.profile, self.node_id))
        self._sends_offset = not self.loop.beside_guard
        self._landing = False
        self._tpdos = {spec.cob_base + self.node_id: spec for spec in self.profile.tpdos}
        # SYNC is answered by the last of them: one before it would let two SYNCs go for one
        answers = {can_id: spec.every_sync for can_id, spec in self._tpdos.items() if spec.valid}
        self._last_answer = max((can_id for can_id, every in answers.items() if every == 1), default=0)
        self._seldom = {can_id: every for can_id, every in answers.items() if every > 1 and can_id > self._last_answer}
        self._due: dict[int, int] = {}
        self._plan: deque[int] = deque()
        self._answered = 0
        self._caught_up_s = 0.0
        self._lock = threading.Lock()
        self.loop.members.append(self)
        if self._own_loop:
            self.loop.start()

    # the cycle ------------------------------------------------------------------------------------------------

    @property
    def behind(self) -> int:
        """How many SYNCs the drive has not answered."""
        return self.cycle - self._answered

    @property
    def awaited(self) -> bool:
        """Whether a TPDO of the last SYNC is yet to come, or of those before at which it was not waited for."""
        behind = self.behind
        return behind == 1 or (not behind and self.cycle in self._due.values()) or self._catching_up

    @property
    def position(self) -> int | None:
        """The drive's newest position; None before the first, and when the last SYNC but one brought none."""
        return self.heard.objects.get(self.profile.position) if self.behind <= 2 else None

    def send_set_points(self) -> None:
        """Send the set-points that the next SYNC latches."""
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
            cob_id = spec.cob_base + self.node_id
            due = spec.valid and (self._sends_offset or cob_id not in self._offset_ids)
            if due and all((e.index, e.sub) in values for e in spec.entries):
                with suppress(ForeignMaster):  # it leads this drive, or sends its offset
                    self.bus.send(cob_id, cia402.pack(spec.entries, [values[e.index, e.sub] for e in spec.entries]))

    def _take_answer(self) -> None:
        """Take the last TPDO that comes with every SYNC: it may answer one that was sent long before the newest."""
        if self.loop.lockstep and (self.behind > 1 or self._catching_up):
            self._caught_up_s = time.monotonic() + CATCH_UP_S
        self._answered = self.cycle

    @property
    def _catching_up(self) -> bool:
        return time.monotonic() < self._caught_up_s

    @property
    def led(self) -> bool:
        """Whether set-points are sent to the drive."""
        return self.target is not None

    @property
    def led_by_other(self) -> bool:
        """Whether another master sends its set-points, or stopped its node."""
        return self.axis in self.bus.watch.led_by_other

    @property
    def stopped_by_other(self) -> bool:
        """Whether another master stopped its node and has not started it again."""
        return self.axis in self.bus.watch.stopped

    @property
    def zeroes_offset(self) -> bool:
        """Whether its offset is ours: neither a guard nor another master sends it."""
        return not self.loop.beside_guard and not self.offset_by_other

    @property
    def offset_by_other(self) -> bool:
        """Whether another master sent its offset."""
        return bool(self._offset_ids & self.bus.watch.sent_by_other)

    @property
    def held_offset(self) -> int:
        """The offset of a guard that the drive shows."""
        return self.heard.objects.get(self.profile.offset, 0) if self.loop.guard_runs() else 0

    def land(self, cycles: int) -> None:
        """Take the offset to zero in so many steps and send no other one any more."""
        with self._lock:
            self._landing, start = True, self.offset
            self.fed = None if self.fed is None else (0, 0)
            self._plan = deque(round(start * left / cycles) for left in reversed(range(cycles)))

    def switch_off(self, word: int) -> None:
        """Send this controlword from now on, and no offset."""
        self._sends_offset, self.controlword = False, word

    def send_zero_offset(self) -> None:
        """Send an offset of zero once, at once."""
        for spec in self.profile.rpdos:
            if spec.valid and spec.cob_base + self.node_id in self._offset_ids:
                with suppress(ForeignMaster):  # it sends the offset
                    self.bus.send(spec.cob_base + self.node_id, bytes(spec.length))

    def take(self, can_id: int, data: bytes) -> None:
        """Take a frame of the bus."""
        node, heard, spec = self.node_id, self.heard, self._tpdos.get(can_id)
        error = bool(can_id & ERROR_FLAG)
        heard.errors, heard.frames = heard.errors + error, heard.frames + (not error)
        heard.ids.add(can_id)
        if spec is not None and len(data) >= spec.length:
            if can_id == self._last_answer:
                self._take_answer()
            elif can_id in self._seldom:  # it follows the last answer to its SYNC
                self._due[can_id] = self._answered + self._seldom[can_id]
            for entry, value in zip(spec.entries, cia402.unpack(spec.entries, data), strict=True):
                heard.objects[entry.index, entry.sub] = value
                heard.cycle[entry.index, entry.sub] = self.cycle
        elif can_id == self.sdo.response_id:
            self.sdo.deliver(data)
        elif can_id == cia402.COB_EMCY + node:
            heard.emergencies.append(data)
        elif can_id == cia402.COB_HEARTBEAT + node and data:
            heard.nmt = data[0] & 0x7F
            heard.boots += heard.nmt == cia402.Nmt.BOOT_UP
        elif can_id in self._offset_ids and self.loop.beside_guard:
            self.loop.offsets_heard.add(can_id)

    # what the steps use ---------------------------------------------------------------------------------------

    @property
    def cycle(self) -> int:
        """The number of SYNCs that were sent."""
        return self.loop.count

    @property
    def heartbeat(self) -> bool:
        """Whether our heartbeat is sent."""
        return self.loop.heartbeat is not None

    @heartbeat.setter
    def heartbeat(self, on: bool) -> None:
        self.loop.heartbeat = self.config.guard.node_id if on else None

    def nmt(self, command: cia402.NmtCommand) -> None:
        """Send an NMT command to the drive."""
        self.bus.send(cia402.COB_NMT, bytes([command, self.node_id]))

    def play_offset(self, values: Sequence[int]) -> int:
        """Send these offsets, one per cycle; returns the cycle after whose SYNC the first one goes out."""
        with self._lock:
            if not self._landing:
                self._plan.extend(values)
            return self.cycle + 1

    def drop_offsets(self) -> int:
        """Send none of the planned offsets any more; return the one that was sent last."""
        with self._lock:
            if not self._landing:
                self._plan.clear()
            return self.offset

    @property
    def playing(self) -> bool:
        """Whether planned offsets still wait to be sent."""
        return bool(self._plan)

    def check(self) -> None:
        """Raise what ended the cycle or the bus."""
        self.loop.check()

    def wait(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Wait until ``condition`` holds; DeviceTimeout with the sentence ``otherwise`` when it does not in time."""
        deadline = time.monotonic() + timeout_s * self.patience
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
            if self._landing:
                return
            self._plan.clear()
            self.offset = 0
            self.target = self.heard.objects[self.profile.position]

    def average(self, key: tuple[int, int], cycles: int) -> float:
        """Return the mean of a mapped object over so many cycles; a computer that sleeps sees fewer of them."""
        before = self.heard.cycle.get(key, 0)
        gone = f"0x{key[0]:04X} does not come any more; check its TPDO"
        self.wait(lambda: self.heard.cycle.get(key, 0) > before, FIRST_VALUE_S, gone)
        values, seen, end = [self.heard.objects[key]], self.heard.cycle[key], self.cycle + cycles
        over = False
        while not over:
            over = self.cycle >= end  # asked before the look, which sees what came in the last of them
            if self.heard.cycle[key] > seen:
                seen = self.heard.cycle[key]
                values.append(self.heard.objects[key])
            self.check()
            time.sleep(self.period_s / 2)
        return sum(values) / len(values)

    def state(self) -> cia402.State:
        """The power state of the newest statusword."""
        return cia402.state_of(self.heard.objects.get(self.profile.statusword, 0))

    def close(self) -> None:
        """Stop sending and release the bus, unless others share it."""
        if self._own_loop:
            self.loop.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
