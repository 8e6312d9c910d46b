"""List the nodes of a CAN bus: listen first, and read by SDO only if no master is detected.

A drive's default SDO channel has one client at a time, so with an NC on the bus nothing at all is sent. Nothing is ever
written, and neither NMT commands nor SYNC are sent.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fdhil.cia402 import COB_SDO_REQUEST, COB_SDO_RESPONSE, Object, describe_emergency
from fdhil.commissioning.device_type import is_cia402_drive
from fdhil.commissioning.drive_survey import DeviceIdentity
from fdhil.commissioning.traffic_listener import LISTEN_S, BusListener, BusTraffic
from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import CanBus, MachineConfig
from fdhil.drivers import Frames, SdoChannel
from fdhil.eds import read_eds
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, EdsError, ForeignMaster, ProtocolError

ANSWER_S = 0.3
PACE_S = 0.001
FITS = ("exact", "other revision", "any product")
_ANY_NUMBER = 0xFFFFFFFF  # marks an EDS for all products of the vendor; others omit the number
_READ_DEVICE_TYPE = bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0])


class BusScanner(BusListener):
    """Listens to a bus and, if no master is detected, reads its nodes; a context manager."""

    def __init__(self, name: str, settings: CanBus) -> None:
        self._links: dict[int, SdoChannel] = {}
        self._sending = TransmitBus(name, settings)
        super().__init__(self._sending)

    def process_frames(self, frames: Frames) -> None:
        """Deliver the answers to pending requests."""
        super().process_frames(frames)
        for frame in frames[(frames["id"] & 0x780 == COB_SDO_RESPONSE) & (frames["id"] <= 0x7FF)]:
            if link := self._links.get(int(frame["id"]) & 0x7F):
                link.deliver_response(int(frame["data"]).to_bytes(8, "little")[: int(frame["dlc"])])

    def find_answering_nodes(self) -> set[int]:
        """Request the device type of every node-ID; return the nodes that answer.

        ConnectError if the bus accepts no frame, which means that no node acknowledges one.
        """
        for node_id in range(1, 128):
            try:
                self._sending.send(COB_SDO_REQUEST + node_id, _READ_DEVICE_TYPE)
            except ForeignMaster:
                raise
            except DeviceError as error:
                text = f"no node acknowledges fdhil's frames ({error}); check the drives' supply, wiring and bit rate"
                raise ConnectError(f"bus {self.name}", text) from None
            time.sleep(PACE_S)
        self.listen_for(ANSWER_S)
        return {can_id & 0x7F for can_id in self.traffic.cob_ids if can_id & 0x780 == COB_SDO_RESPONSE}

    def read_object(self, node_id: int, index: int, sub: int = 0) -> bytes | None:
        """Read an object; None if the node lacks it or gives no usable answer; ForeignMaster."""
        link = self._links.setdefault(node_id, SdoChannel(f"node {node_id}", node_id, self._sending.send))
        try:
            return link.read_bytes(index, sub)
        except ForeignMaster:
            raise
        except (ProtocolError, DeviceTimeout):
            return None


@dataclass(frozen=True, slots=True)
class DeviceDescription:
    """An EDS or DCF file and the device it describes."""

    path: Path
    vendor_id: int | None
    product_code: int | None
    revision: int | None

    def match_identity(self, identity: DeviceIdentity) -> str | None:
        """Return one of ``FITS``, the best first, or None for another device."""
        if not self.vendor_id or self.vendor_id != identity.vendor_id:
            return None
        if self.product_code in (None, 0, _ANY_NUMBER):
            return "any product"
        if self.product_code != identity.product_code:
            return None
        return "exact" if self.revision in (None, _ANY_NUMBER, identity.revision) else "other revision"


@dataclass(frozen=True, slots=True)
class EdsMatch:
    """The best-matching description of a node and the kind of match, one of ``FITS``."""

    file: str
    fit: str


@dataclass(frozen=True, slots=True)
class NodeAnswers:
    """A node's answers by SDO; None for an object it lacks."""

    identity: DeviceIdentity
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
        return is_cia402_drive(self.device_type)


@dataclass(frozen=True, slots=True)
class ScannedNode:
    """One node: what was received from it, and its answers (None: it was not read, or is silent)."""

    node_id: int
    axis: str | None
    nmt: str | None
    heartbeat_s: float | None
    emergencies: tuple[str, ...]
    answers: NodeAnswers | None


@dataclass(frozen=True, slots=True)
class BusScan:
    """One bus; ``master`` is the evidence that an NC runs it, and then no node was read."""

    bus: str
    master: str | None
    sync_period_s: float | None
    nodes: tuple[ScannedNode, ...]


def scan_bus(name: str, config: MachineConfig, descriptions: Sequence[DeviceDescription]) -> BusScan:
    """Listen, then read the nodes if no master is detected. ConnectError if the bus is unreachable or silent."""
    axes = {config.get_node_id(axis): axis for axis, settings in config.axis.items() if settings.drive.bus == name}
    with BusScanner(name, config.bus[name]) as bus:
        return scan_nodes(bus, axes, descriptions)


def scan_nodes(bus: BusScanner, axes: Mapping[int, str], descriptions: Sequence[DeviceDescription]) -> BusScan:
    """Listen to an open bus, then read its nodes if no master is detected; ``axes`` by node-ID. ConnectError."""
    bus.listen_for(LISTEN_S)
    bus.require_readable()
    master = bus.traffic.master
    answering = set() if master else bus.find_answering_nodes()
    found = sorted(bus.traffic.sending_nodes | answering)
    if not found and master is None:
        text = "no node sent a frame and none answered; check the drives' supply, wiring and bit rate"
        raise ConnectError(f"bus {bus.name}", text)
    answers = {node_id: _query_node(bus, node_id, descriptions) for node_id in sorted(answering)}
    nodes = [_build_node(bus.traffic, node_id, axes.get(node_id), answers.get(node_id)) for node_id in found]
    return BusScan(bus.name, master, bus.traffic.sync_period_s, tuple(nodes))


def _build_node(traffic: BusTraffic, node_id: int, axis: str | None, answers: NodeAnswers | None) -> ScannedNode:
    codes = sorted(traffic.emergencies.get(node_id, set()) - {0})
    emergencies = tuple(f"{code:04X} {describe_emergency(code)}" for code in codes)
    return ScannedNode(
        node_id, axis, traffic.decode_nmt_state(node_id), traffic.measure_heartbeat_s(node_id), emergencies, answers
    )


def _query_node(bus: BusScanner, node_id: int, descriptions: Sequence[DeviceDescription]) -> NodeAnswers:
    def read_number(index: int, sub: int = 0) -> int | None:
        data = bus.read_object(node_id, index, sub)
        return None if data is None else int.from_bytes(data, "little")

    def read_text(index: int) -> str | None:
        data = bus.read_object(node_id, index)
        return None if data is None else replace_unprintable(data)

    identity = DeviceIdentity(*(read_number(Object.IDENTITY, sub) or 0 for sub in (1, 2, 3, 4)))
    best = find_best_description(identity, descriptions)
    period_ms = read_number(Object.PRODUCER_HEARTBEAT)
    return NodeAnswers(
        identity=identity,
        device_type=read_number(Object.DEVICE_TYPE) or 0,
        name=read_text(Object.DEVICE_NAME),
        hardware=read_text(Object.HARDWARE_VERSION),
        software=read_text(Object.SOFTWARE_VERSION),
        heartbeat_s=None if period_ms is None else period_ms * 1e-3,
        supported_modes=read_number(Object.SUPPORTED_MODES),
        eds=None if best is None else EdsMatch(best[0].path.name, best[1]),
    )


def find_best_description(
    identity: DeviceIdentity, descriptions: Sequence[DeviceDescription]
) -> tuple[DeviceDescription, str] | None:
    """Return the best-matching description of a node and the kind of match, one of ``FITS``; None without one."""
    fits = [
        (description, fit) for description in descriptions if (fit := description.match_identity(identity)) is not None
    ]
    return min(fits, key=lambda found: FITS.index(found[1]), default=None)


def replace_unprintable(data: bytes) -> str:
    r"""Return a drive's text with every character that could control a terminal shown as ``?``.

    >>> replace_unprintable(b"axis\\x1b[2J\\0")
    'axis?[2J'
    """
    text = data.rstrip(b"\0").decode("utf-8", "replace")[:80]
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def read_descriptions(places: Sequence[Path]) -> tuple[list[DeviceDescription], list[EdsError]]:
    """Read EDS and DCF files, also in folders; return them and the errors."""
    files = [f for place in places for f in (sorted(place.iterdir()) if place.is_dir() else [place])]
    found, faults = [], []
    for path in files:
        if path in places or path.suffix.lower() in (".eds", ".dcf"):
            try:
                file = read_eds(path)
            except EdsError as error:
                faults.append(error)
            else:
                found.append(DeviceDescription(path, file.vendor_number, file.product_number, file.revision_number))
    return found, faults
