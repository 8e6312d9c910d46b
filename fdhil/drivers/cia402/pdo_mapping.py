"""Suggests PDOs for a device by its EDS: fast TPDOs with every SYNC, slow TPDOs, and RPDOs.

The layout is that of the packaged profiles: position and speed first, then statusword, current and voltage; demand and
offset in a slower one. A device's fixed mapping is adopted as it is.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

from fdhil.cia402 import COB_RPDO, COB_TPDO, Object, lay_out
from fdhil.drivers.cia402.device_description import DeviceDescription, PdoSlot
from fdhil.drivers.cia402.drive_profile import ObjectKey, PdoSpec

SLOW_EVERY = 10
SYNC_TYPES = range(1, 241)
MAX_BITS = 64
Entry = tuple[int, int, int, bool]


def suggest_rpdos(
    device: DeviceDescription, target: ObjectKey, offset: ObjectKey, fed: Sequence[ObjectKey]
) -> list[PdoSpec]:
    """Return RPDOs: controlword and target, the offset in a separate one, speed and torque offset disabled."""
    groups = [[(int(Object.CONTROLWORD), 0), target], [offset], list(fed)]
    places = [place for place in device.rpdos if _has_cob_id(place, COB_RPDO)]
    found: list[PdoSpec] = []
    for keys in groups:
        entries = [device.get_mapping_entry(key) for key in keys if _is_sendable(device, key)]
        whole = [entry for entry in entries if entry is not None]
        if len(whole) < len(keys) or not places:
            continue
        place = places.pop(0)
        spec = (
            _adopt_fixed_mapping(device, place, "RPDO", COB_RPDO)
            if place.fixed
            else _build_spec(place, "RPDO", COB_RPDO, whole)
        )
        if spec is not None:
            found.append(spec if keys is not groups[2] else replace(spec, valid=False))
    return found


def suggest_tpdos(device: DeviceDescription, fast: Iterable[ObjectKey], slow: Iterable[ObjectKey]) -> list[PdoSpec]:
    """Return TPDOs with ``fast`` at every SYNC and ``slow`` at every tenth, as far as they fit."""
    places, fast = [place for place in device.tpdos if _has_cob_id(place, COB_TPDO)], list(fast)
    if places and all(place.fixed for place in places):
        kept = [_adopt_fixed_mapping(device, place, "TPDO", COB_TPDO, fast) for place in places]
        return [spec for spec in kept if spec is not None]
    free = [place for place in places if not place.fixed]
    filled: list[tuple[PdoSlot, list[Entry], int]] = []
    for every, keys in ((1, fast), (SLOW_EVERY, slow)):
        for entry in filter(None, (device.get_mapping_entry(key) for key in keys if _is_receivable(device, key))):
            mine = [pdo for pdo in filled if pdo[2] == every and _has_room(pdo, entry)]
            if not mine and free:
                filled.append((free.pop(0), [], every))
                mine = [filled[-1]]
            for _, entries, _ in (mine or [pdo for pdo in filled if _has_room(pdo, entry)])[:1]:
                entries.append(entry)
    return [_build_spec(place, "TPDO", COB_TPDO, entries, every) for place, entries, every in filled]


def match_pdos(device: DeviceDescription, pdos: Sequence[PdoSpec], *, sent: bool) -> list[PdoSpec]:
    """Return a profile's PDOs, reduced to the device's objects in their sizes; empty ones are left out."""
    found = []
    for spec in pdos:
        keys = [(entry.index, entry.sub) for entry in spec.entries]
        kept = [
            device.get_mapping_entry(key) for key in keys if (_is_sendable if sent else _is_receivable)(device, key)
        ]
        entries = lay_out([entry for entry in kept if entry is not None])
        if entries and any(place.number == spec.number for place in (device.rpdos if sent else device.tpdos)):
            found.append(replace(spec, entries=entries))
    return found


def _has_room(pdo: tuple[PdoSlot, list[Entry], int], entry: Entry) -> bool:
    place, entries, _ = pdo
    return len(entries) < place.room and sum(e[2] for e in entries) + entry[2] <= MAX_BITS


def _is_sendable(device: DeviceDescription, key: ObjectKey) -> bool:
    found = device.find_object(key)
    return found is not None and found.fits_in_rpdo


def _is_receivable(device: DeviceDescription, key: ObjectKey) -> bool:
    found = device.find_object(key)
    return found is not None and (found.fits_in_tpdo or found.may_fit_in_tpdo)


def _build_spec(place: PdoSlot, kind: str, bases: Sequence[int], entries: Sequence[Entry], every: int = 1) -> PdoSpec:
    return PdoSpec(f"{kind}{place.number}", place.number, _choose_cob_base(place, bases), lay_out(entries), every)


def _has_cob_id(place: PdoSlot, bases: Sequence[int]) -> bool:
    return place.number <= len(bases) or bool(place.cob_base)


def _choose_cob_base(place: PdoSlot, bases: Sequence[int]) -> int:
    return bases[place.number - 1] if place.number <= len(bases) else place.cob_base or 0


def _adopt_fixed_mapping(
    device: DeviceDescription, place: PdoSlot, kind: str, bases: Sequence[int], fast: Collection[ObjectKey] = ()
) -> PdoSpec | None:
    """Return the device's own mapping; None where it maps an unknown object.

    Its transmission type is set where that is writable: to every SYNC for ``fast`` objects and set-points.
    """
    entries = [device.get_mapping_entry((word >> 16, word >> 8 & 0xFF)) for word in place.mapped]
    whole = [entry for entry in entries if entry is not None]
    if not whole or len(whole) < len(entries) or sum(entry[2] for entry in whole) > MAX_BITS:
        return None
    base = place.cob_base or _choose_cob_base(place, bases)
    every = place.kind or 1
    if not place.kind_fixed and (every not in SYNC_TYPES or kind == "RPDO" or any(e[:2] in fast for e in whole)):
        slow = kind == "TPDO" and not any(entry[:2] in fast for entry in whole)
        every = SLOW_EVERY if slow else 1
    return PdoSpec(f"{kind}{place.number}", place.number, base, lay_out(whole), every, place.valid)
