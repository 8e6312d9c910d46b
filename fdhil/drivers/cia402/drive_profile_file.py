"""Reads drive profiles: packaged ones by name, the user's own from a TOML file, the generic one from an EDS.

A file may begin with ``base = "epos4"``: other keys are then inherited from that profile. A table or list (``rpdos``,
``tpdos``) replaces the inherited one as a whole.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from fdhil import tables
from fdhil.cia402 import LOGICAL_AXIS_STEP, Object, lay_out
from fdhil.config import Drive, read_toml
from fdhil.drivers.cia402.device_description import read_device
from fdhil.drivers.cia402.drive_profile import LOGICAL_AXIS_PDOS, DriveProfile, ObjectKey, PdoSpec, decode_speed_unit
from fdhil.drivers.cia402.pdo_mapping import match_pdos, suggest_rpdos, suggest_tpdos
from fdhil.errors import ConfigError, ConfigFault

MOST_BASES = 8
NO_OFFSET_ADVICE = "let the NC play the corrected demand of `fdhil correct --out`; this axis needs no commissioning"
_PDO_KEYS = frozenset({"name", "cob_base", "entries", "every_sync", "valid"})
_KINDS: Mapping[str, TypeAdapter[Any]] = {
    name: TypeAdapter(hint) for name, hint in get_type_hints(DriveProfile).items() if name not in ("rpdos", "tpdos")
}


def load_profile(drive: Drive) -> DriveProfile:
    """Return the profile that ``[axis.X.drive]`` names, for that axis of its device.

    ConfigError when its file is unreadable or invalid, or maps too little. A process reads a file once: changes on disk
    take effect at its next start.
    """
    profile = read_profile(drive.profile, drive.eds)
    if drive.source == "hal" and drive.hal is not None and drive.hal.voltage is None:
        profile = replace(profile, voltage=None)
    if deaf := profile.missing_signals:
        what = f"no TPDO with every SYNC carries its {', '.join(deaf)}"
        raise _make_error(
            profile.name, "tpdos", what, "`fdhil eds` shows what the drive offers; write your own profile by it"
        )
    if drive.logical_axis == profile.logical_axis:
        return profile
    if profile.logical_axis != 1:
        what = f"it is for axis {profile.logical_axis} of its device, but the configuration has {drive.logical_axis}"
        raise _make_error(profile.name, "logical_axis", what, "make both the same")
    return _shift_to_axis(profile, drive.logical_axis)


def require_offset(profile: DriveProfile, axis: str) -> None:
    """Raise ConfigError with advice where the drive takes no offset."""
    if not profile.can_take_offset:
        raise _make_error("config", f"axis.{axis}.drive.profile", explain_missing_offset(profile), NO_OFFSET_ADVICE)


def explain_missing_offset(profile: DriveProfile) -> str:
    """Explain why nothing can be added to the set-points of this drive."""
    if profile.find_rpdo(profile.offset) is not None and profile.unmapped_read_backs:
        unseen = ", ".join(f"{index:04X}:{sub:02X}" for index, sub in profile.unmapped_read_backs)
        return (
            f"profile {profile.name} maps {unseen} into no TPDO, and offsets are only sent where they can be read back"
        )
    index, sub = profile.offset
    return f"profile {profile.name} maps no offset ({index:04X}:{sub:02X}) into a valid RPDO: none can be sent"


@cache
def read_profile(name: str, eds: Path | None = None) -> DriveProfile:
    """Return a profile by its packaged name or path, complete or not; ConfigError, EdsError.

    With the drive's EDS it is reduced to what that offers.
    """
    document, title = _read_document(name), name if name in tables.DRIVE_PROFILES else Path(name).stem
    if "tpdos" not in document and "rpdos" not in document:
        return build_profile(_map_from_eds(document, name, eds), title, name)
    profile = build_profile(document, title, name)
    if eds is None:
        return profile
    device = read_device(eds)
    rpdos, tpdos = match_pdos(device, profile.rpdos, sent=True), match_pdos(device, profile.tpdos, sent=False)
    return replace(profile, rpdos=tuple(rpdos), tpdos=tuple(tpdos))


def _map_from_eds(document: Mapping[str, Any], name: str, eds: Path | None) -> dict[str, Any]:
    if eds is None:
        advice = "set drive.eds to the vendor's file for the drive"
        raise _make_error(name, "tpdos", "are missing in this profile, and there is no EDS to derive them from", advice)
    device = read_device(eds)
    defaults: dict[str, Any] = {"vendor_id": device.vendor_id or None}
    if unit := decode_speed_unit(device.get_default(Object.VELOCITY_UNIT)):
        defaults["speed_unit"] = unit
    if not device.find_object((0x6078, 0)) and "current" not in document:
        defaults |= {"current": (0x6077, 0), "current_unit": "permille_of_rated_torque"}
    complete = defaults | dict(document)
    bare = build_profile(complete | {"rpdos": (), "tpdos": ()}, name, name)
    fast = (bare.position, bare.speed, bare.statusword, bare.current, bare.voltage, bare.dc_link)
    slow = (bare.position_demand, bare.offset, (int(Object.MODE_DISPLAY), 0), bare.digital_inputs)
    rpdos = suggest_rpdos(device, bare.target, bare.offset, (bare.speed_offset, bare.torque_offset))
    tpdos = suggest_tpdos(device, [key for key in fast if key is not None], slow)
    return complete | {"rpdos": rpdos, "tpdos": tpdos}


def _read_document(name: str, depth: int = 0) -> dict[str, Any]:
    if depth > MOST_BASES:
        raise _make_error(name, "base", "is nested too deeply, or circular", "base it on a packaged profile")
    document = _read_toml(name)
    base = document.pop("base", None)
    if base is None:
        return document
    if not isinstance(base, str) or (base not in tables.DRIVE_PROFILES and not base.endswith(".toml")):
        raise _make_error(
            name, "base", f"is not a profile: {str(base)[:60]!r}", f"one of {', '.join(tables.DRIVE_PROFILES)}"
        )
    if base.endswith(".toml"):
        base = str(Path(name).parent / base)
    return _read_document(base, depth + 1) | document


def _read_toml(name: str) -> dict[str, Any]:
    if name in tables.DRIVE_PROFILES:
        package, _, file = tables.DRIVE_PROFILES[name].partition(":")
        return tomllib.loads((files(package) / file).read_text("utf-8"))
    advice = "drive.profile is a packaged name, or a path from the configuration's folder"
    return read_toml(Path(name), "a profile", advice)


def build_profile(document: Mapping[str, Any], name: str, source: str) -> DriveProfile:
    """Build a profile from the tables of its file; ConfigError with every fault and its location."""
    faults: list[ConfigFault] = []
    values: dict[str, Any] = {}
    known = {field.name for field in fields(DriveProfile)} - {"name"}
    for key, given in document.items():
        if key not in known:
            faults.append(ConfigFault(key, "is not a key of a profile", f"one of {', '.join(sorted(known))}"))
        elif key not in ("rpdos", "tpdos"):
            try:
                values[key] = _KINDS[key].validate_python(given)
            except ValidationError as error:
                faults.append(ConfigFault(key, error.errors(include_url=False)[0]["msg"]))
    values |= {kind: _parse_pdos(document.get(kind), kind, faults) for kind in ("rpdos", "tpdos")}
    if faults:
        raise ConfigError(source, faults)
    return DriveProfile(name, **values)


def _parse_pdos(given: Any, kind: str, faults: list[ConfigFault]) -> tuple[PdoSpec, ...]:
    if not isinstance(given, Sequence) or isinstance(given, str):
        faults.append(ConfigFault(kind, "is missing", f"a table [[{kind}]] for each PDO"))
        return ()
    found = []
    for place, table in enumerate(given, 1):
        try:
            found.append(table if isinstance(table, PdoSpec) else _parse_pdo(table))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            text = f"has no {error}" if isinstance(error, KeyError) else str(error)
            advice = "name = 'TPDO1', cob_base = 0x180, entries = [[index, sub-index, bits, signed], ...]"
            faults.append(ConfigFault(f"{kind}.{place}", text, advice))
    return tuple(found)


def _parse_pdo(table: Mapping[str, Any]) -> PdoSpec:
    if unknown := table.keys() - _PDO_KEYS:
        raise ValueError(f"{', '.join(sorted(unknown))} is not a key of a PDO")
    name = str(table["name"])
    digits = name.removeprefix(name.rstrip("0123456789"))
    if not digits or not 1 <= int(digits) <= 512:
        raise ValueError(f"its name {name[:20]!r} does not end in the number of the PDO")
    entries = [_parse_entry(each) for each in table["entries"]]
    every_sync, valid = int(table.get("every_sync", 1)), table.get("valid", True)
    if not 1 <= every_sync <= 240 or type(valid) is not bool or not 0x180 <= table["cob_base"] <= 0x57F:
        raise ValueError(
            "every_sync is not from 1 to 240, valid not true or false, or cob_base not from 0x180 to 0x57F"
        )
    return PdoSpec(name, int(digits), int(table["cob_base"]), lay_out(entries), every_sync, valid)


def _parse_entry(given: Sequence[Any]) -> tuple[int, int, int, bool]:
    index, sub, bits, signed = given
    if not 1 <= index <= 0xFFFF or not 0 <= sub <= 0xFF or not 1 <= bits <= 64 or type(signed) is not bool:
        raise ValueError(f"{list(given)} is not [index, sub-index, bits, signed]")
    return int(index), int(sub), int(bits), signed


def _shift_to_axis(profile: DriveProfile, number: int) -> DriveProfile:
    """Return the profile of a device's ``number``-th axis, derived from that of the first.

    Its objects are 0x800 higher (CiA 402-2), its PDOs 64 higher (CiA 402-3), and their COB-IDs those of a node-ID that
    much higher, which the device must be set to: CiA 301 has no default for them.
    """
    places = [field.name for field in fields(profile) if isinstance(getattr(profile, field.name), tuple)]
    keys = [name for name in places if name not in ("rpdos", "tpdos", "notes", "strict_abort_options")]
    up = number - 1

    def shift_key(key: ObjectKey) -> ObjectKey:
        return key[0] + up * LOGICAL_AXIS_STEP if 0x6000 <= key[0] < 0x6800 else key[0], key[1]

    def shift_pdo(spec: PdoSpec) -> PdoSpec:
        place = spec.number + up * LOGICAL_AXIS_PDOS
        entries = tuple(replace(entry, index=shift_key((entry.index, entry.sub))[0]) for entry in spec.entries)
        name = f"{spec.name.rstrip('0123456789')}{place}"
        return replace(spec, name=name, number=place, cob_base=spec.cob_base + up, entries=entries)

    values: dict[str, Any] = {name: shift_key(getattr(profile, name)) for name in keys}
    values |= {kind: tuple(map(shift_pdo, getattr(profile, kind))) for kind in ("rpdos", "tpdos")}
    return replace(profile, logical_axis=number, **values)


def _make_error(source: str, path: str, what: str, advice: str) -> ConfigError:
    return ConfigError(source, [ConfigFault(path, what, advice)])
