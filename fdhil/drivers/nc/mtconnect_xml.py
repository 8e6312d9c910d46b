"""Reads the documents of an MTConnect agent. Pure.

Source: MTConnect Standard Part 1 (header, errors) and Part 3 (streams).
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

from fdhil.errors import ProtocolError

UNAVAILABLE = "UNAVAILABLE"
_HOLDERS = ("Samples", "Events")
_COMPONENTS = ("Path", "Controller")


@dataclass(frozen=True, slots=True)
class Observation:
    """The value of one data item from ``time_s`` of the agent's clock on (None: without time stamp).

    ``element`` is the element's name, with its subType behind a colon; ``text`` is None where it is unavailable.
    """

    sequence: int
    item: str
    element: str
    text: str | None
    time_s: float | None


@dataclass(frozen=True, slots=True)
class Component:
    """A path, or its controller, of one device, and its observations."""

    device: tuple[str, str]  # name, uuid
    kind: str
    names: tuple[str, str]  # name, componentId
    observed: tuple[Observation, ...]


@dataclass(frozen=True, slots=True)
class Streams:
    """A streams document: new observations up to ``next_sequence`` of the agent's run ``instance``."""

    instance: str
    next_sequence: int
    buffer_size: int
    components: tuple[Component, ...]


def read_streams(document: bytes, name: str) -> Streams:
    """Parse a document of the agent ``name``; ProtocolError for an error document and for an invalid one."""
    if b"<!DOCTYPE" in document or b"<!ENTITY" in document:
        raise ProtocolError(name, "sends XML with DTD declarations, which no agent does; compare url")
    try:
        root = ElementTree.fromstring(document)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ProtocolError(name, f"does not answer with an MTConnect document ({error}); compare url") from None
    if _get_local_name(root) == "MTConnectError":
        raise ProtocolError(name, f"refuses: {_describe_refusal(root)}; compare url, device and path with its /probe")
    header = next((child for child in root if _get_local_name(child) == "Header"), None)
    if _get_local_name(root) != "MTConnectStreams" or header is None:
        raise ProtocolError(name, f"answers with a {_get_local_name(root)[:40]} document; compare url")
    try:
        follows, size = int(header.get("nextSequence", "")), int(header.get("bufferSize", "0"))
    except ValueError:
        raise ProtocolError(name, "sends no nextSequence in its header; the agent is too old") from None
    return Streams(header.get("instanceId", ""), follows, size, tuple(_parse_components(root, name)))


def _describe_refusal(root: ElementTree.Element) -> str:
    errors = [each for each in root.iter() if _get_local_name(each) == "Error"]
    return "; ".join(f"{each.get('errorCode', '')} {(each.text or '').strip()}"[:200] for each in errors) or "unknown"


def _parse_components(root: ElementTree.Element, name: str) -> Iterator[Component]:
    for device in (each for each in root.iter() if _get_local_name(each) == "DeviceStream"):
        identity = device.get("name", ""), device.get("uuid", "")
        for stream in device:
            kind = stream.get("component", "")
            if kind in _COMPONENTS:
                names = stream.get("name", ""), stream.get("componentId", "")
                yield Component(identity, kind, names, tuple(_parse_observations(stream, name)))


def _parse_observations(stream: ElementTree.Element, name: str) -> Iterator[Observation]:
    for holder in (each for each in stream if _get_local_name(each) in _HOLDERS):
        for each in holder:
            try:
                sequence = int(each.get("sequence", ""))
            except ValueError:
                raise ProtocolError(name, f"sends a {_get_local_name(each)[:40]} without a sequence number") from None
            text = (each.text or "").strip()
            sub_type = each.get("subType", "")
            element = f"{_get_local_name(each)}:{sub_type}" if sub_type else _get_local_name(each)
            shown = None if text == UNAVAILABLE else text
            yield Observation(
                sequence, each.get("dataItemId", ""), element, shown, _parse_time_s(each.get("timestamp", ""))
            )


def _parse_time_s(text: str) -> float | None:
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        return None


def _get_local_name(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2]


def select_components(components: Sequence[Component], device: str, path: str, name: str) -> tuple[Component, ...]:
    """Return the configured path and the controllers of its device; ProtocolError where the choice is ambiguous."""
    paths = [each for each in components if each.kind == "Path" and (not device or device in each.device)]
    devices = {each.device for each in paths}
    if len(devices) != 1:
        known = ", ".join(sorted(each.device[0] for each in components if each.kind == "Path")) or "none with a path"
        raise ProtocolError(name, f"its devices are: {known}; give device in [nc_source.mtconnect]")
    paths = [each for each in paths if not path or path in each.names]
    if len(paths) != 1:
        known = ", ".join(sorted(each.names[0] or each.names[1] for each in components if each.kind == "Path"))
        raise ProtocolError(name, f"its paths are: {known}; give path in [nc_source.mtconnect]")
    owner = paths[0].device
    return (paths[0], *(each for each in components if each.kind == "Controller" and each.device == owner))


def find_data_item(components: Sequence[Component], places: str) -> str | None:
    """Return the dataItemId of the first of these places (``Line``, ``PathFeedrate:ACTUAL``, ``@id``) that exists."""
    observed = [each for component in components for each in component.observed]
    for place in places.split("|"):
        for each in observed:
            if place in (each.element, f"@{each.item}"):
                return each.item
    return None
