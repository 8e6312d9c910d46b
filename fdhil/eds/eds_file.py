"""Holds the content of an EDS or DCF file as plain records."""

from collections.abc import Mapping
from dataclasses import dataclass

# data types of CiA 301, 7.4.7.1: bits, and whether signed
INTEGER_TYPES: Mapping[int, tuple[int, bool]] = {
    0x01: (1, False), 0x02: (8, True), 0x03: (16, True), 0x04: (32, True), 0x05: (8, False), 0x06: (16, False),
    0x07: (32, False), 0x10: (24, True), 0x12: (40, True), 0x13: (48, True), 0x14: (56, True), 0x15: (64, True),
    0x16: (24, False), 0x18: (40, False), 0x19: (48, False), 0x1A: (56, False), 0x1B: (64, False),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class EdsEntry:
    """One variable; ``default`` (of a DCF its configured value), ``low`` and ``high`` are texts as written."""

    index: int
    sub: int
    name: str
    data_type: int
    access: str
    mappable: bool
    default: str = ""
    low: str = ""
    high: str = ""


@dataclass(frozen=True, slots=True)
class EdsObject:
    """One index; ``object_type`` as in CiA 301: 2 DOMAIN, 7 VAR, 8 ARRAY, 9 RECORD."""

    index: int
    name: str
    object_type: int
    entries: tuple[EdsEntry, ...]


@dataclass(frozen=True, slots=True)
class EdsFile:
    """The whole file; numbers are None where they are missing. ``node_id``: of a DCF, that of its COB-IDs (CiA 306)."""

    name: str
    vendor_name: str
    product_name: str
    vendor_number: int | None
    product_number: int | None
    revision_number: int | None
    node_id: int | None
    objects: tuple[EdsObject, ...]
