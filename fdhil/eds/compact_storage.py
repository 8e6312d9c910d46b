"""Expands the compact storage of EDS and DCF files (CiA 306): CompactSubObj, [1A00Value], CompactPDO.

Works on sections by their names (``1A00``, ``1A00sub1``, ``1A00Value``); each section is a mapping of keys to texts.
"""

import re
from collections.abc import Iterator, Mapping

from fdhil.cia402 import COB_RPDO, COB_TPDO, Object
from fdhil.eds.eds_numbers import read_number

MOST_PDOS = 512
Keys = Mapping[str, str]
_LIST = re.compile(r"([0-9A-F]{4})(Name|Value|Denotation)", re.IGNORECASE)
_UNSIGNED8, _UNSIGNED16, _UNSIGNED32 = "5", "6", "7"
_ARRAY, _RECORD = "8", "9"
# bits of CompactPDO: the communication parameters of each PDO; COB-ID and type always exist
_PARAMETERS = ((1, _UNSIGNED32), (2, _UNSIGNED8), (3, _UNSIGNED16), (4, _UNSIGNED8), (5, _UNSIGNED16), (6, _UNSIGNED8))


def is_value_list(title: str) -> bool:
    """Return whether a section lists names or values of an object's sub-objects."""
    return _LIST.fullmatch(title) is not None


def expand_compact_storage(sections: Mapping[str, Keys], most: int) -> Mapping[str, Keys]:
    """Return the sections that the compact form implies, and existing ones with their values from value lists.

    Expansion stops when there are more than ``most``.
    """
    made: dict[str, Keys] = dict(_expand_pdos(sections))
    for title, keys in {**sections, **made}.items():
        if len(made) > most:
            return made
        if len(title) == 4 and (count := read_number(keys.get("CompactSubObj", ""))):
            for sub, part in _expand_sub_objects(sections, title, keys, count):
                made.setdefault(f"{title}sub{sub:X}", part)
    for title, keys in sections.items():
        if (found := _LIST.fullmatch(title)) and found[2].lower() == "value":
            for name, value in keys.items():
                place = f"{found[1].upper()}sub{int(name):X}" if name.isdecimal() else ""
                if place in made or place in sections:
                    made[place] = {**sections.get(place, {}), **made.get(place, {}), "ParameterValue": value}
    return made


def _expand_sub_objects(
    sections: Mapping[str, Keys], title: str, keys: Keys, count: int
) -> Iterator[tuple[int, dict[str, str]]]:
    names = next((names for at, names in sections.items() if at.lower() == f"{title}name".lower()), {})
    shared = {key: keys[key] for key in ("DataType", "AccessType", "PDOMapping", "DefaultValue") if key in keys}
    shared |= {key: keys[key] for key in ("LowLimit", "HighLimit") if key in keys}
    name = keys.get("ParameterName", title)
    entries = {"ParameterName": "Number of entries", "DataType": _UNSIGNED8, "AccessType": keys.get("AccessType", "ro")}
    yield 0, {**entries, "DefaultValue": str(count)}
    for sub in range(1, count + 1):
        yield sub, {**shared, "ParameterName": names.get(str(sub), f"{name} {sub}")}


def _expand_pdos(sections: Mapping[str, Keys]) -> Iterator[tuple[str, dict[str, str]]]:
    device: Keys = sections.get("DeviceInfo", {})
    mask = read_number(device.get("CompactPDO", "")) or 0
    granularity = read_number(device.get("Granularity", "")) or 0
    if not mask:
        return
    kinds = (
        ("NrOfRXPDO", Object.RPDO_PARAMETER, Object.RPDO_MAPPING, COB_RPDO),
        ("NrOfTXPDO", Object.TPDO_PARAMETER, Object.TPDO_MAPPING, COB_TPDO),
    )
    for key, parameter, mapping, bases in kinds:
        for place in range(min(read_number(device.get(key, "")) or 0, MOST_PDOS)):
            at = f"{parameter + place:04X}"
            if at not in sections:
                cob_id = f"$NODEID+{bases[place]:#x}" if place < len(bases) else "0x80000000"
                yield from _describe_communication(at, mask, cob_id)
            at = f"{mapping + place:04X}"
            if at not in sections:
                room = 64 // granularity if 0 < granularity <= 64 else 8
                access = "rw" if granularity else "ro"
                head = {"ParameterName": "PDO mapping", "ObjectType": _ARRAY, "DataType": _UNSIGNED32}
                yield at, {**head, "AccessType": access, "DefaultValue": "0", "CompactSubObj": str(room)}


def _describe_communication(title: str, mask: int, cob_id: str) -> Iterator[tuple[str, dict[str, str]]]:
    yield title, {"ParameterName": "PDO communication parameter", "ObjectType": _RECORD}
    had = [(sub, kind) for sub, kind in _PARAMETERS if sub <= 2 or mask >> (sub - 1) & 1]
    first = {"ParameterName": "Number of entries", "DataType": _UNSIGNED8, "AccessType": "ro"}
    yield f"{title}sub0", {**first, "DefaultValue": str(had[-1][0])}
    for sub, kind in had:
        keys = {"ParameterName": f"PDO communication parameter {sub}", "DataType": kind, "AccessType": "rw"}
        yield f"{title}sub{sub:X}", {**keys, "DefaultValue": cob_id} if sub == 1 else keys
