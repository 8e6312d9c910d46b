"""Determines what fdhil can do with a device, by its EDS and a profile: each capability with its reason.

An EDS is the vendor's statement. ``perhaps`` means that only the drive itself can settle it.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from fdhil import tables
from fdhil.cia402 import Object
from fdhil.drivers.cia402.device_description import DeviceDescription, DeviceObject, PdoSlot
from fdhil.drivers.cia402.drive_profile import DriveProfile, ObjectKey, PdoSpec
from fdhil.drivers.cia402.drive_profile_file import read_profile
from fdhil.drivers.cia402.pdo_mapping import SYNC_TYPES

Answer = Literal["yes", "no", "perhaps"]
SYNC_ID = 0x1005
SENSOR = "wire a sensor ([axis.X.voltage] source = 'modbus')"
GENERIC_PROFILE = "cia402"
_TWIN = "fdhil_twin"
_VOLTAGE = re.compile(
    r"\b(motor|output|terminal|phase|quadrature|q)\b.*volt|volt.*\b(generated|motor|d-q)|duty|pwm", re.I
)
_DC_LINK = re.compile(r"dc.?link|bus volt|supply volt|v bat|ub power|voltage ub", re.I)
_CURRENT = re.compile(
    r"current.*\b(actual|reading|quadrature|monitor)|\b(actual|motor|active)\b.*current|i_q|motor amps", re.I
)
_SET_UP = re.compile(
    r"param|limit|threshold|homing|config|gain|filter|nominal|rated|max|offset|loop|analog|input\b|warning|brake|inputs|outputs|frequency|period|source",
    re.I,
)


@dataclass(frozen=True, slots=True)
class Capability:
    """One capability: whether fdhil has it with this drive, why, and advice (may be empty)."""

    what: str
    answer: Answer
    why: str
    advice: str = ""


def assess_capabilities(device: DeviceDescription, profile: DriveProfile) -> list[Capability]:
    """Return the capabilities with this profile, each after those it depends on."""
    if not device.is_drive:
        kind = (device.get_default(Object.DEVICE_TYPE) or 0) & 0xFFFF
        why = f"its device type is profile {kind or 'none'}, or it has no control- and statusword (6040, 6041)"
        return [Capability("listen", "no", why, "it is not a CiA 402 drive; configure it as a sensor, if it is one")]
    return [
        *_assess_listening(device, profile),
        _assess_mapping(device, profile),
        _assess_voltage(device, profile),
        _assess_demand(device, profile),
        *_assess_correction(device, profile),
        _assess_feedforward(device, profile),
        *_assess_safety(device, profile),
        *_assess_scale_checks(device),
        _assess_rapid_signal(device, profile),
    ]


def suggest_profile(device: DeviceDescription) -> str:
    """Return the packaged profile of the device's vendor that fits its objects best, else ``cia402``."""
    named = [
        name for name in tables.DRIVE_PROFILES if name not in (GENERIC_PROFILE, _TWIN) and _is_from_vendor(device, name)
    ]
    return min(named, key=lambda name: len(find_missing_objects(device, read_profile(name))), default=GENERIC_PROFILE)


def _is_from_vendor(device: DeviceDescription, name: str) -> bool:
    profile = read_profile(name)
    if profile.vendor_id is not None and device.vendor_id:
        return profile.vendor_id == device.vendor_id
    words = re.findall(r"[a-z]{4,}", device.vendor_name.lower())
    return any(word in profile.title.lower() for word in words if word not in ("motor", "gmbh", "motion", "control"))


def find_missing_objects(device: DeviceDescription, profile: DriveProfile) -> list[ObjectKey]:
    """Return the objects that the profile maps and the device lacks, or has in another size."""
    entries = [entry for spec in (*profile.rpdos, *profile.tpdos) for entry in spec.entries]
    found = {(entry.index, entry.sub): device.find_object((entry.index, entry.sub)) for entry in entries}
    bits = {(entry.index, entry.sub): entry.bits for entry in entries}
    return [key for key, at in found.items() if at is None or at.bits != bits[key]]


def find_similar_names(device: DeviceDescription, what: Literal["voltage", "dc_link", "current"]) -> list[DeviceObject]:
    """Return the vendor's objects whose names suggest a motor voltage (or duty), the DC link or the current."""
    pattern = {"voltage": _VOLTAGE, "dc_link": _DC_LINK, "current": _CURRENT}[what]
    own = [
        at
        for key, at in device.objects.items()
        if at.bits and (0x2000 <= key[0] < 0x6000 or key[0] in (0x6078, 0x6079))
    ]
    readable = [at for at in own if at.key[1] or (at.key[0], 1) not in device.objects]
    names = {at.key: at.name.replace("_", " ") for at in readable if at.access in ("ro", "rwr", "rww", "const")}
    return [at for at in readable if (name := names.get(at.key)) and pattern.search(name) and not _SET_UP.search(name)]


def format_key(key: ObjectKey) -> str:
    """Format an object as 6064:00."""
    return f"{key[0]:04X}:{key[1]:02X}"


def _assess_listening(device: DeviceDescription, profile: DriveProfile) -> Iterator[Capability]:
    if profile.missing_signals:
        what = ", ".join(f"{name} ({format_key(getattr(profile, name))})" for name in profile.missing_signals)
        advice = "name the vendor's object for it in your own profile, with base = 'cia402'"
        yield Capability("listen", "no", f"no TPDO with every SYNC can carry its {what}", advice)
        return
    if device.find_object((SYNC_ID, 0)) is None and not any(place.kind in SYNC_TYPES for place in device.tpdos):
        yield Capability("listen", "perhaps", "its EDS has no SYNC (1005): its TPDOs may be sent by a timer only")
    else:
        yield Capability("listen", "yes", "position, speed, current and statusword can come with every SYNC")


def _assess_mapping(device: DeviceDescription, profile: DriveProfile) -> Capability:
    differ = [spec.name for spec in profile.rpdos if not _is_same(spec, device.rpdos)]
    differ += [spec.name for spec in profile.tpdos if not _is_same(spec, device.tpdos)]
    if not differ:
        return Capability("mapping", "yes", "its default PDOs are the profile's")
    specs = [*((spec, device.rpdos) for spec in profile.rpdos), *((spec, device.tpdos) for spec in profile.tpdos)]
    stuck = [spec.name for spec, places in specs if spec.name in differ and _is_fixed_otherwise(spec, places)]
    if stuck:
        why = f"it has no {', '.join(stuck)}, or one whose mapping, COB-ID or type differs and is fixed"
        return Capability("mapping", "no", why, "choose profile 'cia402', which uses what the EDS offers")
    why = f"{', '.join(differ)} must be set up: the defaults differ"
    return Capability("mapping", "yes", why, "`fdhil commission --set-pdos`, or the drive's own tool")


def _is_same(spec: PdoSpec, places: Sequence[PdoSlot]) -> bool:
    place = _find_pdo(spec, places)
    if place is None or place.mapped != _list_mapping_words(spec):
        return False
    return place.valid == spec.valid and place.cob_base == spec.cob_base and place.kind == spec.every_sync


def _is_fixed_otherwise(spec: PdoSpec, places: Sequence[PdoSlot]) -> bool:
    place = _find_pdo(spec, places)
    if place is None or (place.fixed and place.mapped != _list_mapping_words(spec)):
        return True
    other_id = place.valid != spec.valid or place.cob_base not in (None, spec.cob_base)
    return (place.cob_fixed and other_id) or (place.kind_fixed and place.kind != spec.every_sync)


def _find_pdo(spec: PdoSpec, places: Sequence[PdoSlot]) -> PdoSlot | None:
    return next((place for place in places if place.number == spec.number), None)


def _list_mapping_words(spec: PdoSpec) -> tuple[int, ...]:
    return tuple(entry.mapping for entry in spec.entries)


def _assess_voltage(device: DeviceDescription, profile: DriveProfile) -> Capability:
    what, keys = "voltage", profile.voltage_objects
    if keys:
        if not profile.duty_per_count:
            return Capability(what, "yes", f"{format_key(keys[0])} is the terminal voltage")
        link = f"the DC link ({format_key(keys[1])})" if len(keys) > 1 else "drive.dc_link_v"
        why = (
            f"{format_key(keys[0])} (duty) times {link}: "
            "without dead time and drops of the stage, R comes out too large"
        )
        return Capability(what, "yes", why, "check it once against a meter")
    if profile.voltage is not None:
        why = (
            f"it has no {format_key(profile.voltage)} that a TPDO could carry: K, Jt and friction can be "
            "identified, R and L cannot"
        )
        return Capability(what, "no", why, SENSOR)
    similar = [at for at in find_similar_names(device, "voltage") if at.fits_in_tpdo or at.may_fit_in_tpdo]
    if similar:
        why = f"the profile has none, but by its name {_list_names(similar)} may be one"
        return Capability(what, "perhaps", why, "measure its scale, and set voltage and its unit in your own profile")
    why = "no object that a TPDO can carry is a motor voltage: K, Jt and friction can be identified, R and L cannot"
    return Capability(what, "no", why, SENSOR)


def _list_names(found: Sequence[DeviceObject]) -> str:
    listed = ", ".join(f"{format_key(at.key)} {at.name!r}" for at in found[:3])
    return f"{listed} and {len(found) - 3} more" if len(found) > 3 else listed


def _assess_demand(device: DeviceDescription, profile: DriveProfile) -> Capability:
    what = "follow an NC"
    at = profile.find_rpdo(profile.target)
    if at is None:
        return Capability(
            what, "no", f"no RPDO carries its target ({format_key(profile.target)})", "it can only be identified"
        )
    modes = device.get_default(Object.SUPPORTED_MODES)
    if profile.mode < 1:
        return Capability(what, "perhaps", f"set-points are streamed in the vendor's mode {profile.mode}")
    if modes is None:
        return Capability(what, "perhaps", "its EDS does not list its modes (6502); query the drive with `fdhil check`")
    if modes >> (profile.mode - 1) & 1:
        return Capability(what, "yes", f"set-points are streamed to {format_key(profile.target)} (6502 = {modes:08X})")
    why = f"it has no mode {profile.mode} (6502 = {modes:08X}): set-points cannot be streamed"
    return Capability(what, "no", why, "it can be identified, but not corrected")


def _assess_correction(device: DeviceDescription, profile: DriveProfile) -> Iterator[Capability]:
    what, advice = "correct on line", "let the NC play the corrected demand of `fdhil correct --out`"
    offset = device.find_object(profile.offset)
    if offset is None or profile.find_rpdo(profile.offset) is None:
        why = "it has no position offset (60B0)" if offset is None else "no RPDO can carry its 60B0"
        yield Capability(what, "no", why, advice)
    elif profile.unmapped_read_backs:
        why = (
            f"no TPDO shows its {', '.join(map(format_key, profile.unmapped_read_backs))}, and offsets are only sent "
            f"where "
            "they can be read back"
        )
        yield Capability(what, "no", why, advice)
    elif not offset.fits_in_tpdo:
        why = (
            "its EDS allows 60B0 in RPDOs only (rww): whether a TPDO accepts it for the read-back, only a "
            "test on the drive shows"
        )
        yield Capability(what, "perhaps", why, "`fdhil commission --set-pdos` tests and reports it")
    else:
        yield Capability(what, "yes", "60B0 has a separate RPDO, and is read back")


def _assess_feedforward(device: DeviceDescription, profile: DriveProfile) -> Capability:
    keys = (profile.speed_offset, profile.torque_offset)
    found = profile.find_rpdo(profile.speed_offset)
    if found is None or any(device.find_object(key) is None for key in keys) or len(found[0].entries) != len(keys):
        return Capability("feed-forward", "no", "no RPDO carries its speed and torque offset (60B1, 60B2) alone")
    return Capability("feed-forward", "yes", "60B1 and 60B2 have a separate RPDO")


def _assess_safety(device: DeviceDescription, profile: DriveProfile) -> Iterator[Capability]:
    code, listens = (
        device.find_object((int(Object.ABORT_CONNECTION_OPTION), 0)),
        device.find_object((int(Object.CONSUMER_HEARTBEAT), 1)),
    )
    if code is None or listens is None:
        lacking = "abort option (6007)" if code is None else "consumer heartbeat (1016)"
        advice = "commissioning tests whether it stops; otherwise it is not armed"
        yield Capability("stop alone", "perhaps", f"its EDS has no {lacking}", advice)
    else:
        values = " or ".join(map(str, profile.strict_abort_options))
        yield Capability("stop alone", "yes", f"6007 = {values} and 1016 make it stop when the heartbeat is lost")
    if device.find_object((int(Object.PRODUCER_HEARTBEAT), 0)) is None:
        yield Capability("heartbeat", "no", "it sends none (1017): only its PDOs show that it is alive")
        return
    period_ms = device.get_default(Object.PRODUCER_HEARTBEAT)
    if period_ms is None:
        yield Capability("heartbeat", "yes", "its EDS does not give its period (1017)", "set it to 100")
    elif not period_ms:
        yield Capability("heartbeat", "yes", "1017 is 0 by default", "set it to 100")
    else:
        yield Capability("heartbeat", "yes", f"1017 is {period_ms} ms")


def _assess_scale_checks(device: DeviceDescription) -> Iterator[Capability]:
    places = {
        "increments_per_rev": (Object.FEED_CONSTANT, Object.POSITION_ENCODER_RESOLUTION),
        "rated_current_a": (Object.RATED_CURRENT,),
        "rated_torque_nm": (Object.RATED_TORQUE,),
    }
    reported = {
        key: [i for i in indices if device.find_object((i, 0)) or device.find_object((i, 1))]
        for key, indices in places.items()
    }
    compared = [f"{key} ({', '.join(f'{i:04X}' for i in found)})" for key, found in reported.items() if found]
    own = [key for key, found in reported.items() if not found]
    if compared:
        yield Capability("compare scales", "yes", f"check compares {', '.join(compared)}")
    if own:
        yield Capability(
            "compare other scales", "no", f"the drive does not report {', '.join(own)}: verify them yourself"
        )


def _assess_rapid_signal(device: DeviceDescription, profile: DriveProfile) -> Capability:
    if profile.find_tpdo(profile.digital_inputs) is None or device.find_object(profile.digital_inputs) is None:
        return Capability(
            "rapid signal", "no", "no TPDO carries its inputs (60FD): rapids are inferred from the motion"
        )
    return Capability("rapid signal", "yes", "a bit of 60FD can signal G0; without one it is inferred")
