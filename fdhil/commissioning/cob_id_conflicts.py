"""Compare the COB-IDs of a drive's PDOs with all identifiers in use on its bus.

A frame of ours with another node's identifier would move an axis that is not corrected. In use are the services of
CiA 301, the PDOs of every configured drive, the predefined identifiers of every other node that is configured or was
received, and all received identifiers.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from fdhil.cia402 import (
    COB_EMCY,
    COB_HEARTBEAT,
    COB_NMT,
    COB_RPDO,
    COB_SDO_REQUEST,
    COB_SDO_RESPONSE,
    COB_SYNC,
    COB_TPDO,
)
from fdhil.commissioning.finding import Finding
from fdhil.config import MachineConfig
from fdhil.drivers import DriveProfile, PdoSpec, load_profile
from fdhil.errors import ConfigError, ConfigFault

POINT = "identifiers"
COB_TIME = 0x100
COB_LSS = (0x7E4, 0x7E5)
_BROADCAST = {COB_NMT: "NMT", COB_SYNC: "SYNC", COB_TIME: "TIME", **dict.fromkeys(COB_LSS, "LSS")}
_SERVICES = {COB_EMCY: "EMCY", COB_SDO_RESPONSE: "SDO", COB_SDO_REQUEST: "SDO", COB_HEARTBEAT: "heartbeat"}
_NODE_IDS = range(1, 128)


@dataclass(frozen=True, slots=True)
class CobIdConflict:
    """A PDO of the profile whose COB-ID is in use, by whom, and the configuration key that causes it."""

    pdo: str
    cob_id: int
    whose: str
    key: str

    @property
    def cause(self) -> str:
        """The cause as a clause."""
        return f"its {self.pdo} has the COB-ID {self.cob_id:03X}, which belongs to {self.whose}"


ADVICE = "correct drive.node_id, the COB-IDs in the EDS or DCF, or the profile: no two PDOs may share an identifier"


def find_conflict(
    config: MachineConfig, axis: str, received: Collection[int] = (), *, sent: bool = False
) -> CobIdConflict | None:
    """Return the first PDO of an axis whose COB-ID is in use; ``sent``: only of those that a guard sends.

    ``received`` are COB-IDs received on the bus.
    """
    profile, node = load_profile(config.axis[axis].drive), config.get_node_id(axis)
    specs = list_guard_rpdos(config, axis, profile) if sent else [*profile.rpdos, *profile.tpdos]
    taken: dict[int, tuple[str, str]] = {}
    for cob_id, *whose in (*_list_configured_ids(config, axis), *_list_ids_of_detected_nodes(config, axis, received)):
        taken.setdefault(cob_id, (whose[0], whose[1]))
    valid = [spec for spec in (*profile.rpdos, *profile.tpdos) if spec.valid]
    for spec in specs:
        cob_id = spec.cob_base + node
        if cob_id in taken and (spec.valid or sent):
            return CobIdConflict(spec.name, cob_id, *taken[cob_id])
        other = next((each for each in valid if each.cob_base == spec.cob_base and each.name != spec.name), None)
        if other is not None and (spec.valid or sent):
            return CobIdConflict(spec.name, cob_id, f"its own {other.name}", f"axis.{axis}.drive")
    return None


def list_guard_rpdos(config: MachineConfig, axis: str, profile: DriveProfile) -> list[PdoSpec]:
    """Return the RPDOs that a guard sends to an axis: the offset's, and the feed-forward's."""
    keys = [profile.offset] + [profile.speed_offset] * (config.axis[axis].feedforward is not None)
    found = [profile.find_rpdo(key) for key in keys]
    return [pdo[0] for pdo in found if pdo is not None]


def compare_cob_ids(config: MachineConfig, axis: str, received: Collection[int] = ()) -> Finding:
    """Compare the drive's COB-IDs with all identifiers in use."""
    clash = find_conflict(config, axis, received)
    expected = "unique"
    if clash is None:
        return Finding(POINT, expected, expected)
    return Finding(POINT, expected, f"{clash.cob_id:03X} belongs to {clash.whose}", False, clash.cause, ADVICE)


def require_unique_guard_ids(config: MachineConfig, bus: str, received: Collection[int] = ()) -> None:
    """Raise ConfigError if a guard on this bus would send with another node's identifier."""
    for name, axis in config.axis.items():
        if axis.correction is None or axis.drive.bus != bus:
            continue
        clash = find_conflict(config, name, received, sent=True)
        if clash is not None:
            text = f"COB-ID {clash.cob_id:03X}, with which the guard sends offsets, also belongs to {clash.whose}"
            raise ConfigError("config", [ConfigFault(clash.key, text, ADVICE)])


_Use = tuple[int, str, str]
"""A COB-ID, whose it is, and the key of the configuration."""


def _list_configured_ids(config: MachineConfig, own: str) -> Iterator[_Use]:
    key = f"axis.{own}.drive"
    yield from ((cob_id, service, key) for cob_id, service in _BROADCAST.items())
    for base, service in _SERVICES.items():
        yield from ((base + node, f"{service} of node-ID {node}", key) for node in _NODE_IDS)
    for name, axis in config.axis.items():
        if axis.drive.bus != config.axis[own].drive.bus:
            continue
        if axis.table is not None and axis.table.cob_id is not None:
            yield axis.table.cob_id, f"the encoder at the table of axis {name}", f"axis.{name}.table.cob_id"
        if name == own:
            continue
        profile, node = load_profile(axis.drive), config.get_node_id(name)
        for spec in (*profile.rpdos, *profile.tpdos):
            yield spec.cob_base + node, f"{spec.name} of axis {name}", f"axis.{name}.drive.profile"
        if node != config.get_node_id(own):
            yield from _list_predefined_pdos(node, f"axis {name}", f"axis.{name}.drive")


def _list_ids_of_detected_nodes(config: MachineConfig, own: str, received: Collection[int]) -> Iterator[_Use]:
    bus = config.axis[own].drive.bus
    names = [name for name, axis in config.axis.items() if axis.drive.bus == bus]
    nodes = {config.get_node_id(name) for name in names} | {config.guard.node_id}
    known = {
        spec.cob_base + config.get_node_id(name)
        for name in names
        for profile in (load_profile(config.axis[name].drive),)
        for spec in (*profile.rpdos, *profile.tpdos)
    }
    for node in sorted(_find_sending_nodes(received, known) - nodes):
        yield from _list_predefined_pdos(node, f"node-ID {node}, which was received on the bus", f"axis.{own}.drive")


def _find_sending_nodes(received: Collection[int], known: Collection[int]) -> set[int]:
    """Return the node-IDs that sent frames other than the PDOs in ``known``."""
    bases = (*_SERVICES, *COB_TPDO)
    sent = (can_id for can_id in received if can_id <= 0x7FF and can_id & 0x780 in bases and can_id not in known)
    return {can_id & 0x7F for can_id in sent if can_id & 0x7F and can_id & 0x780 != COB_SDO_REQUEST}


def _list_predefined_pdos(node: int, whose: str, key: str) -> Iterator[_Use]:
    """Yield a node's default PDOs (CiA 301, table 39)."""
    for kind, bases in (("RPDO", COB_RPDO), ("TPDO", COB_TPDO)):
        yield from ((base + node, f"{kind}{k} of {whose}", key) for k, base in enumerate(bases, 1))
