"""Implements a Sparkplug B edge node: topics, payloads, birth and death certificates, sequence numbers. Pure.

Field numbers, data types and the order of messages follow the Eclipse Sparkplug specification 3.0, chapters 4 to 6. An
edge node is a machine, its devices are the axes.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

NAMESPACE = "spBv1.0"
REBIRTH = "Node Control/Rebirth"
BIRTH_DEATH = "bdSeq"
WRAP = 256  # range of seq and bdSeq, 0 to 255
INT64, DOUBLE, BOOLEAN, STRING = 4, 10, 11, 12
UNIT = "engUnit"
DESCRIPTION = "Documentation"

Value = bool | int | float | str | None

# message -> its fields in use here: number, protobuf's type ("*": repeated), name
_FIELDS: Mapping[str, tuple[tuple[int, str, str], ...]] = {
    "Payload": ((1, "uint64", "timestamp"), (2, "Metric*", "metrics"), (3, "uint64", "seq")),
    "Metric": (
        (1, "string", "name"), (2, "uint64", "alias"), (3, "uint64", "timestamp"), (4, "uint32", "datatype"),
        (7, "bool", "is_null"), (9, "PropertySet", "properties"), (10, "uint32", "int_value"),
        (11, "uint64", "long_value"), (12, "float", "float_value"), (13, "double", "double_value"),
        (14, "bool", "boolean_value"), (15, "string", "string_value"),
    ),
    "PropertySet": ((1, "string*", "keys"), (2, "PropertyValue*", "values")),
    "PropertyValue": ((1, "uint32", "type"), (2, "bool", "is_null"), (8, "string", "string_value")),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Metric:
    """One value of the node or of a device: ``datatype`` as numbered by Sparkplug, ``stamp_ms`` since 1970 in UTC.

    An ``event`` is sent again where its value is unchanged but its stamp is not.
    """

    name: str
    datatype: int
    value: Value
    stamp_ms: int
    unit: str = ""
    description: str = ""
    event: bool = False


@dataclass(frozen=True, slots=True)
class Message:
    """An MQTT message; nothing of an edge node is retained."""

    topic: str
    payload: bytes
    qos: int = 0


class EdgeNode:
    """The session of one edge node with a broker, across connections.

    The order of calls is that of the specification: ``begin_connection`` before each connection, ``build_births`` after
    it (and when a
    host requests them), then ``build_changes`` repeatedly, ``build_death`` before the connection is closed on purpose.
    """

    def __init__(self, group: str, node: str) -> None:
        self._group, self._node = group, node
        self._aliases: dict[tuple[str, str], int] = {}
        self._sent: dict[str, dict[str, Metric]] = {}  # by device that was born, "" the node
        self._seq = 0
        self._bd_seq = -1

    def make_topic(self, verb: str, device: str = "") -> str:
        """Return the topic of a message."""
        return "/".join((NAMESPACE, self._group, verb, self._node, *([device] if device else [])))

    def begin_connection(self, now_ms: int) -> Message:
        """Begin a new connection: return the death certificate that the broker publishes when the connection breaks."""
        self._bd_seq = (self._bd_seq + 1) % WRAP
        return self.build_death(now_ms)

    def build_death(self, now_ms: int) -> Message:
        """Return the death certificate of this connection."""
        return Message(
            self.make_topic("NDEATH"),
            _encode_payload(now_ms, None, [_encode_metric(self._make_birth_death_metric(now_ms))]),
            qos=1,
        )

    def build_births(
        self, node: Iterable[Metric], devices: Mapping[str, Iterable[Metric]], now_ms: int
    ) -> list[Message]:
        """Return the birth certificates of the node and its devices, with all known metrics."""
        self._sent, self._seq = {}, -1
        rebirth = Metric(REBIRTH, BOOLEAN, False, now_ms, description="write true to have all births sent again")
        own = [_encode_metric(self._make_birth_death_metric(now_ms)), _encode_metric(rebirth)]
        born = [self._build_birth("", list(node), now_ms, own)]
        return born + [self._build_birth(device, list(metrics), now_ms, []) for device, metrics in devices.items()]

    def build_changes(
        self, node: Iterable[Metric], devices: Mapping[str, Iterable[Metric]], now_ms: int
    ) -> list[Message]:
        """Return the changes since the last call: values, devices that became silent, and returning ones.

        A device that is not listed is silent. One with a metric that its birth did not name is born again.
        """
        now = {device: list(metrics) for device, metrics in devices.items()}
        if self._needs_rebirth("", own := list(node)):
            return self.build_births(own, now, now_ms)
        silent = [device for device in self._sent if device and device not in now]
        messages = [message for message in [self._build_data("", own, now_ms)] if message is not None]
        for device in silent:
            del self._sent[device]
            messages.append(
                Message(self.make_topic("DDEATH", device), _encode_payload(now_ms, self._advance_sequence(), []))
            )
        for device, metrics in now.items():
            if device not in self._sent or self._needs_rebirth(device, metrics):
                messages.append(self._build_birth(device, metrics, now_ms, []))
            elif (changed := self._build_data(device, metrics, now_ms)) is not None:
                messages.append(changed)
        return messages

    def _needs_rebirth(self, device: str, metrics: list[Metric]) -> bool:
        sent = self._sent.get(device, {})
        return any(m.name not in sent or sent[m.name].datatype != m.datatype for m in metrics)

    def _build_birth(
        self, device: str, metrics: list[Metric], now_ms: int, own: Sequence[Mapping[str, Any]]
    ) -> Message:
        seq = self._advance_sequence()
        self._sent[device] = {metric.name: metric for metric in metrics}
        named = [{**_encode_metric(metric), "alias": self._get_alias(device, metric.name)} for metric in metrics]
        return Message(
            self.make_topic("DBIRTH" if device else "NBIRTH", device), _encode_payload(now_ms, seq, [*own, *named])
        )

    def _build_data(self, device: str, metrics: list[Metric], now_ms: int) -> Message | None:
        """Return changed metrics by alias; None where nothing changed. A metric that is gone becomes null."""
        sent = self._sent[device]
        still = {metric.name for metric in metrics}
        gone = [replace(old, value=None, stamp_ms=now_ms) for name, old in sent.items() if name not in still]
        new = [metric for metric in (*metrics, *gone) if _is_changed(metric, sent[metric.name])]
        if not new:
            return None
        sent.update({metric.name: metric for metric in new})
        by_alias = [
            {**_encode_value(m), "alias": self._get_alias(device, m.name), "timestamp": m.stamp_ms} for m in new
        ]
        return Message(
            self.make_topic("DDATA" if device else "NDATA", device),
            _encode_payload(now_ms, self._advance_sequence(), by_alias),
        )

    def _get_alias(self, device: str, name: str) -> int:
        return self._aliases.setdefault((device, name), len(self._aliases) + 1)

    def _make_birth_death_metric(self, now_ms: int) -> Metric:
        return Metric(BIRTH_DEATH, INT64, max(0, self._bd_seq), now_ms)

    def _advance_sequence(self) -> int:
        self._seq = (self._seq + 1) % WRAP
        return self._seq


def is_rebirth_command(payload: bytes) -> bool:
    """Return whether a command requests the births; every other command is ignored."""
    command = _build_message_classes()["Payload"]()
    try:
        command.ParseFromString(payload)
    except DecodeError:
        return False
    return any(metric.name == REBIRTH and metric.boolean_value for metric in command.metrics)


@dataclass(frozen=True, slots=True)
class HostState:
    """State of a primary host application, and its time (ms since 1970)."""

    online: bool
    stamp_ms: int


def make_host_topic(host: str) -> str:
    """Return the topic on which a primary host application publishes its state."""
    return f"{NAMESPACE}/STATE/{host}"


def parse_host_state(payload: bytes) -> HostState | None:
    """Parse the state of a host application; None when it is invalid."""
    try:
        document = json.loads(payload)
        online, stamp_ms = document["online"], document["timestamp"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    whole = isinstance(online, bool) and isinstance(stamp_ms, int)
    return HostState(online, stamp_ms) if whole else None


def _is_changed(metric: Metric, sent: Metric) -> bool:
    return _encode_value(metric) != _encode_value(sent) or (metric.event and metric.stamp_ms != sent.stamp_ms)


def _encode_metric(metric: Metric) -> dict[str, Any]:
    pairs = [(UNIT, metric.unit), (DESCRIPTION, metric.description)]
    properties = [(key, text) for key, text in pairs if text]
    property_set = {
        "keys": [key for key, _ in properties],
        "values": [{"type": STRING, "string_value": text} for _, text in properties],
    }
    named = {"name": metric.name, "timestamp": metric.stamp_ms, "datatype": metric.datatype, **_encode_value(metric)}
    return {**named, "properties": property_set} if properties else named


def _encode_value(metric: Metric) -> dict[str, Any]:
    value = metric.value
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return {"is_null": True}
    if metric.datatype == BOOLEAN:
        return {"boolean_value": bool(value)}
    if metric.datatype == INT64:  # two's complement as an unsigned number
        return {"long_value": int(value) % 2**64}
    if metric.datatype == DOUBLE:
        return {"double_value": float(value)}
    # surrogates, as in file names that are not UTF-8, cannot be sent
    return {"string_value": str(value).encode("utf-8", "replace").decode()}


def _encode_payload(now_ms: int, seq: int | None, metrics: Iterable[Mapping[str, Any]]) -> bytes:
    classes = _build_message_classes()
    whole = classes["Payload"](timestamp=now_ms, metrics=[classes["Metric"](**fields) for fields in metrics])
    if seq is not None:
        whole.seq = seq
    return bytes(whole.SerializeToString())


@cache
def _build_message_classes() -> Mapping[str, Any]:
    file = descriptor_pb2.FileDescriptorProto(name="sparkplug_b", package="fdhil.sparkplug", syntax="proto2")
    for name, fields in _FIELDS.items():
        file.message_type.add(name=name).field.extend(_describe_fields(fields))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{file.package}.{name}")) for name in _FIELDS
    }


def _describe_fields(fields: Iterable[tuple[int, str, str]]) -> Iterator[Any]:
    field = descriptor_pb2.FieldDescriptorProto
    for number, kind, name in fields:
        label = field.LABEL_REPEATED if kind.endswith("*") else field.LABEL_OPTIONAL
        kind = kind.removesuffix("*")
        if kind in _FIELDS:
            of = {"type": field.TYPE_MESSAGE, "type_name": f".fdhil.sparkplug.{kind}"}
        else:
            of = {"type": field.Type.Value(f"TYPE_{kind.upper()}")}
        yield field(name=name, number=number, label=label, **of)
