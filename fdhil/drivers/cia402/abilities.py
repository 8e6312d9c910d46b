"""Determines what fdhil can do with a device, by its EDS and a profile: each capability with its reason.

An EDS is the vendor's statement. ``perhaps`` means that only the drive itself can settle it.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from fdhil import tables
from fdhil.cia402 import Object
from fdhil.drivers.cia402.device import Device, DeviceObject, PdoPlace
from fdhil.drivers.cia402.mapping import SYNC_TYPES
from fdhil.drivers.cia402.profile import DriveProfile, ObjectKey, PdoSpec
from fdhil.drivers.cia402.profile_file import read_profile

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
class Ability:
    """One capability: whether fdhil has it with this drive, why, and advice (may be empty)."""

    what: str
    answer: Answer
    why: str
    advice: str = ""


def abilities(device: Device, profile: DriveProfile) -> list[Ability]:
    """Return the capabilities with this profile, each after those it depends on."""
    if not device.is_drive:
        kind = (device.default(Object.DEVICE_TYPE) or 0) & 0xFFFF
        why = f"its device type is profile {kind or 'none'}, or it has no control- and statusword (6040, 6041)"
        return [Ability("listen", "no", why, "it is not a CiA 402 drive; configure it as a sensor, if it is one")]
    return [
        *_listen(device, profile),
        _mapped(device, profile),
        _voltage(device, profile),
        _demand(device, profile),
        *_correct(device, profile),
        _feedforward(device, profile),
        *_safety(device, profile),
        *_scale(device),
        _rapids(device, profile),
    ]


def suggest_profile(device: Device) -> str:
    """Return the packaged profile of the device's vendor that fits its objects best, else ``cia402``."""
    named = [name for name in tables.DRIVE_PROFILES if name not in (GENERIC_PROFILE, _TWIN) and _is_of(device, name)]
    return min(named, key=lambda name: len(missing(device, read_profile(name))), default=GENERIC_PROFILE)


def _is_of(device: Device, name: str) -> bool:
    profile = read_profile(name)
    if profile.vendor_id is not None and device.vendor_id:
        return profile.vendor_id == device.vendor_id
    words = re.findall(r"[a-z]{4,}", device.vendor_name.lower())
    return any(word in profile.title.lower() for word in words if word not in ("motor", "gmbh", "motion", "control"))


def missing(device: Device, profile: DriveProfile) -> list[ObjectKey]:
    """Return the objects that the profile maps and the device lacks, or has in another size."""
    entries = [entry for spec in (*profile.rpdos, *profile.tpdos) for entry in spec.entries]
    found = {(entry.index, entry.sub): device.find((entry.index, entry.sub)) for entry in entries}
    bits = {(entry.index, entry.sub): entry.bits for entry in entries}
    return [key for key, at in found.items() if at is None or at.bits != bits[key]]


def named_alike(device: Device, what: Literal["voltage", "dc_link", "current"]) -> list[DeviceObject]:
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


def shown(key: ObjectKey) -> str:
    """Format an object as 6064:00."""
    return f"{key[0]:04X}:{key[1]:02X}"


def _listen(device: Device, profile: DriveProfile) -> Iterator[Ability]:
    if profile.unheard:
        what = ", ".join(f"{name} ({shown(getattr(profile, name))})" for name in profile.unheard)
        advice = "name the vendor's object for it in your own profile, with base = 'cia402'"
        yield Ability("listen", "no", f"no TPDO with every SYNC can carry its {what}", advice)
        return
    if device.find((SYNC_ID, 0)) is None and not any(place.kind in SYNC_TYPES for place in device.tpdos):
        yield Ability("listen", "perhaps", "its EDS has no SYNC (1005): its TPDOs may be sent by a timer only")
    else:
        yield Ability("listen", "yes", "position, speed, current and statusword can come with every SYNC")


def _mapped(device: Device, profile: DriveProfile) -> Ability:
    differ = [spec.name for spec in profile.rpdos if not _same(spec, device.rpdos)]
    differ += [spec.name for spec in profile.tpdos if not _same(spec, device.tpdos)]
    if not differ:
        return Ability("mapping", "yes", "its default PDOs are the profile's")
    specs = [*((spec, device.rpdos) for spec in profile.rpdos), *((spec, device.tpdos) for spec in profile.tpdos)]
    stuck = [spec.name for spec, places in specs if spec.name in differ and _stuck(spec, places)]
    if stuck:
        why = f"it has no {', '.join(stuck)}, or one whose mapping, COB-ID or type differs and is fixed"
        return Ability("mapping", "no", why, "choose profile 'cia402', which uses what the EDS offers")
    why = f"{', '.join(differ)} must be set up: the defaults differ"
    return Ability("mapping", "yes", why, "`fdhil commission --set-pdos`, or the drive's own tool")


def _same(spec: PdoSpec, places: Sequence[PdoPlace]) -> bool:
    place = _place_of(spec, places)
    if place is None or place.mapped != _words(spec):
        return False
    return place.valid == spec.valid and place.cob_base == spec.cob_base and place.kind == spec.every_sync


def _stuck(spec: PdoSpec, places: Sequence[PdoPlace]) -> bool:
    place = _place_of(spec, places)
    if place is None or (place.fixed and place.mapped != _words(spec)):
        return True
    other_id = place.valid != spec.valid or place.cob_base not in (None, spec.cob_base)
    return (place.cob_fixed and other_id) or (place.kind_fixed and place.kind != spec.every_sync)


def _place_of(spec: PdoSpec, places: Sequence[PdoPlace]) -> PdoPlace | None:
    return next((place for place in places if place.number == spec.number), None)


def _words(spec: PdoSpec) -> tuple[int, ...]:
    return tuple(entry.mapping for entry in spec.entries)


def _voltage(device: Device, profile: DriveProfile) -> Ability:
    what, keys = "voltage", profile.voltage_objects
    if keys:
        if not profile.duty_per_count:
            return Ability(what, "yes", f"{shown(keys[0])} is the terminal voltage")
        link = f"the DC link ({shown(keys[1])})" if len(keys) > 1 else "drive.dc_link_v"
        why = f"{shown(keys[0])} (duty) times {link}: without dead time and drops of the stage, R comes out too large"
        return Ability(what, "yes", why, "check it once against a meter")
    if profile.voltage is not None:
        why = (
            f"it has no {shown(profile.voltage)} that a TPDO could carry: K, Jt and friction can be "
            "identified, R and L cannot"
        )
        return Ability(what, "no", why, SENSOR)
    alike = [at for at in named_alike(device, "voltage") if at.in_tpdo or at.perhaps_in_tpdo]
    if alike:
        why = f"the profile has none, but by its name {_names(alike)} may be one"
        return Ability(what, "perhaps", why, "measure its scale, and set voltage and its unit in your own profile")
    why = "no object that a TPDO can carry is a motor voltage: K, Jt and friction can be identified, R and L cannot"
    return Ability(what, "no", why, SENSOR)


def _names(found: Sequence[DeviceObject]) -> str:
    listed = ", ".join(f"{shown(at.key)} {at.name!r}" for at in found[:3])
    return f"{listed} and {len(found) - 3} more" if len(found) > 3 else listed


def _demand(device: Device, profile: DriveProfile) -> Ability:
    what = "follow an NC"
    at = profile.find_rpdo(profile.target)
    if at is None:
        return Ability(what, "no", f"no RPDO carries its target ({shown(profile.target)})", "it can only be identified")
    modes = device.default(Object.SUPPORTED_MODES)
    if profile.mode < 1:
        return Ability(what, "perhaps", f"set-points are streamed in the vendor's mode {profile.mode}")
    if modes is None:
        return Ability(what, "perhaps", "its EDS does not list its modes (6502); query the drive with `fdhil check`")
    if modes >> (profile.mode - 1) & 1:
        return Ability(what, "yes", f"set-points are streamed to {shown(profile.target)} (6502 = {modes:08X})")
    why = f"it has no mode {profile.mode} (6502 = {modes:08X}): set-points cannot be streamed"
    return Ability(what, "no", why, "it can be identified, but not corrected")


def _correct(device: Device, profile: DriveProfile) -> Iterator[Ability]:
    what, advice = "correct on line", "let the NC play the corrected demand of `fdhil correct --out`"
    offset = device.find(profile.offset)
    if offset is None or profile.find_rpdo(profile.offset) is None:
        why = "it has no position offset (60B0)" if offset is None else "no RPDO can carry its 60B0"
        yield Ability(what, "no", why, advice)
    elif profile.unshown:
        why = (
            f"no TPDO shows its {', '.join(map(shown, profile.unshown))}, and offsets are only sent where "
            "they can be read back"
        )
        yield Ability(what, "no", why, advice)
    elif not offset.in_tpdo:
        why = (
            "its EDS allows 60B0 in RPDOs only (rww): whether a TPDO accepts it for the read-back, only a "
            "test on the drive shows"
        )
        yield Ability(what, "perhaps", why, "`fdhil commission --set-pdos` tests and reports it")
    else:
        yield Ability(what, "yes", "60B0 has a separate RPDO, and is read back")


def _feedforward(device: Device, profile: DriveProfile) -> Ability:
    keys = (profile.speed_offset, profile.torque_offset)
    found = profile.find_rpdo(profile.speed_offset)
    if found is None or any(device.find(key) is None for key in keys) or len(found[0].entries) != len(keys):
        return Ability("feed-forward", "no", "no RPDO carries its speed and torque offset (60B1, 60B2) alone")
    return Ability("feed-forward", "yes", "60B1 and 60B2 have a separate RPDO")


def _safety(device: Device, profile: DriveProfile) -> Iterator[Ability]:
    code, listens = (
        device.find((int(Object.ABORT_CONNECTION_OPTION), 0)),
        device.find((int(Object.CONSUMER_HEARTBEAT), 1)),
    )
    if code is None or listens is None:
        lacking = "abort option (6007)" if code is None else "consumer heartbeat (1016)"
        advice = "commissioning tests whether it stops; otherwise it is not armed"
        yield Ability("stop alone", "perhaps", f"its EDS has no {lacking}", advice)
    else:
        values = " or ".join(map(str, profile.strict_abort_options))
        yield Ability("stop alone", "yes", f"6007 = {values} and 1016 make it stop when the heartbeat is lost")
    if device.find((int(Object.PRODUCER_HEARTBEAT), 0)) is None:
        yield Ability("heartbeat", "no", "it sends none (1017): only its PDOs show that it is alive")
        return
    period_ms = device.default(Object.PRODUCER_HEARTBEAT)
    if period_ms is None:
        yield Ability("heartbeat", "yes", "its EDS does not give its period (1017)", "set it to 100")
    elif not period_ms:
        yield Ability("heartbeat", "yes", "1017 is 0 by default", "set it to 100")
    else:
        yield Ability("heartbeat", "yes", f"1017 is {period_ms} ms")


def _scale(device: Device) -> Iterator[Ability]:
    places = {
        "increments_per_rev": (Object.FEED_CONSTANT, Object.POSITION_ENCODER_RESOLUTION),
        "rated_current_a": (Object.RATED_CURRENT,),
        "rated_torque_nm": (Object.RATED_TORQUE,),
    }
    reported = {
        key: [i for i in indices if device.find((i, 0)) or device.find((i, 1))] for key, indices in places.items()
    }
    compared = [f"{key} ({', '.join(f'{i:04X}' for i in found)})" for key, found in reported.items() if found]
    own = [key for key, found in reported.items() if not found]
    if compared:
        yield Ability("compare scales", "yes", f"check compares {', '.join(compared)}")
    if own:
        yield Ability("compare other scales", "no", f"the drive does not report {', '.join(own)}: verify them yourself")


def _rapids(device: Device, profile: DriveProfile) -> Ability:
    if profile.find_tpdo(profile.digital_inputs) is None or device.find(profile.digital_inputs) is None:
        return Ability("rapid signal", "no", "no TPDO carries its inputs (60FD): rapids are inferred from the motion")
    return Ability("rapid signal", "yes", "a bit of 60FD can signal G0; without one it is inferred")
