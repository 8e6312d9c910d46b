"""Control one drive for commissioning and playback: read it by SDO, send its set-points, process its frames.

Time-critical frames are sent by the thread of the :class:`Cycle` that runs the drive's bus.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Self

from fdhil import cia402
from fdhil.commissioning.bus_watch import find_offset_cob_ids
from fdhil.commissioning.sync_cycle import SyncCycle
from fdhil.config import MachineConfig
from fdhil.drivers import ERROR_FLAG, DriveProfile, SdoChannel, load_profile
from fdhil.errors import DeviceTimeout, ForeignMaster


@dataclass(slots=True)
class DriveFeedback:
    """Newest state of the drive: mapped objects by key, EMCY frames, NMT state; frame and error counts of the bus.

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


FIRST_VALUE_S = 0.5  # enough for a TPDO sent with every tenth SYNC or so
LOCKSTEP_PATIENCE = 20.0  # factor on time limits: a simulated machine shares its computer
CATCH_UP_S = 0.25  # a simulated drive that is silent for so long has answered every SYNC


class AxisSdo(SdoChannel):
    """The SDO channel of one axis of a node; CiA 402 objects are numbered as for the first axis."""

    profile: DriveProfile

    def read_bytes(self, index: int, sub: int = 0) -> bytes:
        """Read an object; SdoAbort, DeviceTimeout or ProtocolError."""
        return super().read_bytes(self.profile.shift_object_index(index), sub)

    def write_int(self, index: int, sub: int, value: int, length: int) -> None:
        """Write an integer of ``length`` bytes."""
        super().write_int(self.profile.shift_object_index(index), sub, value, length)


class Master:
    """Controls one drive; a context manager. Nothing is sent before ``loop.produce_sync`` or an SDO call.

    Without a shared ``cycle`` it runs the drive's bus itself. It also sends the offset, unless a guard does.
    """

    def __init__(self, config: MachineConfig, axis: str, cycle: SyncCycle | None = None) -> None:
        settings = config.axis[axis]
        self.config, self.axis = config, axis
        self.node_id = config.get_node_id(axis)
        profile = load_profile(settings.drive)
        self.profile: DriveProfile = profile.enable_feedforward() if settings.feedforward else profile
        self.period_s = config.machine.sync_period_s
        self.device = f"drive {axis}"
        self.loop = cycle or SyncCycle(config, (settings.drive.bus,))
        self.bus = self.loop.buses[settings.drive.bus]
        self._own_loop = cycle is None
        self.patience = LOCKSTEP_PATIENCE if self.loop.lockstep else 1.0
        self.sdo = AxisSdo(self.device, self.node_id, self.bus.send, self.patience)
        self.sdo.profile = self.profile
        self.feedback = DriveFeedback()
        self.controlword = 0
        self.target: int | None = None
        self.offset = 0
        self.feedforward_offsets: tuple[int, int] | None = None
        self._offset_ids = set(find_offset_cob_ids(self.profile, self.node_id))
        self._sends_offset = not self.loop.offsets_by_guard
        self._landing = False
        self._tpdos = {spec.cob_base + self.node_id: spec for spec in self.profile.tpdos}
        # only the last one completes the answer: an earlier one would let two SYNCs go out for one
        answers = {can_id: spec.every_sync for can_id, spec in self._tpdos.items() if spec.valid}
        self._last_answer = max((can_id for can_id, every in answers.items() if every == 1), default=0)
        self._infrequent = {
            can_id: every for can_id, every in answers.items() if every > 1 and can_id > self._last_answer
        }
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
    def unanswered_syncs(self) -> int:
        """Number of SYNCs that the drive has not answered."""
        return self.cycle - self._answered

    @property
    def is_awaited(self) -> bool:
        """Whether a TPDO of the last SYNC, or of earlier ones that were not waited for, is still to come."""
        behind = self.unanswered_syncs
        return behind == 1 or (not behind and self.cycle in self._due.values()) or self._is_catching_up

    @property
    def position(self) -> int | None:
        """The drive's newest position; None before the first one, and if the last SYNC but one brought none."""
        return self.feedback.objects.get(self.profile.position) if self.unanswered_syncs <= 2 else None

    def send_set_points(self) -> None:
        with self._lock:
            if self._plan:
                self.offset = self._plan.popleft()
            target, offset, controlword, fed = self.target, self.offset, self.controlword, self.feedforward_offsets
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
                with suppress(ForeignMaster):  # it controls this drive, or sends its offset
                    self.bus.send(cob_id, cia402.pack_pdo(spec.entries, [values[e.index, e.sub] for e in spec.entries]))

    def _register_answer(self) -> None:
        """Register the last TPDO of every SYNC, which may answer a SYNC long before the newest."""
        if self.loop.lockstep and (self.unanswered_syncs > 1 or self._is_catching_up):
            self._caught_up_s = time.monotonic() + CATCH_UP_S
        self._answered = self.cycle

    @property
    def _is_catching_up(self) -> bool:
        return time.monotonic() < self._caught_up_s

    @property
    def is_led(self) -> bool:
        return self.target is not None

    @property
    def is_led_by_other(self) -> bool:
        return self.axis in self.bus.watch.led_by_other

    @property
    def is_stopped_by_other(self) -> bool:
        return self.axis in self.bus.watch.stopped

    @property
    def has_own_offset(self) -> bool:
        return not self.loop.offsets_by_guard and not self.has_foreign_offset

    @property
    def has_foreign_offset(self) -> bool:
        return bool(self._offset_ids & self.bus.watch.sent_by_other)

    @property
    def guard_offset(self) -> int:
        return self.feedback.objects.get(self.profile.offset, 0) if self.loop.guard_runs() else 0

    def ramp_offset_to_zero(self, cycles: int) -> None:
        with self._lock:
            self._landing, start = True, self.offset
            self.feedforward_offsets = None if self.feedforward_offsets is None else (0, 0)
            self._plan = deque(round(start * left / cycles) for left in reversed(range(cycles)))

    def switch_off(self, word: int) -> None:
        self._sends_offset, self.controlword = False, word

    def send_zero_offset(self) -> None:
        for spec in self.profile.rpdos:
            if spec.valid and spec.cob_base + self.node_id in self._offset_ids:
                with suppress(ForeignMaster):  # it sends the offset
                    self.bus.send(spec.cob_base + self.node_id, bytes(spec.length))

    def receive_frame(self, can_id: int, data: bytes) -> None:
        node, feedback, spec = self.node_id, self.feedback, self._tpdos.get(can_id)
        error = bool(can_id & ERROR_FLAG)
        feedback.errors, feedback.frames = feedback.errors + error, feedback.frames + (not error)
        feedback.ids.add(can_id)
        if spec is not None and len(data) >= spec.length:
            if can_id == self._last_answer:
                self._register_answer()
            elif can_id in self._infrequent:  # it follows the last answer to its SYNC
                self._due[can_id] = self._answered + self._infrequent[can_id]
            for entry, value in zip(spec.entries, cia402.unpack_pdo(spec.entries, data), strict=True):
                feedback.objects[entry.index, entry.sub] = value
                feedback.cycle[entry.index, entry.sub] = self.cycle
        elif can_id == self.sdo.response_id:
            self.sdo.deliver_response(data)
        elif can_id == cia402.COB_EMCY + node:
            feedback.emergencies.append(data)
        elif can_id == cia402.COB_HEARTBEAT + node and data:
            feedback.nmt = data[0] & 0x7F
            feedback.boots += feedback.nmt == cia402.Nmt.BOOT_UP
        elif can_id in self._offset_ids and self.loop.offsets_by_guard:
            self.loop.offsets_received.add(can_id)

    # used by the commissioning steps ------------------------------------------------------------------------

    @property
    def cycle(self) -> int:
        """Number of SYNCs sent."""
        return self.loop.count

    @property
    def heartbeat(self) -> bool:
        """Whether fdhil's heartbeat is sent."""
        return self.loop.heartbeat is not None

    @heartbeat.setter
    def heartbeat(self, on: bool) -> None:
        self.loop.heartbeat = self.config.guard.node_id if on else None

    def send_nmt(self, command: cia402.NmtCommand) -> None:
        """Send an NMT command to the drive."""
        self.bus.send(cia402.COB_NMT, bytes([command, self.node_id]))

    def play_offset(self, values: Sequence[int]) -> int:
        """Queue offsets, one per cycle; return the cycle after whose SYNC the first one is sent."""
        with self._lock:
            if not self._landing:
                self._plan.extend(values)
            return self.cycle + 1

    def drop_offsets(self) -> int:
        """Discard the queued offsets; return the last one sent."""
        with self._lock:
            if not self._landing:
                self._plan.clear()
            return self.offset

    @property
    def has_planned_offsets(self) -> bool:
        return bool(self._plan)

    def raise_if_failed(self) -> None:
        """Raise what ended the cycle or the bus."""
        self.loop.raise_if_failed()

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        """Wait until ``condition`` holds; DeviceTimeout with the sentence ``otherwise`` after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s * self.patience
        while not condition():
            self.raise_if_failed()
            if time.monotonic() > deadline:
                raise DeviceTimeout(self.device, otherwise)
            time.sleep(0.002)

    def wait_cycles(self, cycles: int) -> None:
        """Wait for a number of SYNC cycles."""
        goal = self.cycle + cycles
        patience = 20 * cycles * self.period_s + 5.0
        self.wait_until(
            lambda: self.cycle >= goal, patience, "this computer does not keep up with SYNC; stop other programs"
        )

    def hold_position(self) -> None:
        """Use the actual position as target, with offset 0."""
        with self._lock:
            if self._landing:
                return
            self._plan.clear()
            self.offset = 0
            self.target = self.feedback.objects[self.profile.position]

    def average_object(self, key: tuple[int, int], cycles: int) -> float:
        """Return the mean of a mapped object over so many cycles; a computer that sleeps gets fewer of them."""
        before = self.feedback.cycle.get(key, 0)
        gone = f"0x{key[0]:04X} is no longer received; check its TPDO"
        self.wait_until(lambda: self.feedback.cycle.get(key, 0) > before, FIRST_VALUE_S, gone)
        values, seen, end = [self.feedback.objects[key]], self.feedback.cycle[key], self.cycle + cycles
        over = False
        while not over:
            over = self.cycle >= end  # before the last value is read
            if self.feedback.cycle[key] > seen:
                seen = self.feedback.cycle[key]
                values.append(self.feedback.objects[key])
            self.raise_if_failed()
            time.sleep(self.period_s / 2)
        return sum(values) / len(values)

    def get_power_state(self) -> cia402.PowerState:
        """Return the power state of the newest statusword."""
        return cia402.decode_power_state(self.feedback.objects.get(self.profile.statusword, 0))

    def close(self) -> None:
        """Stop sending and release the bus, unless it is shared."""
        if self._own_loop:
            self.loop.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
