"""``fdhil eds``: capabilities of a drive with fdhil, from its EDS or DCF file."""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import tables
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import AS_JSON, FILE
from fdhil.errors import ConfigError, ConfigFault

if TYPE_CHECKING:
    from fdhil.drivers import Capability, DeviceDescription, DeviceObject, DriveProfile, PdoSpec

SCHEMA = "fdhil-eds-1"
COLOURS = {"yes": "green", "perhaps": "yellow", "no": "red"}
CANDIDATES = {"voltage": "a motor voltage or duty", "dc_link": "the DC link", "current": "a current"}
MOST_NAMED = 6


@click.command()
@click.argument("file", type=FILE)
@click.option(
    "--profile", "name", help="Profile to assess with: a packaged name or a TOML file (default: the vendor's)."
)
@AS_JSON
@require_delivered_answer
def eds(file: Path, name: str | None, as_json: bool) -> int:
    """Assess a drive from its EDS or DCF FILE: show what fdhil can do with it, and why.

    Suggests a profile for the vendor and the PDOs to set up. Lists the objects that may be a motor voltage, a DC link
    or a current. Nothing is sent. The drive itself may differ from its EDS.
    """
    from fdhil.drivers import assess_capabilities, find_similar_names, read_device, read_profile, suggest_profile

    if name is not None and name not in tables.DRIVE_PROFILES and not name.endswith(".toml"):
        near = difflib.get_close_matches(name, tables.DRIVE_PROFILES, n=1)
        advice = f"one of {', '.join(tables.DRIVE_PROFILES)}, or a TOML file"
        fault = ConfigFault("--profile", f"there is no {name[:60]!r}", f"did you mean {near[0]!r}?" if near else advice)
        raise ConfigError("fdhil eds", [fault])
    device = read_device(file)
    suggested = suggest_profile(device)
    profile = read_profile(name or suggested, file)
    found = assess_capabilities(device, profile)
    candidates = {what: find_similar_names(device, what) for what in ("voltage", "dc_link", "current")}
    if as_json:
        click.echo(json.dumps(_build_eds_document(device, profile, suggested, found, candidates)))
    else:
        _show_device(device, profile, suggested, found, candidates)
    return int(any(ability.what == "listen" and ability.answer == "no" for ability in found))


def _build_eds_document(
    device: DeviceDescription,
    profile: DriveProfile,
    suggested: str,
    found: Sequence[Capability],
    candidates: Mapping[str, Sequence[DeviceObject]],
) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "file": device.file,
        "device": {
            "vendor": device.vendor_name,
            "product": device.product_name,
            "vendor_id": device.vendor_id,
            "product_code": device.product_code,
            "is_drive": device.is_drive,
            "axes": list(device.logical_axes),
            "objects": len(device.objects),
            "rpdos": len(device.rpdos),
            "tpdos": len(device.tpdos),
        },
        "profile": profile.name,
        "suggested_profile": suggested,
        "notes": [*profile.notes, *device.ambiguities],
        "abilities": [asdict(ability) for ability in found],
        "named_alike": {what: [_describe_object(at) for at in objects] for what, objects in candidates.items()},
        "pdos": [_describe_pdo(spec) for spec in (*profile.rpdos, *profile.tpdos)],
    }


def _describe_object(at: DeviceObject) -> dict[str, Any]:
    in_tpdo = "yes" if at.fits_in_tpdo else "perhaps" if at.may_fit_in_tpdo else "no"
    entry = {"index": at.key[0], "sub": at.key[1], "name": at.name, "bits": at.bits, "signed": at.signed}
    return entry | {"access": at.access, "in_tpdo": in_tpdo}


def _describe_pdo(spec: PdoSpec) -> dict[str, Any]:
    entries = [[e.index, e.sub, e.bits, e.signed] for e in spec.entries]
    return {
        "name": spec.name,
        "cob_base": spec.cob_base,
        "every_sync": spec.every_sync,
        "valid": spec.valid,
        "entries": entries,
    }


def _show_device(
    device: DeviceDescription,
    profile: DriveProfile,
    suggested: str,
    found: Sequence[Capability],
    candidates: Mapping[str, Sequence[DeviceObject]],
) -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from fdhil.cli.status_view import open_console

    out = open_console()
    who = " ".join(filter(None, (device.vendor_name, device.product_name))) or "unnamed"
    out.print(Text(f"{device.file}: {who}, vendor {device.vendor_id:08X}, product {device.product_code:08X}"))
    if len(device.logical_axes) > 1:
        others = ", ".join(map(str, device.logical_axes[1:]))
        out.print(Text(f"it also has axes {others}: set drive.logical_axis for these"), soft_wrap=True)
    by = "suggested" if profile.name == suggested else f"{suggested} is suggested"
    title = f" ({profile.title})" if profile.title else ""
    out.print(Text(f"assessed with profile {profile.name}{title}; {by}"), soft_wrap=True)
    table = Table("", "", "why", box=box.SIMPLE_HEAD, pad_edge=False)
    for ability in found:
        why = f"{ability.why}; {ability.advice}" if ability.advice else ability.why
        table.add_row(Text(ability.what), Text(ability.answer, COLOURS[ability.answer]), Text(why))
    out.print(table)
    for what, objects in candidates.items():
        if objects:
            out.print(Text(f"by name, may be {CANDIDATES[what]}: {_list_candidates(objects)}"), soft_wrap=True)
    for note in (*profile.notes, *device.ambiguities) if device.is_drive else device.ambiguities:
        out.print(Text(f"note: {note}"), soft_wrap=True)
    _show_pdos(out, profile if device.is_drive else None)


def _list_candidates(objects: Sequence[DeviceObject]) -> str:
    listed = [f"{at.key[0]:04X}:{at.key[1]:02X} {at.name}{'' if at.fits_in_tpdo else ' (SDO)'}" for at in objects]
    more = f" and {len(listed) - MOST_NAMED} more" if len(listed) > MOST_NAMED else ""
    return "; ".join(listed[:MOST_NAMED]) + more


def _show_pdos(out: Any, profile: DriveProfile | None) -> None:
    from rich.text import Text

    for spec in (*profile.rpdos, *profile.tpdos) if profile else ():
        entries = ", ".join(f"{e.index:04X}:{e.sub:02X}/{e.bits}" for e in spec.entries)
        every = f"every {spec.every_sync} SYNC" if spec.valid else "not valid"
        out.print(Text(f"{spec.name} {spec.cob_base:03X}+node, {every}: {entries}"), soft_wrap=True)
