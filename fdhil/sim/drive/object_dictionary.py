"""Implements the object dictionary of a CANopen device: typed entries, access rules, values (CiA 301, 7.4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

from fdhil.errors import FdhilError


class AbortCode(IntEnum):
    """SDO abort codes that the drive returns (CiA 301, table 22)."""

    TOGGLE = 0x05030000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    READ_WRITE_ONLY = 0x06010001
    WRITE_READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    LENGTH = 0x06070010
    NO_SUB_INDEX = 0x06090011
    RANGE = 0x06090030
    NOT_STORED = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class TransferAbort(FdhilError):
    """An access to the object dictionary is refused; ``code`` is the abort code of the SDO server."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"the access is refused with SDO abort {code:08X}")


class DataType(IntEnum):
    """CiA 301 data types (table 44)."""

    BOOLEAN = 0x01
    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    REAL32 = 0x08
    VISIBLE_STRING = 0x09
    OCTET_STRING = 0x0A
    UNICODE_STRING = 0x0B
    TIME_OF_DAY = 0x0C
    TIME_DIFFERENCE = 0x0D
    DOMAIN = 0x0F
    INTEGER24 = 0x10
    REAL64 = 0x11
    INTEGER40 = 0x12
    INTEGER48 = 0x13
    INTEGER56 = 0x14
    INTEGER64 = 0x15
    UNSIGNED24 = 0x16
    UNSIGNED40 = 0x18
    UNSIGNED48 = 0x19
    UNSIGNED56 = 0x1A
    UNSIGNED64 = 0x1B


I8, I16, I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32
U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32

# a REAL is stored as its bits on the wire
_BYTES = {
    DataType.BOOLEAN: 1, U8: 1, U16: 2, DataType.UNSIGNED24: 3, U32: 4, DataType.UNSIGNED40: 5, DataType.UNSIGNED48: 6,
    DataType.UNSIGNED56: 7, DataType.UNSIGNED64: 8, DataType.REAL32: 4, DataType.REAL64: 8,
    I8: 1, I16: 2, DataType.INTEGER24: 3, I32: 4, DataType.INTEGER40: 5, DataType.INTEGER48: 6, DataType.INTEGER56: 7,
    DataType.INTEGER64: 8,
}  # fmt: skip
SIGNED = frozenset(kind for kind in DataType if kind.name.startswith("INTEGER"))

Value = int | bytes


@dataclass(frozen=True, slots=True)
class Entry:
    """One sub-index. ``access`` is ro, wo, rw, rww, rwr or const; ``node_relative``: $NODEID in the EDS.

    Its value is stored under ``home`` (default: its own key) in the drive's own units: ``scale`` of them make one count
    on the wire, and the number ``renamed[1]`` appears as ``renamed[0]``. ``choice`` are the accepted counts.
    """

    index: int
    sub: int
    name: str
    type: DataType
    access: str
    default: Value = 0
    mappable: bool = False
    low: int | None = None
    high: int | None = None
    node_relative: bool = False
    home: int | None = None
    scale: float = 1.0
    renamed: tuple[int, int] | None = None
    choice: frozenset[int] | None = None

    @property
    def key(self) -> int:
        """``index << 8 | sub``."""
        return self.index << 8 | self.sub

    @property
    def storage_key(self) -> int:
        return self.key if self.home is None else self.home

    @property
    def size(self) -> int | None:
        """Size of a number in bytes, None for strings and domains."""
        return _BYTES.get(self.type)

    @property
    def is_signed(self) -> bool:
        return self.type in SIGNED

    def shift_node_id(self, by: int) -> Entry:
        """Return it with a node-ID that is higher by ``by``."""
        if not self.node_relative or not isinstance(self.default, int):
            return self
        return replace(self, default=self.default + by)

    @property
    def is_limited(self) -> bool:
        return (self.low, self.high, self.choice) != (None, None, None)

    def encode_value(self, value: Value) -> bytes:
        """Return the little-endian bytes of ``value``."""
        if isinstance(value, bytes):
            return value
        size = self.size
        assert size is not None
        return value.to_bytes(size, "little", signed=self.is_signed)

    def convert_to_counts(self, number: int) -> int:
        """Convert a stored number to counts on the wire, limited to the range of the type."""
        if self.renamed is not None and number == self.renamed[1]:
            return self.renamed[0]
        counts = number if self.scale == 1.0 else round(number / self.scale)
        bits = 8 * (self.size or 8)
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if self.is_signed else (0, (1 << bits) - 1)
        return min(max(counts, low), high)

    def convert_from_counts(self, counts: int) -> int:
        """Convert counts on the wire to the stored number."""
        if self.renamed is not None and counts == self.renamed[0]:
            return self.renamed[1]
        return counts if self.scale == 1.0 else round(counts * self.scale)

    def decode_value(self, data: bytes) -> Value:
        """Return the value of ``data``; TransferAbort when its length is not the type's."""
        if self.size is None:
            return data
        if len(data) != self.size:
            raise TransferAbort(AbortCode.LENGTH)
        return int.from_bytes(data, "little", signed=self.is_signed)

    def check_range(self, value: Value) -> None:
        """Raise TransferAbort for a number outside the entry's limits or choices."""
        if self.choice is not None and value not in self.choice:
            raise TransferAbort(AbortCode.RANGE)
        if isinstance(value, int) and (
            (self.low is not None and value < self.low) or (self.high is not None and value > self.high)
        ):
            raise TransferAbort(AbortCode.RANGE)


@dataclass(frozen=True, slots=True)
class DictionaryObject:
    """An index: a VAR (object type 7), DOMAIN (2), ARRAY (8) or RECORD (9) with its entries."""

    index: int
    name: str
    kind: int
    entries: tuple[Entry, ...]


VAR, DOMAIN_OBJECT, ARRAY, RECORD = 7, 2, 8, 9


def create_var(index: int, name: str, type: DataType, access: str, default: Value = 0, **more: Any) -> DictionaryObject:
    """Return an object with one entry; ``more`` are further attributes of the entry."""
    kind = DOMAIN_OBJECT if type is DataType.DOMAIN else VAR
    return DictionaryObject(index, name, kind, (Entry(index, 0, name, type, access, default, **more),))


def create_record(
    index: int, name: str, *entries: Entry, kind: int = RECORD, count: Entry | None = None
) -> DictionaryObject:
    """Return an object with sub-indices; its sub-index 0 is ``count``, by default a constant, the highest sub-index."""
    if count is None:
        count = Entry(index, 0, "Highest sub-index supported", U8, "const", max(entry.sub for entry in entries))
    return DictionaryObject(index, name, kind, (count, *entries))


class ObjectDictionary:
    """The entries visible on the wire, keyed ``index << 8 | sub``, and their values.

    ``numbers`` and ``texts`` (strings and domains) are stored under each entry's key, also for ``within``: entries that
    the drive uses and does not expose. ``check`` and ``written`` are called before and after an SDO write to the keys
    they are registered for; ``check`` refuses by raising TransferAbort. ``read_hooks`` compute values on request.
    ``restored`` are called when the values of a boot are in place.
    """

    def __init__(self, objects: tuple[DictionaryObject, ...], within: tuple[Entry, ...] = ()) -> None:
        self.objects = objects
        self.entries = {entry.key: entry for item in objects for entry in item.entries}
        self.indices = {item.index for item in objects}
        self.numbers: dict[int, int] = {}
        self.texts: dict[int, bytes] = {}
        self.write_checks: dict[int, Callable[[Entry, int], None]] = {}
        self.write_hooks: dict[int, Callable[[int], None]] = {}
        self.read_hooks: dict[int, Callable[[], Value]] = {}
        self.restore_hooks: list[Callable[[], None]] = []
        self._hidden_entries = within
        self.has_foreign_units = bool(within)  # wire units may differ from stored units
        self.reset_entries(lambda _: True)

    def reset_entries(self, which: Callable[[Entry], bool]) -> None:
        for entry in (*self._hidden_entries, *self.entries.values()):
            if which(entry):
                self._store_value(entry, entry.default)

    def shift_node_id(self, by: int) -> None:
        """Shift the defaults that are relative to the node-ID by ``by``."""
        self.objects = tuple(replace(o, entries=tuple(e.shift_node_id(by) for e in o.entries)) for o in self.objects)
        self.entries = {entry.key: entry for item in self.objects for entry in item.entries}
        self._hidden_entries = tuple(entry.shift_node_id(by) for entry in self._hidden_entries)

    def _store_value(self, entry: Entry, value: Value) -> None:
        if isinstance(value, int):
            self.numbers[entry.storage_key] = entry.convert_from_counts(value)
        else:
            self.texts[entry.storage_key] = value

    def get_entry(self, index: int, sub: int) -> Entry:
        """Return an entry; TransferAbort for an unknown object or sub-index."""
        found = self.entries.get(index << 8 | sub)
        if found is None:
            raise TransferAbort(AbortCode.NO_SUB_INDEX if index in self.indices else AbortCode.NO_OBJECT)
        return found

    def get_number(self, index: int, sub: int = 0) -> int:
        return self.numbers[index << 8 | sub]

    def get_wire_value(self, entry: Entry) -> int:
        return entry.convert_to_counts(self.numbers[entry.storage_key])

    def read_entry(self, index: int, sub: int) -> bytes:
        """Return the data of an SDO upload; TransferAbort when it is refused."""
        entry = self.get_entry(index, sub)
        if entry.access == "wo":
            raise TransferAbort(AbortCode.READ_WRITE_ONLY)
        hook = self.read_hooks.get(entry.storage_key)
        if hook is not None:
            return entry.encode_value(hook())
        return entry.encode_value(self.texts[entry.storage_key] if entry.size is None else self.get_wire_value(entry))

    def require_writable(self, index: int, sub: int) -> Entry:
        """Return an entry that an SDO download may write; TransferAbort otherwise."""
        entry = self.get_entry(index, sub)
        if entry.access in ("ro", "const"):
            raise TransferAbort(AbortCode.WRITE_READ_ONLY)
        return entry

    def write_entry(self, index: int, sub: int, data: bytes) -> None:
        """Execute an SDO download; TransferAbort when it is refused."""
        entry = self.require_writable(index, sub)
        value = entry.decode_value(data)
        entry.check_range(value)
        check = self.write_checks.get(entry.storage_key)
        if check is not None and isinstance(value, int):
            check(entry, entry.convert_from_counts(value))
        self._store_value(entry, value)
        written = self.write_hooks.get(entry.storage_key)
        if written is not None and isinstance(value, int):
            written(value)

    def __iter__(self) -> Iterator[DictionaryObject]:
        return iter(self.objects)
