"""Gathers CAN frames into the inputs of the core at a SYNC: pure bookkeeping, no socket, no clock.

A TPDO is sampled at a SYNC and arrives after it, so that at the next SYNC it is one cycle old. The target that a SYNC
latches is the last one that arrived before it.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from fdhil.cia402 import (
    COB_EMCY,
    COB_HEARTBEAT,
    COB_NMT,
    COB_SDO_REQUEST,
    COB_SYNC,
    Nmt,
    NmtCommand,
    Object,
    compute_pdo_length,
    describe_emergency,
    get_first_axis_index,
    unpack_pdo,
)
from fdhil.guard.guard_settings import AxisSettings, GuardSettings, Pdo
from fdhil.guard.guard_state import AxisInput, BusView
from fdhil.guard.interlocks import Alarm

INF = float("inf")
NEVER = 1 << 30
INTERVALS = 32
FOREIGN_CYCLES = 3
FED = frozenset({Object.VELOCITY_OFFSET, Object.TORQUE_OFFSET})
_NEEDED = frozenset({Object.STATUSWORD, Object.POSITION_ACTUAL, Object.MODE_DISPLAY})
PDO_SET_UP = range(0x1400, 0x1C00)
# other objects that a commissioning record relies on: options, scale, cycle, "restore the defaults"
SET_UP = frozenset((0x1005, 0x1011, 0x1016, 0x1017, 0x6007, 0x605A, 0x605E, 0x6065, 0x6066, 0x6075, 0x607D, 0x607E))
SET_UP |= {0x6085, 0x608F, 0x6091, 0x6092, 0x60C2}


class _PdoState:
    """A received PDO: its last content, its age in SYNC cycles, and what is wrong with it.

    ``early``: it came again long before it was due, ``twice``: with different content; ``sure_age``: age of the last
    one that came when due.
    """

    def __init__(self, pdo: Pdo) -> None:
        self.entries = pdo.entries
        self.length = compute_pdo_length(self.entries)
        self.every_sync = max(1, pdo.every_sync)
        self.where = {entry.index: k for k, entry in enumerate(self.entries) if entry.sub == 0}
        self.needed = bool(_NEEDED & self.where.keys())
        self.data = b""
        self.values: tuple[int, ...] = ()
        self.age = self.sure_age = NEVER
        self.fresh = self.early = self.twice = False
        self.twice_run = self.short = self.long = 0

    def take_frame(self, data: bytes) -> None:
        """Take one frame: drop and count a short one; of a long one use the mapped bytes."""
        if len(data) < self.length:
            self.short += 1
            return
        self.long += len(data) > self.length
        self.short = 0
        if self.fresh and data == self.data:
            return
        if 2 * self.age <= self.every_sync:
            self.early = True
            self.twice = self.twice or data != self.data
        self.fresh, self.age = True, 0
        if data != self.data:
            self.data, self.values = data, unpack_pdo(self.entries, data)  # decoded now: at the SYNC there is no time

    def close_cycle(self) -> None:
        """Age by one cycle."""
        if self.fresh:
            self.twice_run = self.twice_run + 1 if self.twice else 0
        self.age += 1
        self.sure_age = 1 if self.fresh and not self.early else self.sure_age + 1


_Place = tuple[_PdoState, int]
_ABSENT: _Place = _PdoState(Pdo(0, ())), 0  # for an object that no PDO carries
# the signals of a drive, in the order in which they are unpacked below
_SIGNALS = (
    Object.POSITION_ACTUAL, Object.POSITION_OFFSET, Object.FOLLOWING_ERROR, Object.STATUSWORD, Object.MODE_DISPLAY,
    Object.VELOCITY_OFFSET, Object.TORQUE_OFFSET, Object.VELOCITY_ACTUAL, Object.POSITION_DEMAND,
)  # fmt: skip


@dataclass(slots=True)
class _NodeState:
    nmt: int | None = None
    heartbeat_at_s: float = -INF
    touched: int = 0


class FrameMonitor:
    """Gathers frames (``take_frame``) and returns the axes' inputs and the bus state at a SYNC (``close_sync_cycle``).

    The bus does not return what we send ourselves: a frame with one of our COB-IDs comes from another node.
    """

    def __init__(self, settings: GuardSettings) -> None:
        self.settings = settings
        self.bus_state = "active"
        self.lost_frames = self.emergencies = 0
        self._sent_ids = settings.sent_ids
        self._writers = {cob_id: axis.name for axis in settings.axes for cob_id in axis.writers}
        targets = [_PdoState(axis.target) for axis in settings.axes]
        self._tpdos = [[_PdoState(pdo) for pdo in axis.tpdos] for axis in settings.axes]
        self._signals = [[places.get(i, _ABSENT) for i in _SIGNALS] for places in map(_locate_objects, self._tpdos)]
        self._target_of = [_locate_objects([target]).get(Object.TARGET_POSITION, _ABSENT) for target in targets]
        self._pdos_of = [(target, *tpdos) for target, tpdos in zip(targets, self._tpdos, strict=True)]
        self._pdos: dict[int, _PdoState] = {}
        for axis, pdos in zip(settings.axes, self._pdos_of, strict=True):
            self._pdos.update(zip([pdo.cob_id for pdo in (axis.target, *axis.tpdos)], pdos, strict=True))
        self._nodes = [_NodeState() for _ in settings.axes]
        nodes = [axis.node_id for axis in settings.axes]
        self._axes_of = {node: [k for k, of in enumerate(nodes) if of == node] for node in nodes}  # one or more
        self._alarms: dict[tuple[str, str], Alarm] = {}
        self._counter: int | None = None
        self._last_sync_s: tuple[float, float] | None = None
        self._intervals: deque[float] = deque(maxlen=INTERVALS)

    def list_received_ids(self) -> tuple[int, ...]:
        """Return all COB-IDs that the guard needs, for a receive filter."""
        ids = {base + node for node in self._axes_of for base in (COB_EMCY, COB_HEARTBEAT, COB_SDO_REQUEST)}
        return tuple(sorted(ids | {COB_NMT, COB_SYNC, *self._pdos, *self._sent_ids, *self._writers}))

    def take_frame(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Take any frame except SYNC; ``now_s`` is monotonic time."""
        pdo = self._pdos.get(cob_id)
        if pdo is not None:
            pdo.take_frame(data)
        elif cob_id in self._sent_ids:
            code = "BusLocked" if cob_id >= COB_HEARTBEAT else "OffsetHijack"
            self._raise_alarm(Alarm(code, detail=f"{cob_id:03X} {data.hex()}"))
        elif cob_id in self._writers:
            self._raise_alarm(Alarm("OffsetHijack", self._writers[cob_id], f"{cob_id:03X} {data.hex()}"))
        elif cob_id == COB_NMT:
            self._check_nmt_command(data)
        else:
            for axis in self._axes_of.get(cob_id & 0x7F, ()):
                self._take_node_frame(cob_id & 0x780, axis, data, now_s)

    def _take_node_frame(self, service: int, axis: int, data: bytes, now_s: float) -> None:
        if service == COB_SDO_REQUEST:
            self._check_sdo_request(axis, data)
        elif service == COB_HEARTBEAT:
            self._take_heartbeat(axis, data, now_s)
        elif service == COB_EMCY:
            self._take_emergency(axis, data)

    def set_controller_state(self, state: str) -> None:
        """Set the controller's state: active, warning, passive, off, down or restarted."""
        if state == "restarted":
            self._raise_alarm(Alarm("BusRestarted"))
            state = "active"
        self.bus_state = state

    def _raise_alarm(self, alarm: Alarm) -> None:
        self._alarms.setdefault((alarm.code, alarm.axis), alarm)  # a flood is one alarm

    def _check_nmt_command(self, data: bytes) -> None:
        if len(data) < 2 or data[0] == NmtCommand.START:
            return
        for axis in self.settings.axes:
            if data[1] in (0, axis.node_id):
                self._raise_alarm(Alarm("NmtStateWrong", axis.name, f"NMT command {data[0]:02X}"))

    def _take_heartbeat(self, axis: int, data: bytes, now_s: float) -> None:
        if len(data) != 1:
            return
        node, state = self._nodes[axis], data[0] & 0x7F
        node.nmt, node.heartbeat_at_s = state, now_s
        if state == Nmt.BOOT_UP:
            node.touched += 1
            self._raise_alarm(Alarm("NodeRebooted", self.settings.axes[axis].name))

    def _check_sdo_request(self, axis: int, data: bytes) -> None:
        """Detect a write to the drive by any master (CiA 301 7.2.4, initiate download, plain or block)."""
        if len(data) < 4 or not (data[0] >> 5 == 1 or data[0] & 0xE1 == 0xC0):
            return
        index, of = get_first_axis_index(int.from_bytes(data[1:3], "little")), self.settings.axes[axis]
        if index == Object.POSITION_OFFSET or (of.feedforward is not None and index in FED):
            self._raise_alarm(Alarm("OffsetHijack", of.name, f"by SDO, {data.hex()}"))
        elif index in SET_UP or index in PDO_SET_UP:
            self._nodes[axis].touched += 1

    def _take_emergency(self, axis: int, data: bytes) -> None:
        code = int.from_bytes(data[:2], "little")
        if code >> 8 == 0 and len(data) >= 2:  # error reset or no error
            return
        self.emergencies += 1
        self._raise_alarm(
            Alarm(
                "DriveEmergency",
                self.settings.axes[axis].name,
                f"{code:04X}: {describe_emergency(code)}; data {data.hex()}",
            )
        )

    def receive_at_sync(self, data: bytes, stamp_s: float, now_s: float) -> tuple[tuple[AxisInput, ...], BusView]:
        """Close the cycle at a SYNC with its frame time ``stamp_s``; return the inputs of the axes and of the bus."""
        self._check_sync_counter(data)
        regular = self._is_sync_regular(stamp_s, now_s)
        axes = tuple([self._close_axis_cycle(k, axis, now_s) for k, axis in enumerate(self.settings.axes)])
        lost, self.lost_frames = self.lost_frames, 0
        return axes, BusView(self.bus_state, regular, silent=False, lost_frames=lost)

    def read_between_syncs(self, now_s: float, silent: bool) -> tuple[tuple[AxisInput, ...], BusView]:
        """Return the same between two SYNC, without closing a cycle."""
        axes = [self._read_axis_input(k, axis, now_s, None) for k, axis in enumerate(self.settings.axes)]
        return tuple(axes), BusView(self.bus_state, sync_regular=False, silent=silent)

    def take_alarms(self) -> tuple[Alarm, ...]:
        """Return and forget the events since the last call."""
        alarms, self._alarms = tuple(self._alarms.values()), {}
        return alarms

    @property
    def counter(self) -> int:
        """The counter of the last SYNC, 0 where it has none."""
        return self._counter or 0

    def forget_sync(self) -> None:
        """Start a new series of SYNC after a silence."""
        self._counter = self._last_sync_s = None
        self._intervals.clear()

    def _check_sync_counter(self, data: bytes) -> None:
        if len(data) != 1:
            self._counter = None
            return
        before, self._counter = self._counter, data[0]
        if before is None or data[0] == before + 1 or (data[0] == 1 and before >= 2):
            return
        if before < data[0] <= before + 3:
            self._raise_alarm(Alarm("RxOverflow", detail=f"SYNC {before} to {data[0]}"))
        else:
            self._raise_alarm(Alarm("SyncCollision", detail=f"SYNC {before} to {data[0]}"))

    def _is_sync_regular(self, stamp_s: float, now_s: float) -> bool:
        """Return whether SYNC is regular: no interval above three periods, the median of the last within 2 %.

        Both the frame's stamp and its arrival are evaluated and the better one counts: a late reader corrupts the
        arrival, a wall clock that is set corrupts the stamp, and neither is a fault of the bus.
        """
        last, self._last_sync_s = self._last_sync_s, (stamp_s, now_s)
        if last is None:
            return False
        period = self.settings.sync_period_s
        if self.settings.clock == "sync":
            return True
        interval = min(stamp_s - last[0], now_s - last[1], key=lambda seconds: abs(seconds - period))
        self._intervals.append(interval)
        typical = median(self._intervals)
        return not (interval > 3 * period or not abs(typical - period) <= 0.02 * period)

    def _close_axis_cycle(self, k: int, axis: AxisSettings, now_s: float) -> AxisInput:
        target = _get_fresh_value(*self._target_of[k])
        for pdo in self._pdos_of[k]:
            pdo.close_cycle()
            if pdo.twice_run >= FOREIGN_CYCLES:
                self._raise_alarm(Alarm("ForeignProducer", axis.name))
        seen = self._read_axis_input(k, axis, now_s, target)
        for pdo in self._pdos_of[k]:
            pdo.fresh = pdo.early = pdo.twice = False
        return seen

    def _read_axis_input(self, k: int, axis: AxisSettings, now_s: float, target: int | None) -> AxisInput:
        tpdos, node = self._tpdos[k], self._nodes[k]
        position, read_back, error, statusword, mode, speed_offset, torque_offset, speed, demand = self._signals[k]
        shown = read_back[0]
        return AxisInput(
            target,
            _get_fresh_value(*position),
            None if shown.early else _get_fresh_value(*read_back),
            _get_fresh_value(*error),
            _get_last_value(*statusword),
            _get_last_value(*mode),
            node.nmt,
            _find_oldest_feedback_age(tpdos),
            now_s - node.heartbeat_at_s,
            max([pdo.short for pdo in tpdos], default=0),
            max([pdo.long for pdo in tpdos], default=0),
            (_get_fresh_value(*speed_offset), _get_fresh_value(*torque_offset)),
            _get_fresh_value(*speed),
            -(-shown.sure_age // shown.every_sync),
            _get_fresh_value(*demand),
            node.touched,
            shown.early,
        )


def _locate_objects(pdos: Sequence[_PdoState]) -> dict[int, _Place]:
    """Return each object's entry in the most frequent PDO that carries it."""
    rarest_first = sorted(pdos, key=lambda pdo: -pdo.every_sync)
    return {index: (pdo, place) for pdo in rarest_first for index, place in pdo.where.items()}


def _get_fresh_value(pdo: _PdoState, place: int) -> int | None:
    return pdo.values[place] if pdo.fresh else None


def _get_last_value(pdo: _PdoState, place: int) -> int | None:
    return pdo.values[place] if pdo.values else None


def _find_oldest_feedback_age(pdos: Sequence[_PdoState]) -> float:
    """Return the age of the oldest TPDO that carries a signal of the guard, in units of its own period, rounded up."""
    return max([-(-pdo.age // pdo.every_sync) for pdo in pdos if pdo.needed], default=NEVER)
