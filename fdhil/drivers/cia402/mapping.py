"""Suggests PDOs for a device by its EDS: fast TPDOs with every SYNC, slow TPDOs, and RPDOs.

The layout is that of the packaged profiles: position and speed first, then statusword, current and voltage; demand and
offset in a slower one. A device's fixed mapping is adopted as it is.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

from fdhil.cia402 import COB_RPDO, COB_TPDO, Object, lay_out
from fdhil.drivers.cia402.device import Device, PdoPlace
from fdhil.drivers.cia402.profile import ObjectKey, PdoSpec

SLOW_EVERY = 10
SYNC_TYPES = range(1, 241)
MAX_BITS = 64
Entry = tuple[int, int, int, bool]


def suggest_rpdos(device: Device, target: ObjectKey, offset: ObjectKey, fed: Sequence[ObjectKey]) -> list[PdoSpec]:
    """Return RPDOs: controlword and target, the offset in a separate one, speed and torque offset disabled."""
    groups = [[(int(Object.CONTROLWORD), 0), target], [offset], list(fed)]
    places = [place for place in device.rpdos if _has_cob_id(place, COB_RPDO)]
    found: list[PdoSpec] = []
    for keys in groups:
        entries = [device.entry(key) for key in keys if _sent(device, key)]
        whole = [entry for entry in entries if entry is not None]
        if len(whole) < len(keys) or not places:
            continue
        place = places.pop(0)
        spec = _fixed(device, place, "RPDO", COB_RPDO) if place.fixed else _spec(place, "RPDO", COB_RPDO, whole)
        if spec is not None:
            found.append(spec if keys is not groups[2] else replace(spec, valid=False))
    return found


def suggest_tpdos(device: Device, fast: Iterable[ObjectKey], slow: Iterable[ObjectKey]) -> list[PdoSpec]:
    """Return TPDOs with ``fast`` at every SYNC and ``slow`` at every tenth, as far as they fit."""
    places, fast = [place for place in device.tpdos if _has_cob_id(place, COB_TPDO)], list(fast)
    if places and all(place.fixed for place in places):
        kept = [_fixed(device, place, "TPDO", COB_TPDO, fast) for place in places]
        return [spec for spec in kept if spec is not None]
    free = [place for place in places if not place.fixed]
    filled: list[tuple[PdoPlace, list[Entry], int]] = []
    for every, keys in ((1, fast), (SLOW_EVERY, slow)):
        for entry in filter(None, (device.entry(key) for key in keys if _heard(device, key))):
            mine = [pdo for pdo in filled if pdo[2] == every and _fits(pdo, entry)]
            if not mine and free:
                filled.append((free.pop(0), [], every))
                mine = [filled[-1]]
            for _, entries, _ in (mine or [pdo for pdo in filled if _fits(pdo, entry)])[:1]:
                entries.append(entry)
    return [_spec(place, "TPDO", COB_TPDO, entries, every) for place, entries, every in filled]


def offered(device: Device, pdos: Sequence[PdoSpec], *, sent: bool) -> list[PdoSpec]:
    """Return a profile's PDOs, reduced to the device's objects in their sizes; empty ones are left out."""
    found = []
    for spec in pdos:
        keys = [(entry.index, entry.sub) for entry in spec.entries]
        kept = [device.entry(key) for key in keys if (_sent if sent else _heard)(device, key)]
        entries = lay_out([entry for entry in kept if entry is not None])
        if entries and any(place.number == spec.number for place in (device.rpdos if sent else device.tpdos)):
            found.append(replace(spec, entries=entries))
    return found


def _fits(pdo: tuple[PdoPlace, list[Entry], int], entry: Entry) -> bool:
    place, entries, _ = pdo
    return len(entries) < place.room and sum(e[2] for e in entries) + entry[2] <= MAX_BITS


def _sent(device: Device, key: ObjectKey) -> bool:
    found = device.find(key)
    return found is not None and found.in_rpdo


def _heard(device: Device, key: ObjectKey) -> bool:
    found = device.find(key)
    return found is not None and (found.in_tpdo or found.perhaps_in_tpdo)


def _spec(place: PdoPlace, kind: str, bases: Sequence[int], entries: Sequence[Entry], every: int = 1) -> PdoSpec:
    return PdoSpec(f"{kind}{place.number}", place.number, _cob_base(place, bases), lay_out(entries), every)


def _has_cob_id(place: PdoPlace, bases: Sequence[int]) -> bool:
    return place.number <= len(bases) or bool(place.cob_base)


def _cob_base(place: PdoPlace, bases: Sequence[int]) -> int:
    return bases[place.number - 1] if place.number <= len(bases) else place.cob_base or 0


def _fixed(
    device: Device, place: PdoPlace, kind: str, bases: Sequence[int], fast: Collection[ObjectKey] = ()
) -> PdoSpec | None:
    """Return the device's own mapping; None where it maps an unknown object.

    Its transmission type is set where that is writable: to every SYNC for ``fast`` objects and set-points.
    """
    entries = [device.entry((word >> 16, word >> 8 & 0xFF)) for word in place.mapped]
    whole = [entry for entry in entries if entry is not None]
    if not whole or len(whole) < len(entries) or sum(entry[2] for entry in whole) > MAX_BITS:
        return None
    base = place.cob_base or _cob_base(place, bases)
    every = place.kind or 1
    if not place.kind_fixed and (every not in SYNC_TYPES or kind == "RPDO" or any(e[:2] in fast for e in whole)):
        slow = kind == "TPDO" and not any(entry[:2] in fast for entry in whole)
        every = SLOW_EVERY if slow else 1
    return PdoSpec(f"{kind}{place.number}", place.number, base, lay_out(whole), every, place.valid)
