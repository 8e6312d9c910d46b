"""Detect another master on a bus that fdhil sends on, and decide which frames may still be sent.

Every received frame passes :meth:`BusWatch.take` before any other reader, every sent one :meth:`BusWatch.admit`, so
that commissioning, playback and comparison need no check of their own for another master.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from fdhil import cia402
from fdhil.commissioning.traffic_listener import classify_master_frame
from fdhil.config import MachineConfig
from fdhil.drivers import DriveProfile, FrameRing, load_profile
from fdhil.errors import ConfigError, EdsError, ForeignMaster

_DOWNLOAD = 1  # command specifier of an SDO request that writes (CiA 301, 7.2.4.3.3)


class BusWatch:
    """Tracks another master on one bus.

    ``sign`` is the first frame of another master, None without one; it is never cleared. ``sent_by_other`` are the
    COB-IDs it sent, ``is_led_by_other`` the axes whose set-points it sends or whose node it stopped by NMT; ``stopped``
    are those it has not started since. ``written`` are the objects that fdhil wrote, by node-ID and index. One thread
    adds received frames, any thread may send.
    """

    def __init__(self, name: str, guard_runs: Callable[[], bool] = lambda: False) -> None:
        self.name = name
        self._guard_runs = guard_runs
        self.sign: str | None = None
        self.led_by_other: frozenset[str] = frozenset()
        self.stopped: frozenset[str] = frozenset()
        self.written: set[tuple[int, int]] = set()
        self._first_id = self._syncs = self._syncs_before = 0
        self.sent_by_other: set[int] = set()
        self._sent: set[int] = set()
        self._harmless: set[int] = set()
        self._own: set[int] = set()
        self._axis_of: dict[int, str] = {}
        self._node_of: dict[str, int] = {}
        self._offsets: set[int] = set()

    @classmethod
    def create_from_config(
        cls, name: str, config: MachineConfig, guard_runs: Callable[[], bool] = lambda: False
    ) -> BusWatch:
        """Return the watch of a bus with the drives of a configuration; a running guard may send their offsets."""
        watch = cls(name, guard_runs)
        for axis, settings in config.axis.items():
            if settings.drive.bus != name:
                continue
            try:
                profile = load_profile(settings.drive)
            except (ConfigError, EdsError):  # not controllable; its node is watched by the predefined identifiers
                continue
            watch._add_drive(axis, profile, config.get_node_id(axis))
            if settings.table is not None and settings.table.cob_id is not None:
                watch._own.add(settings.table.cob_id)
        return watch

    def _add_drive(self, axis: str, profile: DriveProfile, node_id: int) -> None:
        self._node_of[axis] = node_id
        self._own |= {spec.cob_base + node_id for spec in profile.tpdos}
        offsets = set(find_offset_cob_ids(profile, node_id))
        self._offsets |= offsets
        self._axis_of |= dict.fromkeys({spec.cob_base + node_id for spec in profile.rpdos} - offsets, axis)

    def inspect_received(self, can_id: int, data: bytes) -> None:
        """Inspect a received frame; ``can_id`` includes its flags."""
        if can_id in self._harmless and can_id not in self._sent:
            return
        sign = self._classify_frame(can_id)
        if sign is None:
            if can_id <= 0x7FF and can_id not in self._offsets:
                self._harmless.add(can_id)
            return
        self._syncs += can_id == cia402.COB_SYNC
        self.sent_by_other.add(can_id)
        if can_id in self._axis_of:
            self.led_by_other |= {self._axis_of[can_id]}
        elif can_id == cia402.COB_NMT and len(data) > 1:
            self._track_nmt_command(data[0], data[1])
        if self.sign is None:
            self._first_id, self.sign = can_id, sign

    def _track_nmt_command(self, command: int, node_id: int) -> None:
        axes = {axis for axis, node in self._node_of.items() if node_id in (0, node)}
        if command == cia402.NmtCommand.START:
            self.stopped -= axes
        elif command in tuple(cia402.NmtCommand):  # a node that is not operational ignores PDOs
            self.stopped |= axes
            self.led_by_other |= axes

    def _classify_frame(self, can_id: int) -> str | None:
        if can_id in self._own:
            return None
        if can_id in self._offsets:
            return None if self._guard_runs() else "offsets"
        if can_id in self._axis_of:
            return "set-points"
        return classify_master_frame(can_id) or ("with identifiers of fdhil" if can_id in self._sent else None)

    def has_new_sync(self) -> bool:
        """Return whether another master has sent SYNC since the last call."""
        before, self._syncs_before = self._syncs_before, self._syncs
        return self._syncs_before > before

    def require_send_allowed(self, can_id: int, data: bytes) -> None:
        """Register a frame that is about to be sent; ForeignMaster if another master forbids it."""
        if not self.may_send(can_id):
            raise self.build_refusal("nothing more was sent")
        self._sent.add(can_id)
        if can_id & ~0x7F == cia402.COB_SDO_REQUEST and data[0] >> 5 == _DOWNLOAD:
            self.written.add((can_id & 0x7F, int.from_bytes(data[1:3], "little")))

    def may_send(self, can_id: int) -> bool:
        """Return whether a frame may be sent: with another master only what stops a drive that it does not control."""
        if self.sign is None or can_id == cia402.COB_SYNC or can_id & ~0x7F == cia402.COB_HEARTBEAT:
            return True
        axis = self._axis_of.get(can_id)
        return axis not in self.led_by_other if axis else can_id in self._offsets - self.sent_by_other

    def build_refusal(self, outcome: str) -> ForeignMaster:
        """Return the exception to raise; ``outcome`` describes how the drives were left."""
        sends = "SYNC or set-points" if self.sign in ("SYNC", "set-points") else self.sign
        text = f"an NC is sending {sends}; switch it off while fdhil acts on the bus, then start again"
        return ForeignMaster(
            f"bus {self.name}", f"{text}: {outcome} (first frame: COB-ID {self._first_id & 0x7FF:03X})"
        )


def find_offset_cob_ids(profile: DriveProfile, node_id: int) -> Iterator[int]:
    """Yield the COB-IDs of the RPDOs that carry offsets (sent by a guard) but no target."""
    offsets = {profile.offset, profile.speed_offset, profile.torque_offset}
    for spec in profile.rpdos:
        keys = {(entry.index, entry.sub) for entry in spec.entries}
        if keys & offsets and profile.target not in keys:
            yield spec.cob_base + node_id


class WatchedRing(FrameRing):
    """Passes each frame to a watch before it can be read."""

    def __init__(self, capacity: int, watch: BusWatch) -> None:
        super().__init__(capacity)
        self._watch = watch

    def append_frame(self, t_ns: int, can_id: int, data: bytes) -> None:
        """Store one frame (writer's side only)."""
        self._watch.inspect_received(can_id, data)
        super().append_frame(t_ns, can_id, data)
