"""Record the traffic of a bus, of the NC and of all nodes, while somebody else runs it. Nothing is sent."""

import statistics
import threading
import time
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Self

import numpy as np

from fdhil.cia402 import COB_EMCY, COB_HEARTBEAT, COB_NMT, COB_SDO_REQUEST, COB_SDO_RESPONSE, COB_SYNC, Nmt
from fdhil.drivers import ERROR_FLAG, REMOTE_FLAG, Frames, ListeningBus
from fdhil.errors import ConnectError

LISTEN_S = 2.5  # a heartbeat of one second comes twice
UNREADABLE = (
    "only error frames are received, so the bit rate is probably wrong; nothing was sent, not to disturb the bus; "
    "set the bus's bit rate on the interface, then check termination and wiring"
)
_TURN_S = 0.002
_MASTER_FRAMES = {COB_SYNC: "SYNC", COB_NMT: "NMT commands", 0x7E5: "LSS commands"}
_MASTER_FUNCTIONS = {0x200: "set-points", 0x300: "set-points", 0x400: "set-points", 0x500: "set-points"} | {
    COB_SDO_REQUEST: "SDO requests"
}
_REQUESTS = {COB_HEARTBEAT: "node guarding"}
_NODE_FUNCTIONS = (0x080, 0x180, 0x280, 0x380, 0x480, COB_SDO_RESPONSE, COB_HEARTBEAT)


def classify_master_frame(can_id: int) -> str | None:
    """Return what a frame with this COB-ID, flags included, shows that only a master sends; None if a node may send it.

    >>> classify_master_frame(0x205)
    'set-points'
    """
    if can_id & ~0x7FF == REMOTE_FLAG:
        return _REQUESTS.get(can_id & 0x780, "requests for PDOs")
    if can_id > 0x7FF:
        return None
    return _MASTER_FRAMES.get(can_id) or _MASTER_FUNCTIONS.get(can_id & 0x780)


@dataclass(slots=True)
class BusTraffic:
    """Counts the frames received: per COB-ID with the newest length and data, per node heartbeats and EMCY, and errors.

    ``requests`` are the COB-IDs of remote frames, with their flag.
    """

    count: dict[int, int] = field(default_factory=dict)
    length: dict[int, int] = field(default_factory=dict)
    data: dict[int, int] = field(default_factory=dict)
    beats: dict[int, list[int]] = field(default_factory=dict)
    emergencies: dict[int, set[int]] = field(default_factory=dict)
    sync_ns: list[int] = field(default_factory=list)
    errors: int = 0
    requests: set[int] = field(default_factory=set)

    def add_frames(self, frames: Frames) -> None:
        """Add a block of frames; 29-bit identifiers are ignored, error frames are counted."""
        self.errors += int((frames["id"] & ERROR_FLAG != 0).sum())
        self.requests |= set(frames["id"][frames["id"] & ~np.uint32(0x7FF) == REMOTE_FLAG].tolist())
        for frame in frames[frames["id"] <= 0x7FF]:
            can_id, stamp, data = int(frame["id"]), int(frame["t_ns"]), int(frame["data"])
            function, node = can_id & 0x780, can_id & 0x7F
            self.count[can_id] = self.count.get(can_id, 0) + 1
            self.length[can_id], self.data[can_id] = int(frame["dlc"]), data
            if can_id == COB_SYNC:
                self.sync_ns.append(stamp)
            elif function == COB_EMCY:
                self.emergencies.setdefault(node, set()).add(data & 0xFFFF)
            elif function == COB_HEARTBEAT:
                self.beats.setdefault(node, []).append(stamp)

    @property
    def cob_ids(self) -> tuple[int, ...]:
        """COB-IDs received so far; another thread may add frames meanwhile."""
        return tuple(self.count)

    @property
    def master(self) -> str | None:
        """The evidence that a master runs the bus; None if there is none."""
        signs = [classify_master_frame(can_id) for can_id in (*self.cob_ids, *self.requests)]
        return "SYNC" if self.sync_ns else next((sign for sign in signs if sign), None)

    @property
    def sending_nodes(self) -> set[int]:
        """Node-IDs that have sent a frame."""
        return {i & 0x7F for i in self.cob_ids if i & 0x780 in _NODE_FUNCTIONS and i & 0x7F}

    @property
    def sync_period_s(self) -> float | None:
        """Median SYNC period; None before the second SYNC."""
        return _compute_median_period_s(self.sync_ns)

    def measure_heartbeat_s(self, node_id: int) -> float | None:
        """Return the median period of a node's heartbeat; None before the second one."""
        return _compute_median_period_s(self.beats.get(node_id, []))

    def decode_nmt_state(self, node_id: int) -> str | None:
        """Return the NMT state of a node's newest heartbeat; None without one."""
        data = self.data.get(COB_HEARTBEAT + node_id)
        known = {int(state): state.name.lower().replace("_", "-") for state in Nmt}
        return None if data is None else known.get(data & 0x7F, f"unknown ({data & 0x7F:02X})")


def _compute_median_period_s(stamps_ns: list[int]) -> float | None:
    """Return the median interval, robust against a single late stamp; None for fewer than two stamps."""
    return statistics.median(later - t for t, later in pairwise(stamps_ns)) * 1e-9 if stamps_ns[1:] else None


class BusListener:
    """Records the traffic of a bus in its own thread until it is closed; a context manager."""

    def __init__(self, bus: ListeningBus) -> None:
        self.traffic = BusTraffic()
        self.name = bus.name
        self._bus = bus
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._poll_bus, name=f"fdhil-scan-{bus.name}", daemon=True)
        self._thread.start()

    def _poll_bus(self) -> None:
        while not self._stopping.wait(_TURN_S):
            self.process_frames(self._bus.drain_frames())

    def process_frames(self, frames: Frames) -> None:
        """Process the frames received since the last poll."""
        self.traffic.add_frames(frames)

    def listen_for(self, seconds: float) -> None:
        """Listen for a time; ConnectError if the bus ends meanwhile."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self._bus.end_reason is not None:
                raise ConnectError(f"bus {self.name}", f"{self._bus.end_reason}; try again when the bus is back")
            time.sleep(0.01)

    def require_readable(self) -> None:
        """Raise ConnectError if only error frames are received: the bus uses another bit rate."""
        if self.traffic.errors and not self.traffic.count:
            raise ConnectError(f"bus {self.name}", UNREADABLE)

    def close(self) -> None:
        """Stop listening and release the bus."""
        self._stopping.set()
        self._thread.join(timeout=2.0)
        self._bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
