"""Reads EDS and DCF files as they occur in the field.

Accepted are Windows text, repeated sections and keys, blank numbers, leading zeros, comments behind values, keys and
sections in any case, missing keys, compact storage, and wrong counts. An ambiguous or unreadable file is one
:class:`EdsError` with the line.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fdhil.eds.compact_storage import expand_compact_storage, is_value_list
from fdhil.eds.eds_file import INTEGER_TYPES, EdsEntry, EdsFile, EdsObject
from fdhil.eds.eds_numbers import read_expression, read_number, read_octal
from fdhil.errors import EdsError

MAX_BYTES = 2 * 1024 * 1024
MAX_OBJECTS = 6_000  # real drives have some hundreds
MAX_SECTIONS, MAX_KEYS = 8_000, 50_000
MAX_LINE = 4096
MAX_SUB_INDEX = 254

_NODE_IDS = range(1, 128)
_NO_NODE_ID = (0, 255)  # in files without a node
_SECTION = re.compile(r"\[([^\]]*)\]")
_OBJECT = re.compile(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?$", re.IGNORECASE)
_COMMISSIONING = re.compile(r"device[ _]?com+is+ion+ing$", re.IGNORECASE)
_NODE_KEY = re.compile(r"node[ _-]?id$", re.IGNORECASE)
_KEY = re.compile(r"[A-Za-z0-9_ ]+$")
_VALUE_KEYS = ("DefaultValue", "ParameterValue")
_PDO_PARAMETERS = range(0x1400, 0x1C00)
_DOMAIN, _VAR, _ARRAY, _RECORD = 2, 7, 8, 9
_LAST_STANDARD_TYPE = 0x1B
_TITLES = {title.lower(): title for title in ("DeviceInfo", "DummyUsage")}
_TEXT_KEYS = frozenset({"ParameterName", "VendorName", "ProductName", "OrderCode", "Description", "FileName"})
# these decide which objects exist, their size, and the vendor: an ambiguous number is refused
_SURE_KEYS = frozenset(
    {
        "DataType", "ObjectType", "CompactSubObj", "NrOfEntries", "NrOfRXPDO", "NrOfTXPDO", "CompactPDO", "Granularity",
        "VendorNumber", "ProductNumber",
    }
)  # fmt: skip
_NUMBER_KEYS = _SURE_KEYS | {
    "RevisionNumber", "SimpleBootUpMaster", "SimpleBootUpSlave", "DynamicChannelsSupported", "GroupMessaging",
    "LSS_Supported", "PDOMapping", "SubNumber",
    *(f"BaudRate_{rate}" for rate in (10, 20, 50, 125, 250, 500, 800, 1000)),
    *(f"Dummy{number:04d}" for number in range(1, 8)),
}  # fmt: skip
_OTHER_KEYS = ("AccessType", "LowLimit", "HighLimit", "NodeID", *_VALUE_KEYS)
_KNOWN = {key.lower(): key for key in (*_TEXT_KEYS, *_NUMBER_KEYS, *_OTHER_KEYS)}


@dataclass(slots=True)
class _Section:
    title: str
    line: int
    values: dict[str, str] = field(default_factory=dict)


def read_eds(path: Path) -> EdsFile:
    """Read an EDS or DCF file; EdsError when it cannot be read or is no EDS."""
    if path.exists() and not path.is_file() and not path.is_dir():  # reading a pipe could block for ever
        raise EdsError(str(path), "it is not a regular file; check the path")
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise EdsError(str(path), f"it cannot be read ({error.strerror}); check the path") from None
    return parse_eds(raw, str(path))


def parse_eds(raw: bytes, name: str) -> EdsFile:
    """Parse the bytes of an EDS or DCF file; EdsError with the line at fault."""
    sections = _parse_sections(raw, name)
    info = sections.get("DeviceInfo", _Section("DeviceInfo", 1)).values
    vendor, product, revision = (read_number(info.get(f"{key}Number", "")) for key in ("Vendor", "Product", "Revision"))
    node_id = _read_node_id(sections, name)
    names = info.get("VendorName", ""), info.get("ProductName", "")
    return EdsFile(name, *names, vendor, product, revision, node_id, tuple(_build_objects(sections, name)))


def _parse_sections(raw: bytes, name: str) -> dict[str, _Section]:
    """Return all sections by title; of a repeated section or key the later value counts."""
    if len(raw) > MAX_BYTES:
        raise EdsError(name, f"it is larger than {MAX_BYTES >> 20} MiB; this is not an EDS file")
    sections: dict[str, _Section] = {}
    current: _Section | None = None
    objects = keys = 0
    for number, line in _read_lines(raw, name):
        header = _SECTION.match(line)
        if header:
            title = _normalise_title(header[1].strip())
            if title not in sections:
                sections[title] = _Section(title, number)
                objects += bool(_OBJECT.match(title))
            current = sections[title]
        elif current is not None and "=" in line:
            keys += 1
            key, _, value = line.partition("=")
            _store_value(current, key.strip(), value, number, name)
        if objects > MAX_OBJECTS or len(sections) > MAX_SECTIONS or keys > MAX_KEYS:
            most = f"{MAX_OBJECTS} objects, {MAX_SECTIONS} sections or {MAX_KEYS} keys"
            raise EdsError(name, f"line {number}: it has more than {most}; this is not a drive's EDS")
    if raw.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<"):
        raise EdsError(name, "line 1: it is XML (an XDD, or an ESI of EtherCAT); ask the drive's vendor for its EDS")
    if not any(_OBJECT.match(title) for title in sections):
        raise EdsError(name, "line 1: it has no object; this is not an EDS file")
    compact = expand_compact_storage({title: section.values for title, section in sections.items()}, MAX_SECTIONS)
    if len(sections) + len(compact) > MAX_SECTIONS:
        raise EdsError(name, f"it has more than {MAX_SECTIONS} objects in compact form; this is not a drive's EDS")
    for title, values in compact.items():
        origin = sections.get(title) or sections.get(title[:4]) or sections.get("DeviceInfo")
        sections[title] = _Section(title, origin.line if origin else 1, {**values})
    return {title: section for title, section in sections.items() if not is_value_list(title)}


def _normalise_title(title: str) -> str:
    if match := _OBJECT.match(title):
        return match[1].upper() + (f"sub{int(match[2], 16):X}" if match[2] else "")
    return "DeviceComissioning" if _COMMISSIONING.match(title) else _TITLES.get(title.lower(), title)


def _read_lines(raw: bytes, name: str) -> Iterator[tuple[int, str]]:
    """Yield number and text of every line that is neither blank nor a comment."""
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
    for number, line in enumerate(text.replace("\0", "").splitlines(), 1):
        if len(line) > MAX_LINE:
            raise EdsError(name, f"line {number} is longer than {MAX_LINE} characters; this is not an EDS file")
        stripped = line.strip()
        if stripped and stripped[0] not in ";#":
            yield number, stripped


def _store_value(section: _Section, key: str, value: str, line: int, name: str) -> None:
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
            _require_one_reading(f"line {line}: {key} of [{section.title}]", value, name)
        if key in ("CompactSubObj", "NrOfEntries") and number > MAX_SUB_INDEX:
            raise EdsError(name, f"line {line}: {key} is {number}, more than an object can have; correct it")
        value = str(number)
    before = section.values.get(key, "")
    if key == "NodeID" and value and before and read_number(value) != read_number(before):
        what = f"line {line}: NodeID is {value[:40]!r}, and {before[:40]!r} in a line above"
        raise EdsError(name, f"{what}: its COB-IDs belong to one of these nodes; remove the other")
    section.values[key] = value


def _read_node_id(sections: Mapping[str, _Section], name: str) -> int | None:
    """Return the node-ID of a DCF, None where it has none; EdsError for an invalid or ambiguous one."""
    section = sections.get("DeviceComissioning")
    text = section.values.get("NodeID", "") if section else ""
    if section is None or not text:
        return None
    number = read_number(text)
    _require_one_reading(f"line {section.line}: NodeID of [{section.title}]", text, name)
    if number in _NO_NODE_ID:
        return None
    if number is None or number not in _NODE_IDS:
        what = f"line {section.line}: NodeID is {text[:40]!r}, not from 1 to 127"
        raise EdsError(name, f"{what}: its COB-IDs belong to no known node; correct it or remove it")
    return number


def _build_objects(sections: Mapping[str, _Section], name: str) -> Iterator[EdsObject]:
    """Yield the objects in the order of the file, dummy objects as those of their data type."""
    entries: dict[int, list[EdsEntry]] = {}
    heads: list[tuple[_Section, int]] = []
    in_order = sorted(sections.values(), key=lambda section: section.line)
    parents = {section.title[:4] for section in in_order if _is_sub_object(section.title)}
    for section in in_order:
        if section.title == "DummyUsage":
            heads += [(section, number) for number in range(1, 8) if section.values.get(f"Dummy{number:04d}") == "1"]
        elif _OBJECT.match(section.title) and not _is_sub_object(section.title):
            kind = int(section.values.get("ObjectType", "0")) or _VAR
            kind = _RECORD if section.title in parents and kind != _ARRAY else kind
            section.values["ObjectType"] = str(kind)
            index = int(section.title, 16)
            if kind in (_VAR, _DOMAIN):
                entries[index] = [_build_entry(section, index, 0, sections, name)]
            elif kind in (_ARRAY, _RECORD):
                entries[index] = []
            else:
                continue
            heads.append((section, index))
    for section in filter(lambda section: _is_sub_object(section.title), in_order):
        index, sub = int(section.title[:4], 16), int(section.title[7:], 16)
        if index not in entries:
            text = (
                f"line {section.line}: [{section.title}] belongs to no object; add [{section.title[:4]}] or remove it"
            )
            raise EdsError(name, text)
        entries[index].append(_build_entry(section, index, sub, sections, name))
    for section, index in heads:
        if section.title == "DummyUsage":
            title = f"Dummy{index:04d}"
            yield EdsObject(index, title, _VAR, (EdsEntry(index, 0, title, index, "const", False),))
        else:
            title = section.values.get("ParameterName", section.title)
            yield EdsObject(index, title, int(section.values["ObjectType"]), tuple(entries[index]))


def _is_sub_object(title: str) -> bool:
    return len(title) > 4 and _OBJECT.match(title) is not None


def _build_entry(section: _Section, index: int, sub: int, sections: Mapping[str, _Section], name: str) -> EdsEntry:
    values = section.values
    if "DataType" not in values:
        raise EdsError(name, f"line {section.line}: [{section.title}] has no DataType; add it or remove the section")
    data_type = int(values["DataType"])
    if index in _PDO_PARAMETERS and data_type in INTEGER_TYPES:
        _require_numbers(section, name)
    if data_type > _LAST_STANDARD_TYPE:  # CANFestival's editor puts limited types into objects of their own
        alias = sections.get(f"{data_type:X}sub1")
        data_type = read_number(alias.values.get("DefaultValue", "")) or data_type if alias else data_type
    return EdsEntry(
        index=index,
        sub=sub,
        name=values.get("ParameterName", section.title),
        data_type=data_type,
        access=values.get("AccessType", "ro").lower(),
        mappable=values.get("PDOMapping", "0") != "0",
        default=values.get("ParameterValue") or values.get("DefaultValue", ""),
        low=values.get("LowLimit", ""),
        high=values.get("HighLimit", ""),
    )


def _require_numbers(section: _Section, name: str) -> None:
    """Raise EdsError for an invalid or ambiguous value of a PDO parameter."""
    for key in _VALUE_KEYS:
        if text := section.values.get(key, ""):
            where = f"line {section.line}: {key} of [{section.title}]"
            _require_one_reading(where, text, name)
            if read_expression(text) is None:
                raise EdsError(name, f"{where} is {text[:40]!r} where a number belongs; correct it or remove it")


def _require_one_reading(where: str, text: str, name: str) -> None:
    """Raise EdsError for a number with a leading zero that is another in octal than in decimal."""
    decimal, octal = read_expression(text), read_octal(text)
    if decimal is not None and octal is not None:
        readings = f"as octal {octal:#x}, as decimal {decimal[0]:#x}"
        raise EdsError(name, f"{where} is {text[:40]!r}: {readings}; write it without the leading zero, or with 0x")
