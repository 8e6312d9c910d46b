"""Monitors a node by its EMCY, boot-up, heartbeat and NMT state. Pure: ``now_ns`` comes from the caller.

The canopen library is not used here: it drops an EMCY shorter than 8 bytes, never notices that a heartbeat stopped, and
assumes that an NMT command took effect as soon as it was sent.
"""

from itertools import pairwise
from typing import Literal

import numpy as np

from fdhil.cia402 import COB_EMCY, COB_HEARTBEAT, Nmt, describe_emergency
from fdhil.drivers.can.frame_ring import Frames
from fdhil.records import Notice

_MAX_EMCY_CODES = 32
_HEARTBEATS_TO_LEARN = 3
_BACK_NS = 2_000_000_000  # of regular heartbeats until an outage has ended
# COB-IDs that a node sends by CiA 301's predefined set: EMCY, TPDO1 to 4, SDO answers, heartbeat
_OWN_COB_IDS = (0x080, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700)
_TOGGLE = 0x80  # toggle bit of node guarding; always 0 in a heartbeat
_NMT_STATES = frozenset(int(state) for state in Nmt)


class NodeMonitor:
    """Monitors one node; reports each change once."""

    def __init__(self, axis: str, node_id: int) -> None:
        self._axis = axis
        self._node_id = node_id
        self.nmt: Nmt | None = None
        self.emcy_count = 0
        self.boots = 0
        self._codes: set[int] = set()
        self._beats: list[int] = []
        self._lost = False
        self._period_ns = 0
        self._back_since_ns: int | None = None
        self._guarded = False
        self._own_ids = np.array([cob_id + node_id for cob_id in _OWN_COB_IDS], dtype=np.uint32)
        self.received_frames = 0

    def watch_frames(self, frames: Frames, now_ns: int) -> list[Notice]:
        """Take a block of frames; ``now_ns`` is the host's monotonic time."""
        notices = []
        self.received_frames += int(np.count_nonzero(np.isin(frames["id"], self._own_ids)))
        for frame in frames[frames["id"] == COB_EMCY + self._node_id]:
            notices += self._handle_emergency(int(frame["dlc"]), int(frame["data"]))
        for frame in frames[frames["id"] == COB_HEARTBEAT + self._node_id]:
            self._guarded |= bool(int(frame["data"]) & _TOGGLE)
            notices += self._handle_heartbeat(int(frame["data"]) & 0x7F, int(frame["t_ns"]))
        return notices + self._check_silence(now_ns)

    def _make_notice(self, code: str, severity: Literal["info", "minor", "MAJOR"], text: str) -> Notice:
        return Notice(code, severity, f"Drive {self._axis} {text}", self._axis)

    def _handle_emergency(self, length: int, data: int) -> list[Notice]:
        self.emcy_count += 1
        code = data & 0xFFFF if length >= 2 else 0x1000
        if code >> 8 == 0:
            self._codes.clear()
            return [self._make_notice("DriveEmergency", "info", "reports no error any more.")]
        if code in self._codes or len(self._codes) >= _MAX_EMCY_CODES:
            return []
        self._codes.add(code)
        detail = (data & (1 << 8 * length) - 1).to_bytes(8, "little")[:length].hex(" ")
        text = f"reports error {code:04X} ({describe_emergency(code)}; {detail}); look it up in the drive's manual."
        return [self._make_notice("DriveEmergency", "MAJOR", text)]

    def _handle_heartbeat(self, state: int, t_ns: int) -> list[Notice]:
        notices = []
        if state == Nmt.BOOT_UP:
            self.boots += 1
            self._beats, self._back_since_ns = [], None  # an outage that seemed to end continues
            text = "rebooted: its offset and set-up are unknown; check its supply and commission it again."
            notices.append(self._make_notice("NodeRebooted", "MAJOR", text))
        elif self.nmt is Nmt.OPERATIONAL and state != Nmt.OPERATIONAL:
            text = "left the NMT state Operational: it accepts no set-points; check the NC."
            notices.append(self._make_notice("NmtStateWrong", "MAJOR", text))
        if self._lost:
            notices += self._confirm_recovery(t_ns)
        self._beats = [*self._beats, t_ns][-_HEARTBEATS_TO_LEARN - 1 :]
        self.nmt = Nmt(state) if state in _NMT_STATES else self.nmt
        return notices

    def _confirm_recovery(self, t_ns: int) -> list[Notice]:
        if self._back_since_ns is None or t_ns - self._beats[-1] > self._compute_longest_gap_ns():
            self._back_since_ns, self._beats = t_ns, []
            return []
        if t_ns - self._back_since_ns < _BACK_NS:
            return []
        self._lost, self._back_since_ns = False, None
        return [self._make_notice("HeartbeatLost", "info", "sends its heartbeat again.")]

    def _compute_longest_gap_ns(self) -> int:
        """Return three learned periods and 0.1 s; the longest period counts, since some arrive in a burst."""
        return 3 * self._period_ns + 100_000_000

    def _check_silence(self, now_ns: int) -> list[Notice]:
        """Report a heartbeat that stopped; a node that sends none, or only when guarded by the NC, is not judged."""
        if self._lost or self._guarded or len(self._beats) <= _HEARTBEATS_TO_LEARN:
            return []
        self._period_ns = max(b - a for a, b in pairwise(self._beats))
        if now_ns - self._beats[-1] <= self._compute_longest_gap_ns():
            return []
        self._lost = True
        text = "no longer sends its heartbeat and may be dead; check its supply and the bus."
        return [self._make_notice("HeartbeatLost", "MAJOR", text)]
