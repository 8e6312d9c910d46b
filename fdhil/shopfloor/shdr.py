"""Formats published values as lines of MTConnect's adapter protocol (SHDR), and the agent's Devices.xml. Pure.

Lines and levels: MTConnect part 5 and the adapter guide of the reference agent. Names, units and the form of
Devices.xml: MTConnect 2.0, part 2; types and units outside the standard have the prefix ``x:``.
"""

import re
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fdhil.daemon import escape_unprintable
from fdhil.shopfloor.published_items import Plain, PublishedAlarm, PublishedEvent, PublishedItem, PublishedValue
from fdhil.shopfloor.status_poller import StatusUpdate

VERSION = "2.0"
SCHEMA = f"urn:mtconnect.org:MTConnectDevices:{VERSION}"
OWN_SCHEMA = f"urn:fdhil:MTConnectDevices:{VERSION}"
UNAVAILABLE = "UNAVAILABLE"
AVAILABLE, CONDITION, NOTICE = "avail", "condition", "notice"
PING, PONG = "* PING", "* PONG"

# our unit -> MTConnect's, and what a value is multiplied with
UNITS: Mapping[str, tuple[str, float]] = {
    "um": ("MILLIMETER", 1e-3),
    "mm/min": ("MILLIMETER/SECOND", 1 / 60),
    "s": ("SECOND", 1.0),
    "Hz": ("HERTZ", 1.0),
    "%": ("PERCENT", 1.0),
    "degC": ("CELSIUS", 1.0),
    "ohm": ("OHM", 1.0),
    "N.m": ("NEWTON_METER", 1.0),
    "H": ("x:HENRY", 1.0),
    "N.m/A": ("x:NEWTON_METER_PER_AMPERE", 1.0),
    "kg.m2": ("x:KILOGRAM_METER_SQUARED", 1.0),
    "N.m.s": ("x:NEWTON_METER_SECOND", 1.0),
}
# items with a type of the standard, or a common name: type and sub-type
TYPES: Mapping[str, tuple[str, str]] = {
    "R": ("RESISTANCE", ""),
    "L": ("x:INDUCTANCE", ""),
    "K": ("x:TORQUE_CONSTANT", ""),
    "Jt": ("x:INERTIA", ""),
    "ft": ("x:VISCOUS_FRICTION", ""),
    "Cd": ("x:COULOMB_FRICTION", ""),
    "identified_at": ("TEMPERATURE", ""),
    "slideway": ("TEMPERATURE", ""),
    "nc_program": ("PROGRAM", ""),
    "nc_line": ("LINE_NUMBER", "ABSOLUTE"),
    "nc_feed": ("PATH_FEEDRATE", "ACTUAL"),
    "nc_feed_override": ("PATH_FEEDRATE_OVERRIDE", "PROGRAMMED"),
    "nc_rapid_override": ("PATH_FEEDRATE_OVERRIDE", "RAPID"),
}
IN_PERCENT = {"nc_feed_override", "nc_rapid_override"}


@cache
def make_item_id(name: str, axis: str = "", bus: str = "") -> str:
    """Return the id of a data item: letters, digits and underscores."""
    return re.sub(r"\W", "_", "_".join(filter(None, (axis or bus or "machine", name))), flags=re.ASCII)


def format_timestamp(ms: int) -> str:
    """Return Unix time in ms as ISO 8601 in UTC."""
    return datetime.fromtimestamp(ms / 1000, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _clean_text(text: str) -> str:
    """Return text without line and field separators that an agent can write as XML."""
    return escape_unprintable(" ".join(text.replace("|", "/").split()))


def format_value(item: PublishedItem, value: Plain) -> str:
    """Format a value of a data item in its unit."""
    if value is None:
        return UNAVAILABLE
    if isinstance(value, bool):
        return str(value).upper()
    if isinstance(value, str):
        return _clean_text(value)
    factor = 100.0 if item.name in IN_PERCENT else UNITS.get(item.unit, ("", 1.0))[1]
    return f"{value * factor:.12g}"


@dataclass(frozen=True, slots=True)
class AdapterState:
    """Full state of the adapter: the text of each data item, and its time (Unix time in ms).

    ``conditions`` has the active alarms of each condition by their code; None: unknown.
    """

    items: Mapping[str, str]
    stamps: Mapping[str, int]
    conditions: Mapping[str, Mapping[str, str] | None]
    now_ms: int


def build_adapter_state(news: StatusUpdate) -> AdapterState:
    """Return the adapter state for an update, or for a silent daemon."""
    items = {AVAILABLE: UNAVAILABLE if news.silent else "AVAILABLE"}
    items |= {make_item_id(*value.key): format_value(value.item, value.value) for value in news.values}
    stamps = {make_item_id(*value.key): value.stamp_ms for value in news.values}
    conditions: dict[str, Mapping[str, str] | None] = {}
    for axis in ("", *dict.fromkeys(value.axis for value in news.values if value.axis)):
        active = {alarm.code: _format_condition_level(alarm) for alarm in news.alarms if alarm.axis == axis}
        conditions[make_item_id(CONDITION, axis)] = None if news.silent else active
    return AdapterState(items, stamps, conditions, news.stamp_ms)


def _format_condition_level(alarm: PublishedAlarm) -> str:
    level = "FAULT" if alarm.severity == "MAJOR" else "WARNING"
    return f"{level}|{alarm.code}|{alarm.severity}||{_clean_text(alarm.text)}"


def list_changed_lines(before: AdapterState | None, now: AdapterState) -> list[str]:
    """Return the lines that bring an agent from ``before`` (None: it has nothing) to ``now``."""
    sent = {} if before is None else before.items
    changed = [(key, text) for key, text in now.items.items() if sent.get(key) != text]
    result = [f"{format_timestamp(now.stamps.get(key, now.now_ms))}|{key}|{text}" for key, text in changed]
    for key, active in now.conditions.items():
        past = None if before is None else before.conditions[key]
        texts = [] if before is not None and past == active else _list_condition_lines(past, active)
        result += [f"{format_timestamp(now.now_ms)}|{key}|{text}" for text in texts]
    return result


def format_notice(event: PublishedEvent) -> str:
    """Return the line of a notice: a message with the class as its native code."""
    return (
        f"{format_timestamp(event.stamp_ms)}|{make_item_id(NOTICE, event.axis)}|{event.code}|{_clean_text(event.text)}"
    )


def _list_condition_lines(past: Mapping[str, str] | None, active: Mapping[str, str] | None) -> list[str]:
    """Return the lines of a condition: cleared codes and new alarms, or NORMAL for all."""
    if active is None:
        return [f"{UNAVAILABLE}||||"]
    if not active:
        return ["NORMAL||||"]
    before = past or {}
    over = [f"NORMAL|{code}|||" for code in before if code not in active]
    return over + [text for code, text in active.items() if before.get(code) != text]


def encode_devices_xml(machine: str, uid: str, values: Iterable[PublishedValue], created_ms: int) -> str:
    """Return the Devices.xml of an agent of this adapter, with every data item that it may send."""
    listed = list(values)
    axes = dict.fromkeys(value.axis for value in listed if value.axis)
    root = Element("MTConnectDevices", {"xmlns": SCHEMA, "xmlns:x": OWN_SCHEMA})
    head = {
        "creationTime": format_timestamp(created_ms),
        "deviceModelChangeTime": format_timestamp(created_ms),
        "sender": "fdhil",
    }
    head |= {
        "instanceId": "1",
        "version": VERSION,
        "bufferSize": "131072",
        "assetBufferSize": "1024",
        "assetCount": "0",
    }
    SubElement(root, "Header", head)
    name = re.sub(r"\W", "_", machine, flags=re.ASCII)
    identity = {"id": "fdhil", "name": name, "uuid": uid or make_default_uuid(machine)}
    device = SubElement(SubElement(root, "Devices"), "Device", identity)
    SubElement(device, "Description").text = f"feed drives of {machine}, as monitored by fdhil"
    own = SubElement(device, "DataItems")
    SubElement(own, "DataItem", {"category": "EVENT", "id": AVAILABLE, "type": "AVAILABILITY"})
    _add_data_items(own, [value for value in listed if not value.axis], "")
    components = SubElement(SubElement(device, "Components"), "Axes", {"id": "axes"})
    linear = SubElement(components, "Components")
    for axis in axes:
        component = SubElement(linear, "Linear", {"id": make_item_id("axis", axis), "name": axis})
        _add_data_items(SubElement(component, "DataItems"), [value for value in listed if value.axis == axis], axis)
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def make_default_uuid(machine: str) -> str:
    """Return the UUID of a machine without a configured one: always the same for the same name."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"urn:fdhil:{machine}"))


def _add_data_items(parent: Element, values: Iterable[PublishedValue], axis: str) -> None:
    for value in values:
        SubElement(parent, "DataItem", _describe_data_item(value))
    SubElement(parent, "DataItem", {"category": "CONDITION", "id": make_item_id(CONDITION, axis), "type": "SYSTEM"})
    SubElement(parent, "DataItem", {"category": "EVENT", "id": make_item_id(NOTICE, axis), "type": "MESSAGE"})


def _describe_data_item(value: PublishedValue) -> dict[str, str]:
    """Return the attributes of a data item; it is a SAMPLE when it has a unit other than a share or a count."""
    item = value.item
    name, _, end = item.name.partition("_")
    interval = name in TYPES and end in ("low", "high")
    kind, sub = TYPES[name] if interval else TYPES.get(item.name, (f"x:{item.name.upper()}", ""))
    sub = f"x:INTERVAL_{end.upper()}" if interval else sub
    unit = UNITS[item.unit][0] if item.kind == "measure" and item.unit in UNITS else ""
    attributes = {
        "category": "SAMPLE" if unit else "EVENT",
        "id": make_item_id(*value.key),
        "name": make_item_id(*value.key),
        "type": kind,
    }
    return attributes | ({"subType": sub} if sub else {}) | ({"units": unit} if unit else {})
