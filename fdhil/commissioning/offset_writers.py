"""Find every RPDO by which another master could write a drive's offsets (60B0, 60B1, 60B2) or receive fdhil's frames.

The profile names only the RPDOs that fdhil needs. An NC that compensates the screw pitch may have set up its own: two
masters that write one offset make the table step from one value to the other.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from fdhil.cia402 import COB_SDO_RESPONSE, Object, unpack_pdo
from fdhil.commissioning.commissioning_record import CommissioningRecord
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.master import Master
from fdhil.commissioning.traffic_listener import BusTraffic
from fdhil.config import MachineConfig
from fdhil.drivers import LOGICAL_AXIS_PDOS, NO_OBJECT, NO_SUB_INDEX, DriveProfile, load_profile, read_device
from fdhil.errors import SdoAbort

POINT = "offset writers"
MOST_RPDOS = 512
MOST_MISSING, MOST_MISSING_BEHIND = 16, 4
INVALID_COB_ID = 1 << 31
EXTENDED = 1 << 29
MOST_MAPPED = 64
LEAST_HELD = 8  # increments: smaller values occur by chance in many frames
MULTIPLEXED = (254, 255)
"""Numbers of mapped objects that mark a multiplexed PDO: its frames name the object that they write (CiA 301)."""


@dataclass(frozen=True, slots=True)
class OtherRpdo:
    """An RPDO that the profile lacks: number, COB-ID word (bit 31: not valid), mapped objects.

    ``mapped`` is None for a multiplexed PDO, which may write any object.
    """

    number: int
    cob_id: int
    mapped: tuple[int, ...] | None

    @property
    def key(self) -> str:
        """Key of its COB-ID in a commissioning record."""
        return f"{Object.RPDO_PARAMETER + self.number - 1:04X}"

    @property
    def is_valid(self) -> bool:
        """Whether the drive accepts its frames."""
        return not self.cob_id & INVALID_COB_ID


def extract_cob_id(cob_id: int) -> int:
    """Return the identifier in a drive's COB-ID word; bit 29 is kept to distinguish 29-bit identifiers.

    Bit 30 has no meaning for an RPDO (CiA 301, 7.5.2.35); drives may set it or not.

    >>> f"{extract_cob_id(0xC000_0205):X} {extract_cob_id(0x2000_0205):X}"
    '205 20000205'
    """
    return cob_id & (EXTENDED | EXTENDED - 1 if cob_id & EXTENDED else 0x7FF)


def read_other_rpdos(master: Master) -> tuple[OtherRpdo, ...]:
    """Read all RPDOs of the drive that the profile lacks; SdoAbort if one exists but cannot be read.

    RPDOs are read from the first on, and from the first number of each further axis of a device (CiA 402-3), until so
    many in succession do not exist; then those of the drive's EDS. A drive with another numbering needs an EDS.
    """
    own, found = {spec.number for spec in master.profile.rpdos}, dict[int, OtherRpdo | None]()
    for block in range(0, MOST_RPDOS, LOGICAL_AXIS_PDOS):
        missing, allowed = 0, MOST_MISSING if block == 0 else MOST_MISSING_BEHIND
        for number in range(block + 1, block + LOGICAL_AXIS_PDOS + 1):
            if number not in own:
                found[number] = _read_rpdo(master, number)
            exists = number in own or found[number] is not None
            missing, allowed = 0 if exists else missing + 1, MOST_MISSING if exists else allowed
            if missing >= allowed:
                break
    for number in _list_eds_rpdos(master) - own - found.keys():
        found[number] = _read_rpdo(master, number)
    return tuple(rpdo for _, rpdo in sorted(found.items()) if rpdo is not None)


def _list_eds_rpdos(master: Master) -> set[int]:
    """The drive may have more RPDOs, or fewer."""
    eds = master.config.axis[master.axis].drive.eds
    return set() if eds is None else {place.number for place in read_device(eds).rpdos}


def _read_rpdo(master: Master, number: int) -> OtherRpdo | None:
    cob_id = _read_existing_int(master, Object.RPDO_PARAMETER + number - 1, 1)
    if cob_id is None:
        return None
    mapping = Object.RPDO_MAPPING + number - 1
    count = _read_existing_int(master, mapping, 0) or 0
    if count in MULTIPLEXED:
        return OtherRpdo(number, cob_id, None)
    words = (_read_existing_int(master, mapping, sub) or 0 for sub in range(1, min(count, MOST_MAPPED) + 1))
    return OtherRpdo(number, cob_id, tuple(words))


def _read_existing_int(master: Master, index: int, sub: int) -> int | None:
    """Return None only if the object does not exist; raise SdoAbort on any other refusal."""
    try:
        return master.sdo.read_int(index, sub)
    except SdoAbort as abort:
        if abort.code in (NO_OBJECT, NO_SUB_INDEX):
            return None
        raise


def find_written_offsets(master: Master, rpdo: OtherRpdo) -> tuple[int, ...]:
    """Return which of the axis' offset objects an RPDO writes."""
    profile = master.profile
    keys = (profile.offset, profile.speed_offset, profile.torque_offset)
    if rpdo.mapped is None:
        return tuple(index for index, _ in keys)
    written = {word >> 16 for word in rpdo.mapped}
    return tuple(index for index, _ in keys if index in written)


def collect_record_options(master: Master, rpdos: tuple[OtherRpdo, ...]) -> dict[str, int]:
    """Return the COB-IDs to be stored in a commissioning record, since a running guard reads no drive by SDO.

    All valid ones, so that their frames count as harmless; of the others those with an offset.
    """
    return {rpdo.key: rpdo.cob_id for rpdo in rpdos if rpdo.is_valid or find_written_offsets(master, rpdo)}


def compare_offset_writers(master: Master, rpdos: tuple[OtherRpdo, ...]) -> Finding:
    """Verify that only fdhil can write the offsets, and that its frames write nothing else."""
    expected = "only the profile's RPDOs"
    wrong = next(_find_conflicting_rpdos(master, rpdos), None)
    if wrong is None:
        return Finding(POINT, expected, expected)
    rpdo, why = wrong
    where = f"RPDO{rpdo.number} (COB-ID {extract_cob_id(rpdo.cob_id) & ~EXTENDED:03X})"
    parameter, mapping = Object.RPDO_PARAMETER + rpdo.number - 1, Object.RPDO_MAPPING + rpdo.number - 1
    advice = f"set bit 31 of 0x{parameter:04X}:01, or change 0x{mapping:04X}, with the NC's or the drive's own tool"
    return Finding(POINT, expected, where, False, f"its {where} {why}", advice)


def _find_conflicting_rpdos(master: Master, rpdos: tuple[OtherRpdo, ...]) -> Iterator[tuple[OtherRpdo, str]]:
    ours = {spec.cob_base + master.node_id for spec in master.profile.rpdos}
    for rpdo in rpdos:
        written = " and ".join(f"{index:04X}" for index in find_written_offsets(master, rpdo))
        if not rpdo.is_valid:
            continue
        if rpdo.mapped is None:
            yield rpdo, f"is multiplexed and can write {written}: another master can step the table"
        elif written:
            yield rpdo, f"writes {written}, as fdhil does: another master that sends it steps the table"
        elif extract_cob_id(rpdo.cob_id) in ours and rpdo.mapped:
            listed = ", ".join(f"{word:08X}" for word in rpdo.mapped)
            yield rpdo, f"has the COB-ID of an RPDO of the profile and maps {listed}: our frames would write that"


def compare_traffic_writers(
    config: MachineConfig, name: str, record: CommissioningRecord | None, traffic: BusTraffic
) -> Finding:
    """Compare an axis' offset with the frames that are not PDOs of a configured drive.

    With an NC on the bus no drive is read by SDO: a frame that carries the drive's offset has written it.
    """
    profile, axis = load_profile(config.axis[name].drive), config.axis[name]
    kept = () if record is None else record.rpdos
    known = {extract_cob_id(cob_id) for cob_id in kept if not cob_id & INVALID_COB_ID}
    for each, other in config.axis.items():
        if other.drive.bus == axis.drive.bus:
            found = load_profile(other.drive)
            known |= {spec.cob_base + config.get_node_id(each) for spec in (*found.rpdos, *found.tpdos)}
    held, bits = _read_shown_offset(profile, config.get_node_id(name), traffic)
    expected = "written by fdhil only"
    for cob_id in sorted({*traffic.cob_ids} - known) if abs(held) >= LEAST_HELD else ():
        if _is_value_in_frame(traffic, cob_id, held, bits):
            um = abs(held) / axis.scaling.increments_per_mm * 1e3
            cause = f"it holds an offset of {um:.1f} um, which the frame {cob_id:03X} of another master carries"
            advice = "find the NC function that writes it, switch it off, and run fdhil check with the NC off"
            return Finding(POINT, expected, f"{cob_id:03X}", False, cause, advice)
    return Finding(POINT, expected, expected)


def _read_shown_offset(profile: DriveProfile, node_id: int, traffic: BusTraffic) -> tuple[int, int]:
    found = profile.find_tpdo(profile.offset)
    data = None if found is None else traffic.data.get(found[0].cob_base + node_id)
    if found is None or data is None:
        return 0, 0
    return unpack_pdo(found[0].entries, data.to_bytes(8, "little"))[found[0].entries.index(found[1])], found[1].bits


def _is_value_in_frame(traffic: BusTraffic, cob_id: int, held: int, bits: int) -> bool:
    if not 0x180 <= cob_id < COB_SDO_RESPONSE:
        return False
    frame = traffic.data[cob_id].to_bytes(8, "little")[: traffic.length[cob_id]]
    return (held & (1 << bits) - 1).to_bytes(bits // 8, "little") in frame


def report_unreadable_rpdo(abort: SdoAbort) -> Finding:
    """Return the finding for an RPDO that exists but cannot be read."""
    cause = f"not all of its RPDOs can be read ({abort}): one may write its offset"
    return Finding(POINT, "only the profile's RPDOs", "unknown", None, cause, "look up its RPDOs in its manual")
