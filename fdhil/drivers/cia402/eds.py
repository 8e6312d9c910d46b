"""Reads EDS and DCF files (CiA 306) as they are found in the field, mended for the canopen library.

Of 363 real files the library refuses 45: Windows text, sections or keys twice, blank numbers, leading zeros, comments
behind values, incomplete [DummyUsage], [Comments] that count wrong. This module reads the file line by line, mends what
can be mended, and hands the library a clean text; what is left is one :class:`EdsError` with the line.
"""

from __future__ import annotations

import configparser
import io
import re
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary, import_od

from fdhil.errors import EdsError

MAX_BYTES = 2 * 1024 * 1024
MAX_OBJECTS = 6_000  # the library reads this many in a second; real drives have some hundreds
MAX_SECTIONS, MAX_KEYS = 8_000, 50_000  # with these it is as quick
MAX_LINE = 4096
MAX_SUB_INDEX = 254

_LIBRARY_ERRORS = (ValueError, TypeError, AttributeError, LookupError, configparser.Error)
_SECTION = re.compile(r"\[([^\]]*)\]")
_OBJECT = re.compile(r"[0-9A-Fa-f]{4}(sub[0-9A-Fa-f]{1,2})?$", re.IGNORECASE)
_KEY = re.compile(r"[A-Za-z0-9_ ]+$")
_TEXT_KEYS = frozenset({"ParameterName", "VendorName", "ProductName", "OrderCode", "Description", "FileName"})
_NUMBER_KEYS = frozenset(
    {
        "VendorNumber", "ProductNumber", "RevisionNumber", "SimpleBootUpMaster", "SimpleBootUpSlave", "Granularity",
        "DynamicChannelsSupported", "GroupMessaging", "NrOfRXPDO", "NrOfTXPDO", "LSS_Supported", "ObjectType",
        "PDOMapping", "SubNumber", "NrOfEntries", "CompactSubObj", "DataType",
        *(f"BaudRate_{rate}" for rate in (10, 20, 50, 125, 250, 500, 800, 1000)),
        *(f"Dummy{number:04d}" for number in range(1, 8)),
    }
)  # fmt: skip
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
    """Read an EDS or DCF file; ``node_id`` resolves $NODEID. EdsError when it cannot be read or is no EDS."""
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
    """Hand the sections to the library; one of ``_LIBRARY_ERRORS`` when it cannot read them."""
    source = io.StringIO("".join(section.text() for section in sections))
    source.name = "clean.eds"
    return import_od(source, node_id)


def _first_unreadable(sections: Sequence[_Section], node_id: int | None) -> int:
    """Return the section that makes the file unreadable: the last of the fewest that the library cannot read."""

    def fails(count: int) -> bool:
        try:
            _read(sections[:count], node_id)
        except _LIBRARY_ERRORS:
            return True
        return False

    return bisect_left(range(len(sections)), True, key=lambda last: fails(last + 1))


def _sections(raw: bytes, name: str) -> list[_Section]:
    """Read and mend all sections; one that comes twice is merged, the later key counts."""
    if len(raw) > MAX_BYTES:
        raise EdsError(name, f"it is larger than {MAX_BYTES >> 20} MiB; this is no EDS file")
    sections: dict[str, _Section] = {}
    current: _Section | None = None
    objects = keys = 0
    for number, line in _lines(raw, name):
        header = _SECTION.match(line)
        if header:
            title = header[1].strip()
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
    return _complete(sections)


def _lines(raw: bytes, name: str) -> Iterator[tuple[int, str]]:
    """Yield (line number, text) of every line that says something."""
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
    key = _KNOWN.get(key.lower(), key)
    if not _KEY.match(key):
        return
    marks = r"\s;.*$" if key in _TEXT_KEYS else r"(^|\s)[;#].*$"
    value = re.sub(marks, "", " " + value).strip()
    if key in _NUMBER_KEYS:
        number = _number(value)
        if number is None:
            raise EdsError(name, f"line {line}: {key} is {value[:40]!r} where a number belongs; correct it")
        if key in ("CompactSubObj", "NrOfEntries") and number > MAX_SUB_INDEX:
            raise EdsError(name, f"line {line}: {key} is {number}, more than an object can have; correct it")
        value = str(number)
    section.values[key] = value


def _number(text: str) -> int | None:
    """Read a number as it is found: blank is 0, leading zeros are decimal."""
    if not text:
        return 0
    try:
        return int(text, 0)
    except ValueError:
        return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else None


def _complete(sections: dict[str, _Section]) -> list[_Section]:
    """Drop what the library stumbles over, fill in what it insists on, and put objects before their sub-objects."""
    for title in [t for t in sections if t.lower() in ("comments", "")]:
        del sections[title]
    sections.setdefault("DeviceInfo", _Section("DeviceInfo", 1))
    for section in sections.values():
        if section.name.lower() == "dummyusage":
            for number in range(1, 8):
                section.values.setdefault(f"Dummy{number:04d}", "0")
        elif section.name == "DeviceComissioning":
            for key in ("NodeID", "Baudrate"):
                number_text = section.values.pop(key, "")
                if number_text and _number(number_text) is not None:
                    section.values[key] = str(_number(number_text))
        elif _OBJECT.match(section.name):
            section.values.setdefault("ParameterName", section.name)
            section.values.setdefault("AccessType", "ro")
            if section.values.get("ObjectType") == "0":
                del section.values["ObjectType"]
    return sorted(sections.values(), key=lambda s: (bool(_OBJECT.match(s.name)) and len(s.name) > 4, s.line))
