"""Reads a vendor's EDS or DCF file (CiA 306) into the objects of a device, as such files are found in the field.

It shares nothing with the reader that the daemon uses, so that a mistake of one does not hide in the other. What a file
leaves out or writes wrongly is mended the way the device must have meant it; what has no meaning is left out.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from fdhil.errors import EdsError
from fdhil.sim.drive.dictionary import ARRAY, DOMAIN_OBJECT, RECORD, SIGNED, U8, VAR, DataType, Entry, Object, Value

MAX_BYTES = 2 * 1024 * 1024
_HEADER = re.compile(r"\[\s*([^\]]*?)\s*\]")
_OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?$")
_COMMENT = re.compile(r"(^|\s)[;#].*$")
_NODE = re.compile(r"\$node_?id", re.IGNORECASE)
_TEXTS = frozenset({"parametername", "vendorname", "productname"})
_ACCESSES = frozenset({"ro", "wo", "rw", "rww", "rwr", "const"})
_INDICES = re.compile(r"1[0-9a-f]{3}|[2-9a-f][0-9a-f]{3}")
_DEEPEST_SUB = 254
_LEADING_ZERO = re.compile(r"(?:^|[-+\s])(0[0-7]+)[uUlL]*(?![\w.])")
_PDO_SET_UP = re.compile(r"1[4-9ab][0-9a-f]{2}(sub|value)?")
_VALUE_KEYS = ("defaultvalue", "parametervalue")
_SURE_KEYS = frozenset(("datatype", "objecttype", "compactsubobj", "nrofentries", "vendornumber", "productnumber"))
_IDENTITY = ("vendor", "product", "revision")

Keys = Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Sheet:
    """What the file says of the device; ``objects`` have their defaults for the node-ID that was asked for.

    ``given`` has the keys of the entries whose default the file states.
    """

    file: str
    name: str
    vendor: int
    product: int
    revision: int
    objects: tuple[Object, ...]
    given: frozenset[int]


def read_sheet(path: Path, node_id: int) -> Sheet:
    """Read the file; EdsError when it cannot be read or has no object."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise EdsError(path.name, f"it cannot be read ({error.strerror}); check sim.axis.*.eds") from None
    if len(raw) > MAX_BYTES:
        raise EdsError(path.name, f"it is larger than {MAX_BYTES >> 20} MiB; this is no EDS file")
    sections = _sections(raw)
    _require_one_reading(sections, path.name)
    device = sections.get("deviceinfo", {})
    given: set[int] = set()
    objects = tuple(_objects(sections, node_id, given))
    if not objects:
        raise EdsError(path.name, "it has no object at all; this is no EDS file")
    vendor, product, revision = (_integer(device.get(f"{key}number", "")) or 0 for key in _IDENTITY)
    name = device.get("productname") or path.stem
    return Sheet(path.name, name, vendor, product, revision, objects, frozenset(given))


def _sections(raw: bytes) -> dict[str, dict[str, str]]:
    """Split the text into sections of keys, all in small letters; one that comes twice is one."""
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:  # written on Windows
        text = raw.decode("cp1252", "replace")
    sections: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in text.replace("\0", "").splitlines():
        line = line.strip()
        if header := _HEADER.match(line):
            current = sections.setdefault(header[1].lower(), {})
        elif "=" in line and line[0] not in ";#":
            key, _, value = line.partition("=")
            key = key.strip().lower()
            current[key] = value.strip() if key in _TEXTS else _COMMENT.sub("", value).strip()
    return sections


def _require_one_reading(sections: Mapping[str, Keys], file: str) -> None:
    """EdsError where a number that sets up PDOs, sizes or the identity is another in octal than in decimal."""
    for title, keys in sections.items():
        for key, text in keys.items():
            of_pdo = _PDO_SET_UP.match(title) and (key in _VALUE_KEYS or key.isdecimal())
            number = _LEADING_ZERO.search(text) if key in _SURE_KEYS or of_pdo else None
            if number and (octal := int(number[1], 8)) != int(number[1]):
                what = f"{key} of [{title}] is {text!r}: as octal {octal:#x}, as decimal {int(number[1]):#x}"
                raise EdsError(file, f"{what}; write it without the leading zero, or with 0x")


def _objects(sections: Mapping[str, Keys], node_id: int, given: set[int]) -> Iterator[Object]:
    subs: dict[int, dict[int, Keys]] = {}
    for title, keys in sections.items():
        match = _OBJECT.match(title)
        if match and match[2] is not None:
            subs.setdefault(int(match[1], 16), {})[int(match[2], 16)] = keys
    indices = {int(title, 16) for title in sections if _INDICES.fullmatch(title)}
    for index in sorted(indices | {index for index in subs if index >= 0x1000}):
        keys = sections.get(f"{index:04x}", {})
        name, kind = keys.get("parametername", f"{index:04X}"), _integer(keys.get("objecttype", "")) or VAR
        parts = dict(_compact(keys, sections.get(f"{index:04x}name", {}), sections.get(f"{index:04x}value", {})))
        parts.update(subs.get(index, {}))
        if parts:
            entries = tuple(_entry(index, sub, part, node_id, given) for sub, part in sorted(parts.items()))
            if entries[0].sub:  # a record must say how many it has
                entries = (Entry(index, 0, "Highest sub-index supported", U8, "const", entries[-1].sub), *entries)
            yield Object(index, name, kind if kind in (ARRAY, RECORD) else RECORD, entries)
        elif kind in (VAR, DOMAIN_OBJECT) or "datatype" in keys:
            entry = _entry(index, 0, keys, node_id, given)
            yield Object(index, name, DOMAIN_OBJECT if entry.type is DataType.DOMAIN else VAR, (entry,))


def _compact(keys: Keys, names: Keys, values: Keys) -> Iterator[tuple[int, Keys]]:
    """The sub-objects of an object that says them all at once (CompactSubObj)."""
    count = min(_integer(keys.get("compactsubobj", "")) or 0, _DEEPEST_SUB)
    if not count:
        return
    yield 0, {"parametername": "Highest sub-index supported", "datatype": "5", "defaultvalue": str(count)}
    for sub in range(1, count + 1):
        name = names.get(str(sub), f"{keys.get('parametername', '')} {sub}")
        yield sub, {**keys, "parametername": name, "defaultvalue": values.get(str(sub), keys.get("defaultvalue", ""))}


def _entry(index: int, sub: int, keys: Keys, node_id: int, given: set[int]) -> Entry:
    try:
        kind = DataType(_integer(keys.get("datatype", "")) or 0)
    except ValueError:  # a type of the vendor's own
        kind = DataType.DOMAIN if _integer(keys.get("objecttype", "")) == DOMAIN_OBJECT else U8
    access = keys.get("accesstype", "ro").lower()
    text = keys.get("parametervalue") or keys.get("defaultvalue", "")
    entry = Entry(
        index,
        sub,
        keys.get("parametername", f"{index:04X}:{sub:02X}"),
        kind,
        access if access in _ACCESSES else "ro",
        mappable=bool(_integer(keys.get("pdomapping", ""))),
        node_relative=bool(_NODE.search(text)),
    )
    default = _default(entry, text, node_id)
    if default is None:
        return replace(entry, default=b"" if entry.size is None else 0)
    given.add(entry.key)
    low, high = (_number(entry, keys.get(key, ""), node_id) for key in ("lowlimit", "highlimit"))
    if isinstance(default, int) and low is not None and high is not None and low <= default <= high and low < high:
        return replace(entry, default=default, low=low, high=high)
    return replace(entry, default=default)  # limits that forbid the default are none


def _default(entry: Entry, text: str, node_id: int) -> Value | None:
    """The value at power-on, None where the file does not say it."""
    if entry.size is None:
        return text.encode("latin-1", "replace") if text else None
    return _number(entry, text, node_id)


def _number(entry: Entry, text: str, node_id: int) -> int | None:
    """A number as the entry's type holds it, the bits for a REAL; None when there is none."""
    if not text:
        return None
    if entry.type in (DataType.REAL32, DataType.REAL64):
        return _real_bits(entry.type, text)
    relative = bool(_NODE.search(text))
    value = _integer(_NODE.sub("", text).strip(" +")) if relative else _integer(text)
    if value is None:
        if not relative or _NODE.sub("", text).strip(" +"):
            return None
        value = 0
    bits = 8 * (entry.size or 8)
    value = (value + node_id * relative) & (1 << bits) - 1
    return value - (1 << bits) if entry.type in SIGNED and value >> (bits - 1) else value


def _real_bits(kind: DataType, text: str) -> int | None:
    if re.fullmatch(r"0[xX][0-9a-fA-F]+", text):
        return int(text, 16)
    try:
        value = float(text)
        return int.from_bytes(struct.pack("<f" if kind is DataType.REAL32 else "<d", value), "little")
    except (ValueError, OverflowError):
        return None


def _integer(text: str) -> int | None:
    """Read a number as it is found: decimal, 0x, 0 and octal digits as decimal; None for anything else."""
    match = re.fullmatch(r"([+-]?)(0[xX][0-9a-fA-F]{1,16}|[0-9]{1,20})[uUlL]*", text.strip())
    if match is None:
        return None
    value = int(match[2], 16) if match[2][:2] in ("0x", "0X") else int(match[2])
    return -value if match[1] == "-" else value
