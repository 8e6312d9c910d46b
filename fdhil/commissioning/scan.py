"""What is on a CAN bus: listening first, and reading by SDO only where no master is heard.

The default SDO channel of a drive has one client at a time, so beside an NC nothing at all is sent. Nothing is ever
written, no NMT command and no SYNC leaves from here.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import TracebackType

from fdhil.cia402 import COB_EMCY, COB_HEARTBEAT, COB_NMT, COB_SDO_REQUEST, COB_SDO_RESPONSE, COB_SYNC, Nmt, Object
from fdhil.commissioning.survey import Identity
from fdhil.config import MachineConfig
from fdhil.drivers.can.bus import CanBus
from fdhil.drivers.can.frames import Frames
from fdhil.drivers.can.node_watch import emcy_text
from fdhil.drivers.can.sdo import SdoLink
from fdhil.drivers.cia402.eds import load_eds
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, EdsError, ProtocolError

LISTEN_S = 2.5  # a heartbeat of one second comes twice
ANSWER_S = 0.3
PACE_S = 0.001
PROFILE_402 = 402
_TURN_S = 0.002
_READ_DEVICE_TYPE = bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0])
_MASTER_FUNCTIONS = {0x200: "set-points", 0x300: "set-points", 0x400: "set-points", 0x500: "set-points"} | {
    COB_SDO_REQUEST: "SDO requests"
}
_NODE_FUNCTIONS = (0x080, 0x180, 0x280, 0x380, 0x480, COB_SDO_RESPONSE, COB_HEARTBEAT)


@dataclass(slots=True)
class Traffic:
    """What was heard: per COB-ID the frames counted, the newest length and data; heartbeats and EMCY per node."""

    count: dict[int, int] = field(default_factory=dict)
    length: dict[int, int] = field(default_factory=dict)
    data: dict[int, int] = field(default_factory=dict)
    beats: dict[int, list[int]] = field(default_factory=dict)
    emergencies: dict[int, set[int]] = field(default_factory=dict)
    sync_ns: list[int] = field(default_factory=list)

    def take(self, frames: Frames) -> None:
        """Take a block of frames; those with 29 bit identifiers and error frames are left aside."""
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
    def master(self) -> str | None:
        """What shows that a master runs the bus, None when nothing does."""
        if self.sync_ns:
            return "SYNC"
        if COB_NMT in self.count:
            return "NMT commands"
        return next((_MASTER_FUNCTIONS[i & 0x780] for i in self.count if i & 0x780 in _MASTER_FUNCTIONS), None)

    @property
    def nodes(self) -> set[int]:
        """Node-IDs that were heard to send."""
        return {i & 0x7F for i in self.count if i & 0x780 in _NODE_FUNCTIONS and i & 0x7F}

    @property
    def sync_period_s(self) -> float | None:
        """Median period of SYNC, None before the second one: a producer or a stamp that was late once says nothing."""
        return statistics.median(later - t for t, later in pairwise(self.sync_ns)) * 1e-9 if self.sync_ns[1:] else None

    def heartbeat_s(self, node_id: int) -> float | None:
        """Mean period of a node's heartbeat, None before the second one."""
        beats = self.beats.get(node_id, [])
        return (beats[-1] - beats[0]) / (len(beats) - 1) * 1e-9 if len(beats) > 1 else None

    def nmt(self, node_id: int) -> str | None:
        """The NMT state of a node's newest heartbeat, None without one."""
        data = self.data.get(COB_HEARTBEAT + node_id)
        known = {int(state): state.name.lower().replace("_", "-") for state in Nmt}
        return None if data is None else known.get(data & 0x7F, f"unknown ({data & 0x7F:02X})")


class BusListener:
    """A bus that is listened to and, where no master is heard, asked; a context manager."""

    def __init__(self, name: str, config: MachineConfig) -> None:
        self.traffic = Traffic()
        self.name = name
        self._bus = CanBus(name, config.bus[name], transmit=True)
        self._links: dict[int, SdoLink] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._turn, name=f"fdhil-scan-{name}", daemon=True)
        self._thread.start()

    def _turn(self) -> None:
        while not self._stopping.wait(_TURN_S):
            frames = self._bus.drain()
            self.traffic.take(frames)
            for frame in frames[(frames["id"] & 0x780 == COB_SDO_RESPONSE) & (frames["id"] <= 0x7FF)]:
                if link := self._links.get(int(frame["id"]) & 0x7F):
                    link.deliver(int(frame["data"]).to_bytes(8, "little")[: int(frame["dlc"])])

    def listen(self, seconds: float) -> None:
        """Listen without sending; ConnectError when the bus ends meanwhile."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self._bus.ended is not None:
                raise ConnectError(f"bus {self.name}", f"{self._bus.ended}; try again when the bus is back")
            time.sleep(0.01)

    def answering(self) -> set[int]:
        """Ask every node-ID for its device type; return those that answer.

        ConnectError when the bus takes no frame, which means that no node acknowledges one.
        """
        for node_id in range(1, 128):
            self.require_alone()
            try:
                self._bus.send(COB_SDO_REQUEST + node_id, _READ_DEVICE_TYPE)
            except DeviceError as error:
                text = f"nothing acknowledges our frames ({error}); check the drives' supply, wiring and bit rate"
                raise ConnectError(f"bus {self.name}", text) from None
            time.sleep(PACE_S)
        self.listen(ANSWER_S)
        return {can_id & 0x7F for can_id in self.traffic.count if can_id & 0x780 == COB_SDO_RESPONSE}

    def require_alone(self) -> None:
        """ProtocolError when a master came on the bus: it alone may use SDO then."""
        if self.traffic.master is not None:
            text = f"an NC came on the bus ({self.traffic.master}) while drives were asked; start again"
            raise ProtocolError(f"bus {self.name}", text)

    def read(self, node_id: int, index: int, sub: int = 0) -> bytes | None:
        """Read an object, None when the node does not have it or gives no answer that can be used."""
        self.require_alone()
        link = self._links.setdefault(node_id, SdoLink(f"node {node_id}", node_id, self._bus.send))
        try:
            return link.read(index, sub)
        except (ProtocolError, DeviceTimeout):
            return None

    def close(self) -> None:
        """Stop listening and release the bus."""
        self._stopping.set()
        self._thread.join(timeout=2.0)
        self._bus.close()

    def __enter__(self) -> BusListener:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class Description:
    """An EDS or DCF file and the device it is for."""

    path: Path
    vendor_id: int | None
    product_code: int | None
    revision: int | None

    def fits(self, identity: Identity) -> str | None:
        """``exact``, ``other revision``, or None when it is for another device."""
        if (self.vendor_id, self.product_code) != (identity.vendor_id, identity.product_code):
            return None
        return "exact" if self.revision in (None, identity.revision) else "other revision"


@dataclass(frozen=True, slots=True)
class EdsMatch:
    """The description that fits a node best; ``fit`` is ``exact`` or ``other revision``."""

    file: str
    fit: str


@dataclass(frozen=True, slots=True)
class Answers:
    """What a node answered by SDO; None where it has no such object."""

    identity: Identity
    device_type: int
    name: str | None
    hardware: str | None
    software: str | None
    heartbeat_s: float | None
    supported_modes: int | None
    eds: EdsMatch | None

    @property
    def is_drive(self) -> bool:
        """Whether its device profile is CiA 402."""
        return self.device_type & 0xFFFF == PROFILE_402


@dataclass(frozen=True, slots=True)
class Node:
    """One node: what was heard of it, and what it answered (None: it was not asked, or is silent)."""

    node_id: int
    axis: str | None
    nmt: str | None
    heartbeat_s: float | None
    emergencies: tuple[str, ...]
    answers: Answers | None


@dataclass(frozen=True, slots=True)
class BusScan:
    """One bus; ``master`` tells what showed that an NC runs it, and then no node was asked."""

    bus: str
    master: str | None
    sync_period_s: float | None
    nodes: tuple[Node, ...]


def scan_bus(name: str, config: MachineConfig, descriptions: Sequence[Description]) -> BusScan:
    """Listen, then ask where no master is heard. ConnectError when the bus cannot be reached or is silent."""
    axes = {config.node_id(axis): axis for axis, settings in config.axis.items() if settings.drive.bus == name}
    with BusListener(name, config) as ear:
        ear.listen(LISTEN_S)
        master = ear.traffic.master
        answering = set() if master else ear.answering()
        found = sorted(ear.traffic.nodes | answering)
        if not found and master is None:
            text = "no node was heard and none answered; check the drives' supply, wiring and bit rate"
            raise ConnectError(f"bus {name}", text)
        asked = {node_id: _ask(ear, node_id, descriptions) for node_id in sorted(answering)}
        nodes = [_node(ear.traffic, node_id, axes.get(node_id), asked.get(node_id)) for node_id in found]
        return BusScan(name, master, ear.traffic.sync_period_s, tuple(nodes))


def _node(traffic: Traffic, node_id: int, axis: str | None, answers: Answers | None) -> Node:
    codes = sorted(traffic.emergencies.get(node_id, set()) - {0})
    told = tuple(f"{code:04X} {emcy_text(code)}" for code in codes)
    return Node(node_id, axis, traffic.nmt(node_id), traffic.heartbeat_s(node_id), told, answers)


def _ask(ear: BusListener, node_id: int, descriptions: Sequence[Description]) -> Answers:
    def number(index: int, sub: int = 0) -> int | None:
        data = ear.read(node_id, index, sub)
        return None if data is None else int.from_bytes(data, "little")

    def text(index: int) -> str | None:
        data = ear.read(node_id, index)
        return None if data is None else printable(data)

    identity = Identity(*(number(Object.IDENTITY, sub) or 0 for sub in (1, 2, 3, 4)))
    fits = [(description.fits(identity), description.path.name) for description in descriptions]
    best = min((EdsMatch(name, fit) for fit, name in fits if fit is not None), key=lambda m: m.fit, default=None)
    period_ms = number(Object.PRODUCER_HEARTBEAT)
    return Answers(
        identity=identity,
        device_type=number(Object.DEVICE_TYPE) or 0,
        name=text(Object.DEVICE_NAME),
        hardware=text(Object.HARDWARE_VERSION),
        software=text(Object.SOFTWARE_VERSION),
        heartbeat_s=None if period_ms is None else period_ms * 1e-3,
        supported_modes=number(Object.SUPPORTED_MODES),
        eds=best,
    )


def printable(data: bytes) -> str:
    """Return a drive's text with whatever could steer a terminal shown as ``?``.

    >>> printable(b"axis\\x1b[2J\\0")
    'axis?[2J'
    """
    text = data.rstrip(b"\0").decode("utf-8", "replace")[:80]
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def read_descriptions(places: Sequence[Path]) -> tuple[list[Description], list[EdsError]]:
    """Read EDS and DCF files, and those in folders; returns them and what could not be read."""
    files = [f for place in places for f in (sorted(place.iterdir()) if place.is_dir() else [place])]
    found, faults = [], []
    for path in files:
        if path in places or path.suffix.lower() in (".eds", ".dcf"):
            try:
                device = load_eds(path).device_information
            except EdsError as error:
                faults.append(error)
            else:
                found.append(Description(path, device.vendor_number, device.product_number, device.revision_number))
    return found, faults
