"""Read a drive by SDO and compare it with its configuration: the first half of commissioning. Nothing moves.

``survey`` reads and compares everything and raises only if the drive does not answer (DeviceTimeout, ProtocolError);
``require`` turns the first difference into a DriveFault.
"""

import hashlib
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from fdhil.cia402 import Mode, Object, PowerState
from fdhil.commissioning.cob_id_conflicts import compare_cob_ids
from fdhil.commissioning.commissioning_record import SOFTWARE_LIMIT_KEYS
from fdhil.commissioning.compare_scales import compare_scales
from fdhil.commissioning.device_type import describe_device_type, is_cia402_drive
from fdhil.commissioning.finding import Finding, has_object, read_optional, report_missing_object
from fdhil.commissioning.master import Master
from fdhil.commissioning.offset_writers import (
    collect_record_options,
    compare_offset_writers,
    extract_cob_id,
    read_other_rpdos,
    report_unreadable_rpdo,
)
from fdhil.commissioning.traffic_listener import UNREADABLE
from fdhil.config import CorrectionLimits
from fdhil.drivers import DriveProfile, PdoSpec
from fdhil.errors import ConnectError, DeviceTimeout, DriveFault, ForeignMaster, ProtocolError, SdoAbort

LISTEN_S = 2.0
INVALID_COB_ID = 1 << 31
NO_WINDOW = 0xFFFFFFFF
SOFTWARE_LIMIT = 0x607D
LAST_DUMMY = 0x07FF  # up to here: data types that pad a PDO
FIRST_DEVICE_TYPE = 0x67FF  # of the first of several devices behind one node
NO_SOFTWARE_LIMIT = (-(2**31), 2**31 - 1)
OPTIONS = (
    (Object.ABORT_CONNECTION_OPTION, True),
    (Object.QUICK_STOP_OPTION, True),
    (Object.FAULT_REACTION_OPTION, True),
    (Object.FOLLOWING_ERROR_WINDOW, False),
    (Object.QUICK_STOP_DECELERATION, False),
    (Object.PRODUCER_HEARTBEAT, False),
)


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Object 0x1018."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int


@dataclass(frozen=True, slots=True)
class DriveSurvey:
    """A drive as read: identity, the mapping's fingerprint, options, and every compared item.

    ``rpdos`` are the COB-IDs of RPDOs that the profile lacks, as stored in a record. Of a device that is not a drive
    nothing else is read.
    """

    identity: DeviceIdentity
    fingerprint: str
    options: Mapping[str, int]
    window_um: float
    findings: tuple[Finding, ...]
    is_drive: bool = True
    rpdos: Mapping[str, int] = field(default_factory=dict)


def listen_for_master(master: Master) -> None:
    """Listen without sending; ForeignMaster if an NC runs the bus.

    On a silent bus the drive's device type is read: with the NC off, a drive without heartbeat (0x1017 = 0) is silent.
    """
    end = time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        master.raise_if_failed()
        time.sleep(0.01)
    require_no_fault(master, [compare_own_cob_ids(master)])
    if master.feedback.frames == 0:
        _probe_silent_bus(master)


def compare_own_cob_ids(master: Master) -> Finding:
    """Compare the drive's COB-IDs with those in use according to the configuration and the bus."""
    return compare_cob_ids(master.config, master.axis, tuple(master.feedback.ids))


def _probe_silent_bus(master: Master) -> None:
    bus = f"bus {master.bus.name}"
    if master.feedback.errors:
        raise ConnectError(bus, UNREADABLE)
    try:
        read_optional(master, Object.DEVICE_TYPE)
    except ForeignMaster:
        raise
    except (DeviceTimeout, ProtocolError):
        text = f"no frame was received on the bus and node-ID {master.node_id} did not answer"
        raise ConnectError(bus, f"{text}; check the drive's supply, wiring, bit rate and node_id") from None


def survey_drive(master: Master) -> DriveSurvey:
    """Read everything that can be compared while the drive is at standstill, and compare it."""
    identity, device = read_identity(master), compare_device_type(master)
    if device.ok is False:
        return DriveSurvey(identity, "", {}, 0.0, (device,), is_drive=False)
    pdos, options = read_pdos(master), read_options(master)
    window_um = options.get("6065", 0) / master.config.axis[master.axis].scaling.increments_per_mm * 1e3
    writers, rpdos = compare_other_rpdos(master)
    findings = (
        device,
        compare_identity(master.profile, identity),
        *(compare_pdo(spec, found, master.node_id) for spec, found in pdos),
        compare_own_cob_ids(master),
        compare_sizes(master, pdos),
        *writers,
        *compare_options(master, options),
        *compare_mode(master),
        *compare_scales(master),
        *compare_window(master, options, window_um),
    )
    fingerprint = hashlib.sha256(repr([found.fingerprint_words for _, found in pdos]).encode()).hexdigest()[:16]
    return DriveSurvey(identity, fingerprint, options, window_um, findings, rpdos=rpdos)


def require_no_fault(master: Master, findings: Iterable[Finding]) -> None:
    """Raise DriveFault for the first item that differs, or is needed and could not be compared."""
    for finding in findings:
        if finding.ok is False or (finding.ok is None and finding.needed):
            raise DriveFault(master.device, f"{finding.cause}; {finding.advice}")


def read_identity(master: Master) -> DeviceIdentity:
    """Read 0x1018; a number that the drive does not have is 0."""
    return DeviceIdentity(*(read_optional(master, Object.IDENTITY, sub) or 0 for sub in (1, 2, 3, 4)))


def compare_device_type(master: Master) -> Finding:
    """Check that the node is a CiA 402 drive, or one of the devices behind it (0x67FF)."""
    own, first = (read_optional(master, index) for index in (Object.DEVICE_TYPE, FIRST_DEVICE_TYPE))
    expected, advice = "CiA 402, a drive", "correct drive.node_id; fdhil scan lists what is on the bus"
    if is_cia402_drive(own) or is_cia402_drive(first):
        return Finding("device", expected, expected)
    found = describe_device_type(own)
    if own is None or own & 0xFFFF == 0:  # some CiA 402 drives do not report their profile
        cause = "it reports no device profile (0x1000)"
        if has_object(master, Object.STATUSWORD):
            return Finding("device", expected, found, None, cause, "check in its manual that it follows CiA 402")
        return Finding("device", expected, found, False, f"{cause} and has no statusword (0x6041)", advice)
    return Finding("device", expected, found, False, f"it is not a CiA 402 drive: 0x1000 reports {found}", advice)


def compare_identity(profile: DriveProfile, identity: DeviceIdentity) -> Finding:
    """Compare 0x1018 with the profile, if that names a vendor or product."""
    wanted = ((profile.vendor_id, identity.vendor_id), (profile.product_code, identity.product_code))
    shown = f"vendor {identity.vendor_id:08X}, product {identity.product_code:08X}"
    vendor, product = ("any" if number is None else f"{number:08X}" for number, _ in wanted)
    expected = f"vendor {vendor}, product {product}"
    if all(found in (number, 0) or number is None for number, found in wanted) and (
        any(number and not found for number, found in wanted)
    ):
        cause = f"it does not report its identity: {shown} (0x1018)"
        return Finding("identity", expected, shown, None, cause, "check by its label that the profile is the right one")
    same = all(number in (None, found) for number, found in wanted)
    cause = f"it is {shown}, which profile {profile.name} is not made for"
    return Finding("identity", expected, shown, same, cause, "choose another profile")


@dataclass(frozen=True, slots=True)
class PdoParameters:
    """The communication and mapping parameters of one PDO in the drive."""

    parameter: int
    mapping: int
    cob_id: int
    kind: int
    mapped: tuple[int, ...]

    @property
    def fingerprint_words(self) -> tuple[int, ...]:
        """The numbers in the mapping's fingerprint."""
        return self.parameter, self.cob_id, self.kind, *self.mapped


def read_pdos(master: Master) -> list[tuple[PdoSpec, PdoParameters]]:
    """Read the parameters of every PDO of the profile; a missing PDO maps nothing."""
    places = (
        (Object.RPDO_PARAMETER, Object.RPDO_MAPPING, master.profile.rpdos),
        (Object.TPDO_PARAMETER, Object.TPDO_MAPPING, master.profile.tpdos),
    )
    return [
        (spec, _read_pdo(master, parameter + spec.number - 1, mapping + spec.number - 1))
        for parameter, mapping, specs in places
        for spec in specs
    ]


def _read_pdo(master: Master, parameter: int, mapping: int) -> PdoParameters:
    cob_id = read_optional(master, parameter, 1)
    if cob_id is None:
        return PdoParameters(parameter, mapping, INVALID_COB_ID, 0, ())
    mapped = read_mapping(master, mapping)
    return PdoParameters(parameter, mapping, cob_id, read_optional(master, parameter, 2) or 0, mapped)


def read_mapping(master: Master, mapping: int) -> tuple[int, ...]:
    """Read the entries of a mapping parameter; a missing one maps nothing."""
    count = read_optional(master, mapping, 0) or 0
    return tuple(read_optional(master, mapping, sub) or 0 for sub in range(1, count + 1))


def compare_sizes(master: Master, pdos: Sequence[tuple[PdoSpec, PdoParameters]]) -> Finding:
    """Compare the size of each mapped object, as SDO reports it, with its bits in the PDO.

    An object that is mapped too long shifts all that follows in the frame, although the mapping looks right.
    """
    expected, compared = "as mapped", 0
    for spec, found in pdos:
        for word in found.mapped:
            index, sub, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
            size = _read_size(master, index, sub) if index > LAST_DUMMY else None
            compared += size is not None
            if size is not None and size != -(-bits // 8):
                shown = f"{index:04X}:{sub:02X} has {8 * size} bits"
                cause = f"{shown} (by SDO), but {spec.name} maps it with {bits}: all that follows is shifted"
                advice = f"correct 0x{found.mapping:04X} and the profile: every value of {spec.name} would be wrong"
                return Finding("object sizes", expected, shown, False, cause, advice)
    if not compared:
        cause = "it does not report the size of its mapped objects"
        return Finding("object sizes", expected, "not reported", None, cause, "compare its mapping with its manual")
    return Finding("object sizes", expected, f"{compared} as mapped")


def _read_size(master: Master, index: int, sub: int) -> int | None:
    try:
        return master.sdo.read_size(index, sub)
    except SdoAbort:
        return None


def compare_other_rpdos(master: Master) -> tuple[list[Finding], dict[str, int]]:
    """Compare the RPDOs that the profile lacks, if it can send offsets; return findings and record options."""
    if master.profile.find_rpdo(master.profile.offset) is None:
        return [], {}
    try:
        rpdos = read_other_rpdos(master)
    except SdoAbort as abort:
        return [report_unreadable_rpdo(abort)], {}
    return [compare_offset_writers(master, rpdos)], collect_record_options(master, rpdos)


def compare_pdo(spec: PdoSpec, found: PdoParameters, node_id: int) -> Finding:
    """Compare one PDO with the profile: mapping, COB-ID and, if valid, transmission type."""
    wanted = tuple(entry.mapping for entry in spec.entries)
    cob_id = spec.cob_base + node_id
    cause = ""
    if found.mapped != wanted:
        cause = f"{spec.name} maps {_format_mapping(found.mapped)}, but the profile has {_format_mapping(wanted)}"
    elif extract_cob_id(found.cob_id) != cob_id or bool(found.cob_id & INVALID_COB_ID) == spec.valid:
        cause = f"{spec.name} has the COB-ID {found.cob_id:08X}, not {cob_id:03X}{'' if spec.valid else ', not valid'}"
    elif spec.valid and found.kind != spec.every_sync:
        cause = f"{spec.name} has transmission type {found.kind}, but the profile has {spec.every_sync}"
    return Finding(
        spec.name,
        _format_pdo(cob_id, spec.valid, spec.every_sync, wanted),
        _format_pdo(found.cob_id & 0x7FF, not found.cob_id & INVALID_COB_ID, found.kind, found.mapped),
        not cause,
        cause,
        f"write 0x{found.parameter:04X} and 0x{found.mapping:04X} (fdhil commission --set-pdos), or change the profile",
    )


def _format_mapping(mapped: tuple[int, ...]) -> str:
    return ", ".join(f"{value:08X}" for value in mapped) or "nothing"


def _format_pdo(cob_id: int, valid: bool, kind: int, mapped: tuple[int, ...]) -> str:
    return f"{cob_id:03X}, type {kind}: {_format_mapping(mapped)}" if valid else f"not valid: {_format_mapping(mapped)}"


def compare_mode(master: Master) -> Iterator[Finding]:
    """Check that the drive has cyclic synchronous position and interpolates at the machine's SYNC period."""
    modes, mode = read_optional(master, Object.SUPPORTED_MODES), master.profile.mode
    name = "cyclic synchronous position" if mode == Mode.CYCLIC_SYNC_POSITION else f"mode {mode}"
    if modes is None:
        yield report_missing_object("mode", name, "0x6502")
    elif mode > 0:  # a vendor-specific mode has no bit
        offered = bool(modes >> (mode - 1) & 1)
        cause = f"it has no {name}{' mode' if mode == Mode.CYCLIC_SYNC_POSITION else ''} (0x6502)"
        shown = f"0x6502 = {modes:08X}"
        yield Finding("mode", name, shown, offered, cause, "it cannot be corrected")
    value = read_optional(master, Object.INTERPOLATION_PERIOD, 1)
    exponent = read_optional(master, Object.INTERPOLATION_PERIOD, 2, signed=True)
    wanted = f"{master.period_s * 1e3:g} ms"
    if value is None or exponent is None:
        yield report_missing_object("cycle", wanted, "0x60C2")
        return
    period_s = value * 10.0**exponent
    found = f"{period_s * 1e3:g} ms"
    same = abs(period_s - master.period_s) <= 1e-6
    cause = f"it interpolates over {found} (0x60C2), but the SYNC period is {wanted}"
    yield Finding("cycle", wanted, found, same, cause, "set 0x60C2 or machine.sync_period_s")


def read_options(master: Master) -> dict[str, int]:
    """Read option codes, window, heartbeat and software limits (607D01, 607D02); missing objects are omitted."""
    values = {f"{index:04X}": read_optional(master, index, signed=signed) for index, signed in OPTIONS}
    low, high = (read_optional(master, SOFTWARE_LIMIT, sub, signed=True) for sub in (1, 2))
    if low is not None and high is not None and low < high and (low, high) != NO_SOFTWARE_LIMIT:
        values |= dict(zip(SOFTWARE_LIMIT_KEYS, (low, high), strict=True))
    return {key: value for key, value in values.items() if value is not None}


def compare_options(master: Master, options: Mapping[str, int]) -> Iterator[Finding]:
    """Check that the drive stops, and by a ramp, when communication is lost."""
    strict = " or ".join(map(str, master.profile.strict_abort_options))
    point, expected, abort = "communication lost", f"0x6007 = {strict}", options.get("6007")
    if abort is None:  # the watchdog test will show its reaction
        yield report_missing_object(point, expected, "0x6007")
    else:
        stops = abort in master.profile.strict_abort_options
        cause = f"0x6007 is {abort}: it continues when communication is lost"
        yield Finding(point, expected, f"0x6007 = {abort}", stops, cause, f"set it to {strict}")
    point, expected = "stop by a ramp", "0x605A and 0x605E not 0"
    found = {f"0x{key}": options.get(key) for key in ("605A", "605E")}
    if missing := [key for key, value in found.items() if value is None and 0 not in found.values()]:
        yield report_missing_object(point, expected, *missing)
        return
    shown = ", ".join(f"{key} = {'missing' if value is None else value}" for key, value in found.items())
    cause = "0x605E or 0x605A is 0: it coasts instead of ramping down"
    yield Finding(point, expected, shown, 0 not in found.values(), cause, "set both to 2")


def compare_window(master: Master, options: Mapping[str, int], window_um: float) -> Iterator[Finding]:
    """Check that the drive detects a following error, no sooner than at four times the largest offset."""
    settings = master.config.axis[master.axis]
    largest = (settings.correction or CorrectionLimits()).max_offset_um
    wanted = settings.drive.following_error_window_mm * 1e3
    point, expected = "following error", f"{wanted:g} um"
    if "6065" not in options:
        yield report_missing_object(point, expected, "0x6065", needed=True)
        return
    if options["6065"] in (0, NO_WINDOW):
        cause = "0x6065 is off: it never detects a following error"
        yield Finding(point, expected, "off", False, cause, "set a window")
        return
    cause = f"its following-error window is {window_um:g} um (0x6065)"
    if largest > window_um / 4:
        small = f"{cause}, too small for offsets of {largest:g} um"
        yield Finding(point, expected, f"{window_um:g} um", False, small, "set at least four times the largest offset")
        return
    same = abs(window_um - wanted) <= 0.01 * wanted
    other = f"{cause}, but the configuration has {wanted:g}"
    yield Finding(point, expected, f"{window_um:g} um", same, other, "correct drive.following_error_window_mm")


def build_drive_fault(master: Master, what: str) -> DriveFault:
    """Return the exception for a drive in fault, with its error code."""
    code = read_optional(master, 0x603F)
    shown = "no error code" if code is None else f"error code {code:04X}"
    return DriveFault(master.device, f"{what} ({shown}); remove the cause and start again")


def require_enabled(master: Master) -> None:
    """Raise DriveFault if the drive has left Operation enabled."""
    if master.get_power_state() is not PowerState.OPERATION_ENABLED:
        raise build_drive_fault(master, f"it fell from Operation enabled to {master.get_power_state().value}")
