"""A Sparkplug host application for tests, written from the specification alone; it rejects violations.

Wire format: protobuf's encoding guide. Field numbers, data types and order of messages: Eclipse Sparkplug 3.0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

SIGNED_64, DOUBLE, BOOLEAN, STRING = 4, 10, 11, 12  # chapter 6.4.16


def fields(data: bytes) -> Iterator[tuple[int, Any]]:
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, at = _varint(data, at)
            yield number, value
        elif wire == 1:
            yield number, struct.unpack_from("<d", data, at)[0]
            at += 8
        elif wire == 2:
            size, at = _varint(data, at)
            assert at + size <= len(data)
            yield number, data[at : at + size]
            at += size
        else:
            raise AssertionError(f"wire type {wire} is not used by Sparkplug's fields here")


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


@dataclass(slots=True)
class Seen:
    name: str = ""
    alias: int | None = None
    stamp_ms: int | None = None
    datatype: int | None = None
    null: bool = False
    raw: tuple[int, Any] | None = None
    properties: dict[str, str] = field(default_factory=dict)

    def value(self, datatype: int) -> Any:
        if self.null:
            assert self.raw is None
            return None
        assert self.raw is not None
        number, raw = self.raw
        assert number == {SIGNED_64: 11, DOUBLE: 13, BOOLEAN: 14, STRING: 15}[datatype], (self, datatype)
        if datatype == SIGNED_64:
            return raw - 2**64 if raw >= 2**63 else raw
        if datatype == BOOLEAN:
            return bool(raw)
        return raw.decode() if datatype == STRING else raw


def decoded(payload: bytes) -> tuple[int | None, int | None, list[Seen]]:
    stamp_ms = seq = None
    metrics = []
    for number, value in fields(payload):
        if number == 1:
            stamp_ms = value
        elif number == 2:
            metrics.append(_metric(value))
        elif number == 3:
            seq = value
    return stamp_ms, seq, metrics


def _metric(data: bytes) -> Seen:
    seen = Seen()
    for number, value in fields(data):
        if number == 1:
            seen.name = value.decode()
        elif number == 2:
            seen.alias = value
        elif number == 3:
            seen.stamp_ms = value
        elif number == 4:
            seen.datatype = value
        elif number == 7:
            seen.null = bool(value)
        elif number == 9:
            seen.properties = _properties(value)
        else:
            assert seen.raw is None, "two values"
            seen.raw = (number, value)
    return seen


def _properties(data: bytes) -> dict[str, str]:
    keys, values = [], []
    for number, value in fields(data):
        if number == 1:
            keys.append(value.decode())
        else:
            result = dict(fields(value))
            assert result[1] == STRING
            values.append(result[8].decode())
    return dict(zip(keys, values, strict=True))


class Host:
    def __init__(self) -> None:
        self.alive = False
        self.bd_seq: int | None = None
        self.values: dict[str, dict[str, Any]] = {}  # of the node (""), and of each device that is alive
        self.units: dict[str, dict[str, str]] = {}
        self.verbs: list[str] = []
        self._types: dict[int, tuple[str, str, int]] = {}
        self._seq = 0

    def take(self, topic: str, payload: bytes) -> None:
        namespace, _, verb, _, *device = topic.split("/")
        assert namespace == "spBv1.0"
        assert len(device) == (verb[0] == "D")
        self.verbs.append("/".join([verb, *device]))
        stamp_ms, seq, metrics = decoded(payload)
        assert stamp_ms
        if verb == "NDEATH":
            self._died(seq, metrics)
            return
        assert seq == (0 if verb == "NBIRTH" else (self._seq + 1) % 256), (seq, self._seq)
        self._seq = seq
        assert all(metric.stamp_ms for metric in metrics)
        if verb == "NBIRTH":
            self.values, self.units, self._types, self.alive = {}, {}, {}, True
        assert self.alive, "data of a node that is dead"
        name = device[0] if device else ""
        if verb.endswith("BIRTH"):
            self._born(name, metrics)
        elif verb == "DDEATH":
            del self.values[name]
        else:
            self._changed(name, metrics)

    def _died(self, seq: int | None, metrics: list[Seen]) -> None:
        assert seq is None, "an NDEATH has no sequence number"
        [bd_seq] = metrics
        assert bd_seq.name == "bdSeq"
        if bd_seq.value(SIGNED_64) == self.bd_seq:  # else it is the death of an earlier connection
            self.alive, self.values = False, {}

    def _born(self, device: str, metrics: list[Seen]) -> None:
        result: dict[str, Any] = {}
        for metric in metrics:
            assert metric.name
            assert metric.name not in result
            assert metric.datatype
            result[metric.name] = metric.value(metric.datatype)
            if metric.alias is not None:
                assert self._types.get(metric.alias, (device, metric.name, 0))[:2] == (device, metric.name)
                self._types[metric.alias] = (device, metric.name, metric.datatype)
        if not device:
            self.bd_seq = result.pop("bdSeq")
            assert result.pop("Node Control/Rebirth") is False
        self.values[device] = result
        self.units[device] = {metric.name: metric.properties.get("engUnit", "") for metric in metrics}

    def _changed(self, device: str, metrics: list[Seen]) -> None:
        assert metrics, "data without data"
        for metric in metrics:
            assert (metric.name, metric.datatype) == ("", None), "data is told by alias alone"
            assert metric.alias is not None
            whose, name, datatype = self._types[metric.alias]
            assert whose == device
            self.values[device][name] = metric.value(datatype)


def command(name: str, value: bool) -> bytes:
    text = name.encode()
    metric = b"\x0a" + bytes([len(text)]) + text + b"\x20\x0b\x70" + bytes([value])
    return b"\x12" + bytes([len(metric)]) + metric
