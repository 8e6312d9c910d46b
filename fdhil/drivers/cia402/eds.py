"""Reads EDS and DCF files (CiA 306) as they are found in the field, mended for the canopen library.

Of 363 real files the library refuses 45: Windows text, sections or keys twice, blank numbers, leading zeros, comments
behind values, incomplete [DummyUsage], [Comments] that count wrong. This module reads the file line by line, mends what
can be mended, and hands the library a clean text; what is left is one :class:`EdsError` with the line.
"""

import configparser
import io
import re
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary, import_od

from fdhil.drivers.cia402.eds_compact_storage import is_list, written_out
from fdhil.drivers.cia402.eds_numbers import octal_reading, read_expression, read_number
from fdhil.errors import EdsError

MAX_BYTES = 2 * 1024 * 1024
MAX_OBJECTS = 6_000  # the library reads this many in a second; real drives have some hundreds
MAX_SECTIONS, MAX_KEYS = 8_000, 50_000  # with these it is as quick
MAX_LINE = 4096
MAX_SUB_INDEX = 254

_NODE_IDS = range(1, 128)
_NO_NODE_ID = (0, 255)  # as files of no node have it
_LIBRARY_ERRORS = (ValueError, TypeError, AttributeError, LookupError, configparser.Error)
_SECTION = re.compile(r"\[([^\]]*)\]")
_OBJECT = re.compile(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?$", re.IGNORECASE)
_COMMISSIONING = re.compile(r"device[ _]?com+is+ion+ing$", re.IGNORECASE)
_NODE_KEY = re.compile(r"node[ _-]?id$", re.IGNORECASE)
_KEY = re.compile(r"[A-Za-z0-9_ ]+$")
_VALUE_KEYS = ("DefaultValue", "ParameterValue")
_PDO_SET_UP = range(0x1400, 0x1C00)
# data types of CiA 301, 7.4.7.1: bits and whether signed; what is no integer cannot be decoded from a PDO
INTEGERS: Mapping[int, tuple[int, bool]] = {
    0x01: (1, False), 0x02: (8, True), 0x03: (16, True), 0x04: (32, True), 0x05: (8, False), 0x06: (16, False),
    0x07: (32, False), 0x10: (24, True), 0x12: (40, True), 0x13: (48, True), 0x14: (56, True), 0x15: (64, True),
    0x16: (24, False), 0x18: (40, False), 0x19: (48, False), 0x1A: (56, False), 0x1B: (64, False),
}  # fmt: skip
_TEXT_KEYS = frozenset({"ParameterName", "VendorName", "ProductName", "OrderCode", "Description", "FileName"})
_NUMBER_KEYS = frozenset(
    {
        "VendorNumber", "ProductNumber", "RevisionNumber", "SimpleBootUpMaster", "SimpleBootUpSlave", "Granularity",
        "DynamicChannelsSupported", "GroupMessaging", "NrOfRXPDO", "NrOfTXPDO", "LSS_Supported", "ObjectType",
        "PDOMapping", "SubNumber", "NrOfEntries", "CompactSubObj", "DataType", "CompactPDO",
        *(f"BaudRate_{rate}" for rate in (10, 20, 50, 125, 250, 500, 800, 1000)),
        *(f"Dummy{number:04d}" for number in range(1, 8)),
    }
)  # fmt: skip
# of these a note does not do: they decide what objects there are, of what size, and whose drive it is
_SURE_KEYS = _NUMBER_KEYS & {
    "DataType", "ObjectType", "CompactSubObj", "NrOfEntries", "NrOfRXPDO", "NrOfTXPDO", "CompactPDO", "Granularity",
    "VendorNumber", "ProductNumber",
}  # fmt: skip
_KNOWN = {key.lower(): key for key in (*_TEXT_KEYS, *_NUMBER_KEYS, "AccessType", "DefaultValue", "LowLimit")} | {
    key.lower(): key for key in ("HighLimit", "ParameterValue", "StorageLocation", "NodeID", "Baudrate", "Denotation")
}


@dataclass(slots=True)
class _Section:
    name: str
    line: int
    values: dict[str, str] = field(default_factory=dict)

    def text(self) -> str:
        """The section as the library reads it."""
        return "\n".join([f"[{self.name}]", *(f"{key}={value}" for key, value in self.values.items()), ""])


def load_eds(path: Path, node_id: int | None = None) -> ObjectDictionary:
    """Read an EDS or DCF file; EdsError when it cannot be read or is no EDS.

    ``node_id`` resolves $NODEID, left out: the node-ID that a DCF has itself. The dictionary has the one that was used.
    """
    if path.exists() and not path.is_file() and not path.is_dir():  # a pipe would be waited for without end
        raise EdsError(str(path), "it is no plain file; check the path")
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise EdsError(str(path), f"it cannot be read ({error.strerror}); check the path") from None
    return parse_eds(raw, str(path), node_id)


def parse_eds(raw: bytes, name: str, node_id: int | None = None) -> ObjectDictionary:
    """Parse the bytes of an EDS or DCF file; EdsError with the line at fault."""
    ordered = _sections(raw, name)
    try:
        return _read(ordered, node_id)
    except _LIBRARY_ERRORS as error:
        at_fault = ordered[_first_unreadable(ordered, node_id)]
        what = str(error).strip("'\"").splitlines()[0][:80] if str(error) else type(error).__name__
        text = f"line {at_fault.line}: [{at_fault.name}] is wrong ({what}); correct it or leave it out"
        raise EdsError(name, text) from None


def _read(sections: Sequence[_Section], node_id: int | None) -> ObjectDictionary:
    source = io.StringIO("".join(section.text() for section in sections))
    source.name = "clean.eds"
    return import_od(source, node_id)


def _first_unreadable(sections: Sequence[_Section], node_id: int | None) -> int:
    def fails(count: int) -> bool:
        try:
            _read(sections[:count], node_id)
        except _LIBRARY_ERRORS:
            return True
        return False

    return bisect_left(range(len(sections)), True, key=lambda last: fails(last + 1))


def _sections(raw: bytes, name: str) -> list[_Section]:
    if len(raw) > MAX_BYTES:
        raise EdsError(name, f"it is larger than {MAX_BYTES >> 20} MiB; this is no EDS file")
    sections: dict[str, _Section] = {}
    current: _Section | None = None
    objects = keys = 0
    for number, line in _lines(raw, name):
        header = _SECTION.match(line)
        if header:
            title = _title(header[1].strip())
            if title not in sections:
                sections[title] = _Section(title, number)
                objects += bool(_OBJECT.match(title))
            current = sections[title]
        elif current is not None and "=" in line:
            keys += 1
            key, _, value = line.partition("=")
            _store(current, key.strip(), value, number, name)
        if objects > MAX_OBJECTS or len(sections) > MAX_SECTIONS or keys > MAX_KEYS:
            most = f"{MAX_OBJECTS} objects, {MAX_SECTIONS} sections or {MAX_KEYS} keys"
            raise EdsError(name, f"line {number}: it has more than {most}; this is no drive's EDS")
    if raw.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<"):
        raise EdsError(name, "line 1: it is XML (an XDD, or an ESI of EtherCAT); ask the drive's maker for its EDS")
    if not any(_OBJECT.match(title) for title in sections):
        raise EdsError(name, "line 1: it has no object at all; this is no EDS file")
    compact = written_out({title: section.values for title, section in sections.items()}, MAX_SECTIONS)
    if len(sections) + len(compact) > MAX_SECTIONS:
        raise EdsError(name, f"it has more than {MAX_SECTIONS} objects in compact form; this is no drive's EDS")
    for title, values in compact.items():
        sections[title] = _Section(title, _line_of(title, sections), {**values})
    return _complete(sections, name)


def _title(found: str) -> str:
    if match := _OBJECT.match(found):
        return match[1].upper() + (f"sub{int(match[2], 16):X}" if match[2] else "")
    return "DeviceComissioning" if _COMMISSIONING.match(found) else found


def _line_of(title: str, sections: Mapping[str, _Section]) -> int:
    found = sections.get(title) or sections.get(title[:4]) or sections.get("DeviceInfo")
    return found.line if found else 1


def _lines(raw: bytes, name: str) -> Iterator[tuple[int, str]]:
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
    for number, line in enumerate(text.replace("\0", "").splitlines(), 1):
        if len(line) > MAX_LINE:
            raise EdsError(name, f"line {number} is longer than {MAX_LINE} characters; this is no EDS file")
        stripped = line.strip()
        if stripped and stripped[0] not in ";#":
            yield number, stripped


def _store(section: _Section, key: str, value: str, line: int, name: str) -> None:
    key = "NodeID" if _NODE_KEY.match(key) else _KNOWN.get(key.lower(), key)
    if not _KEY.match(key):
        return
    marks = r"\s;.*$" if key in _TEXT_KEYS else r"(^|\s)[;#].*$"
    value = re.sub(marks, "", " " + value).strip()
    if key in _NUMBER_KEYS:
        number = read_number(value) if value else 0
        if number is None:
            raise EdsError(name, f"line {line}: {key} is {value[:40]!r} where a number belongs; correct it")
        if key in _SURE_KEYS:
            _require_one_reading(f"line {line}: {key} of [{section.name}]", value, name)
        if key in ("CompactSubObj", "NrOfEntries") and number > MAX_SUB_INDEX:
            raise EdsError(name, f"line {line}: {key} is {number}, more than an object can have; correct it")
        value = str(number)
    before = section.values.get(key, "")
    if key == "NodeID" and value and before and read_number(value) != read_number(before):
        what = f"line {line}: NodeID is {value[:40]!r}, and {before[:40]!r} in a line above"
        raise EdsError(name, f"{what}: its COB-IDs are of one of these nodes; leave the other out")
    section.values[key] = value


def _complete(sections: dict[str, _Section], name: str) -> list[_Section]:
    for title in [t for t in sections if t.lower() in ("comments", "") or is_list(t)]:
        del sections[title]
    sections.setdefault("DeviceInfo", _Section("DeviceInfo", 1))
    parents = {match[1] for title in sections if (match := _OBJECT.match(title)) and match[2]}
    for section in sections.values():
        if section.name.lower() == "dummyusage":
            for number in range(1, 8):
                section.values.setdefault(f"Dummy{number:04d}", "0")
        elif section.name == "DeviceComissioning":
            section.values = _commissioning(section, name)
        elif _OBJECT.match(section.name):
            section.values.pop("CompactSubObj", None)
            section.values.setdefault("ParameterName", section.name)
            section.values.setdefault("AccessType", "ro")
            if section.values.get("ObjectType") == "0":
                del section.values["ObjectType"]
            if section.name in parents and section.values.get("ObjectType") != "8":
                section.values["ObjectType"] = "9"
            if read_number(section.values.get("DataType", "")) in INTEGERS:
                _complete_values(section, name)
    return sorted(sections.values(), key=lambda s: (bool(_OBJECT.match(s.name)) and len(s.name) > 4, s.line))


def _commissioning(section: _Section, name: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for key, text in section.values.items():
        number = read_number(text)
        if key == "NodeID" and text:
            _require_one_reading(f"line {section.line}: NodeID of [{section.name}]", text, name)
            if number in _NO_NODE_ID:
                continue
            if number is None or number not in _NODE_IDS:
                what = f"line {section.line}: NodeID is {text[:40]!r}, not from 1 to 127"
                raise EdsError(name, f"{what}: its COB-IDs are of no known node; correct it or leave it out")
            found["NodeID"] = str(number)
        elif key == "Baudrate" and number is not None:
            found["Baudrate"] = str(number)
    return found


def _complete_values(section: _Section, name: str) -> None:
    of_pdo = int(section.name[:4], 16) in _PDO_SET_UP
    for key in _VALUE_KEYS:
        text = section.values.get(key, "")
        found = read_expression(text)
        if of_pdo and text:
            _require_one_reading(f"line {section.line}: {key} of [{section.name}]", text, name)
            if found is None:
                what = f"line {section.line}: {key} of [{section.name}] is {text[:40]!r} where a number belongs"
                raise EdsError(name, f"{what}; correct it or leave it out")
        if (found is None and text) or octal_reading(text) is not None:
            continue
        if found is None:
            section.values.pop(key, None)
        else:
            section.values[key] = f"$NODEID+{found[0]}" if found[1] else str(found[0])


def _require_one_reading(where: str, text: str, name: str) -> None:
    if (octal := octal_reading(text)) is not None:
        readings = f"as octal {octal:#x}, as decimal {read_expression(text)[0]:#x}"  # type: ignore[index] # it is one
        raise EdsError(name, f"{where} is {text[:40]!r}: {readings}; write it without the leading zero, or with 0x")
