"""Holds the object dictionary of a CANopen device: typed entries, access rules, values (CiA 301, 7.4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

from fdhil.errors import FdhilError


class AbortCode(IntEnum):
    """SDO abort codes that the drive answers (CiA 301, table 22)."""

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
    """An access to the object dictionary is refused; ``code`` is what the SDO server answers."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"the access is refused with SDO abort {code:08X}")


class DataType(IntEnum):
    """CiA 301 data types that the drive uses."""

    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    VISIBLE_STRING = 0x09
    DOMAIN = 0x0F


I8, I16, I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32
U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32

_BYTES = {I8: 1, I16: 2, I32: 4, U8: 1, U16: 2, U32: 4}
SIGNED = frozenset({I8, I16, I32})

Value = int | bytes


@dataclass(frozen=True, slots=True)
class Entry:
    """One sub-index. ``access`` is ro, wo, rw, rww or const; ``node_relative``: $NODEID in the EDS."""

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

    @property
    def key(self) -> int:
        """``index << 8 | sub``."""
        return self.index << 8 | self.sub

    @property
    def size(self) -> int | None:
        """Bytes of a number, None for strings and domains."""
        return _BYTES.get(self.type)

    @property
    def signed(self) -> bool:
        """Whether it is an INTEGER type."""
        return self.type in SIGNED

    def encode(self, value: Value) -> bytes:
        """Return the little-endian bytes of ``value``."""
        if isinstance(value, bytes):
            return value
        size = self.size
        assert size is not None
        return value.to_bytes(size, "little", signed=self.signed)

    def decode(self, data: bytes) -> Value:
        """Return the value of ``data``; TransferAbort when its length is not the type's."""
        if self.size is None:
            return data
        if len(data) != self.size:
            raise TransferAbort(AbortCode.LENGTH)
        return int.from_bytes(data, "little", signed=self.signed)

    def check_range(self, value: Value) -> None:
        """TransferAbort when a number is outside the entry's limits."""
        if isinstance(value, int) and (
            (self.low is not None and value < self.low) or (self.high is not None and value > self.high)
        ):
            raise TransferAbort(AbortCode.RANGE)


@dataclass(frozen=True, slots=True)
class Object:
    """An index: a VAR (object type 7), DOMAIN (2), ARRAY (8) or RECORD (9) with its entries."""

    index: int
    name: str
    kind: int
    entries: tuple[Entry, ...]


VAR, DOMAIN_OBJECT, ARRAY, RECORD = 7, 2, 8, 9


def var(index: int, name: str, type: DataType, access: str, default: Value = 0, **more: Any) -> Object:
    """Return an object with one entry; ``more`` are further attributes of the entry."""
    kind = DOMAIN_OBJECT if type is DataType.DOMAIN else VAR
    return Object(index, name, kind, (Entry(index, 0, name, type, access, default, **more),))


def record(index: int, name: str, *entries: Entry, kind: int = RECORD, count: Entry | None = None) -> Object:
    """Return an object with sub-indices; its sub-index 0 is ``count`` or a constant, the highest sub-index."""
    if count is None:
        count = Entry(index, 0, "Highest sub-index supported", U8, "const", max(entry.sub for entry in entries))
    return Object(index, name, kind, (count, *entries))


class Dictionary:
    """Entries and their values, keyed ``index << 8 | sub``: ``numbers`` and ``texts`` (strings and domains).

    ``check`` and ``written`` are called before and after an SDO write of the keys they are registered for; ``check``
    refuses by raising TransferAbort. ``read_hooks`` give what is computed when it is asked for.
    """

    def __init__(self, objects: tuple[Object, ...]) -> None:
        self.objects = objects
        self.entries = {entry.key: entry for item in objects for entry in item.entries}
        self.indices = {item.index for item in objects}
        self.numbers: dict[int, int] = {}
        self.texts: dict[int, bytes] = {}
        self.check: dict[int, Callable[[Entry, int], None]] = {}
        self.written: dict[int, Callable[[int], None]] = {}
        self.read_hooks: dict[int, Callable[[], Value]] = {}
        self.reset(lambda _: True)

    def reset(self, which: Callable[[Entry], bool]) -> None:
        """Give the chosen entries their default values."""
        for key, entry in self.entries.items():
            if which(entry):
                self._store(key, entry.default)

    def renumber(self, by: int) -> None:
        """The node-ID has changed: shift the defaults that are relative to it."""
        for key, entry in self.entries.items():
            if entry.node_relative and isinstance(entry.default, int):
                self.entries[key] = replace(entry, default=entry.default + by)

    def _store(self, key: int, value: Value) -> None:
        if isinstance(value, int):
            self.numbers[key] = value
        else:
            self.texts[key] = value

    def entry(self, index: int, sub: int) -> Entry:
        """Return an entry; TransferAbort when there is no such object or sub-index."""
        found = self.entries.get(index << 8 | sub)
        if found is None:
            raise TransferAbort(AbortCode.NO_SUB_INDEX if index in self.indices else AbortCode.NO_OBJECT)
        return found

    def number(self, index: int, sub: int = 0) -> int:
        """Return the value of a number."""
        return self.numbers[index << 8 | sub]

    def read(self, index: int, sub: int) -> bytes:
        """Return what an SDO upload gives; TransferAbort when it is refused."""
        entry = self.entry(index, sub)
        if entry.access == "wo":
            raise TransferAbort(AbortCode.READ_WRITE_ONLY)
        hook = self.read_hooks.get(entry.key)
        if hook is not None:
            return entry.encode(hook())
        return entry.encode(self.texts[entry.key] if entry.size is None else self.numbers[entry.key])

    def writable(self, index: int, sub: int) -> Entry:
        """Return an entry that an SDO download may write; TransferAbort when it may not."""
        entry = self.entry(index, sub)
        if entry.access in ("ro", "const"):
            raise TransferAbort(AbortCode.WRITE_READ_ONLY)
        return entry

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Do an SDO download; TransferAbort when it is refused."""
        entry = self.writable(index, sub)
        value = entry.decode(data)
        entry.check_range(value)
        check = self.check.get(entry.key)
        if check is not None and isinstance(value, int):
            check(entry, value)
        self._store(entry.key, value)
        written = self.written.get(entry.key)
        if written is not None and isinstance(value, int):
            written(value)

    def __iter__(self) -> Iterator[Object]:
        return iter(self.objects)
