"""Turns the content of a vendor's EDS or DCF file into the objects of a simulated device.

Missing and impossible values are completed as the device must have meant them; meaningless ones are left out.
"""

import re
import struct
from dataclasses import dataclass, replace
from pathlib import Path

from fdhil.eds import EdsEntry, EdsObject, read_eds, read_expression
from fdhil.errors import EdsError
from fdhil.sim.drive.object_dictionary import (
    ARRAY,
    DOMAIN_OBJECT,
    RECORD,
    SIGNED,
    U8,
    VAR,
    DataType,
    DictionaryObject,
    Entry,
    Value,
)

_ACCESSES = frozenset({"ro", "wo", "rw", "rww", "rwr", "const"})
_FIRST_INDEX = 0x1000  # below are data types


@dataclass(frozen=True, slots=True)
class EdsFile:
    """A device by its file; ``objects`` have their defaults for one node-ID.

    ``given`` has the keys of the entries whose default the file states.
    """

    file: str
    name: str
    vendor: int
    product: int
    revision: int
    objects: tuple[DictionaryObject, ...]
    given: frozenset[int]


def read_eds_file(path: Path, node_id: int) -> EdsFile:
    """Read the file; EdsError when it cannot be read or has no object."""
    file = read_eds(path)
    given: set[int] = set()
    parts = sorted((part for part in file.objects if part.index >= _FIRST_INDEX), key=lambda part: part.index)
    objects = tuple(_object(part, node_id, given) for part in parts if part.entries)
    if not objects:
        raise EdsError(path.name, "it has no object; this is not an EDS file")
    vendor, product, revision = file.vendor_number or 0, file.product_number or 0, file.revision_number or 0
    name = file.product_name or path.stem
    return EdsFile(path.name, name, vendor, product, revision, objects, frozenset(given))


def _object(part: EdsObject, node_id: int, given: set[int]) -> DictionaryObject:
    in_order = sorted(part.entries, key=lambda entry: entry.sub)
    entries = tuple(_build_entry(entry, part.object_type, node_id, given) for entry in in_order)
    if part.object_type in (VAR, DOMAIN_OBJECT):
        return DictionaryObject(
            part.index, part.name, DOMAIN_OBJECT if entries[0].type is DataType.DOMAIN else VAR, entries
        )
    if entries[0].sub:  # a record must say how many it has
        entries = (Entry(part.index, 0, "Highest sub-index supported", U8, "const", entries[-1].sub), *entries)
    return DictionaryObject(part.index, part.name, part.object_type if part.object_type == ARRAY else RECORD, entries)


def _build_entry(part: EdsEntry, object_type: int, node_id: int, given: set[int]) -> Entry:
    try:
        kind = DataType(part.data_type)
    except ValueError:  # a type of the vendor's own
        kind = DataType.DOMAIN if object_type == DOMAIN_OBJECT else U8
    relative = (read_expression(part.default) or (0, False))[1]
    access = part.access if part.access in _ACCESSES else "ro"
    entry = Entry(part.index, part.sub, part.name, kind, access, mappable=part.mappable, node_relative=relative)
    default = _parse_default(entry, part.default, node_id)
    if default is None:
        return replace(entry, default=b"" if entry.size is None else 0)
    given.add(entry.key)
    low, high = (_parse_number(entry, text, node_id) for text in (part.low, part.high))
    if isinstance(default, int) and low is not None and high is not None and low <= default <= high and low < high:
        return replace(entry, default=default, low=low, high=high)
    return replace(entry, default=default)  # limits that forbid the default are none


def _parse_default(entry: Entry, text: str, node_id: int) -> Value | None:
    """The value at power-on, None where the file does not say it."""
    if entry.size is None:
        return text.encode("latin-1", "replace") if text else None
    return _parse_number(entry, text, node_id)


def _parse_number(entry: Entry, text: str, node_id: int) -> int | None:
    """A number as the entry's type holds it, the bits for a REAL; None when there is none."""
    if entry.type in (DataType.REAL32, DataType.REAL64):
        return _parse_real_bits(entry.type, text)
    found = read_expression(text)
    if found is None:
        return None
    bits = 8 * (entry.size or 8)
    value = (found[0] + node_id * found[1]) & (1 << bits) - 1
    return value - (1 << bits) if entry.type in SIGNED and value >> (bits - 1) else value


def _parse_real_bits(kind: DataType, text: str) -> int | None:
    if re.fullmatch(r"0[xX][0-9a-fA-F]+", text):
        return int(text, 16)
    try:
        value = float(text)
        return int.from_bytes(struct.pack("<f" if kind is DataType.REAL32 else "<d", value), "little")
    except (ValueError, OverflowError):
        return None
