"""An edge node's messages, read by a host application written from the specification alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.shopfloor.sparkplug import (
    BOOLEAN,
    DOUBLE,
    INT64,
    STRING,
    EdgeNode,
    HostState,
    Message,
    Metric,
    is_rebirth_command,
    make_host_topic,
    parse_host_state,
)
from tests.shopfloor.sparkplug_host import Host, command, decoded

NOW = 1_700_000_000_000


def metric(name: str, value: bool | float | str | None, datatype: int = DOUBLE, unit: str = "") -> Metric:
    return Metric(name, datatype, value, NOW, unit)


def parse_messages(host: Host, messages: Sequence[Message]) -> list[str]:
    before = len(host.verbs)
    for message in messages:
        host.take(message.topic, message.payload)
    return host.verbs[before:]


def begun(node: Sequence[Metric], **devices: Sequence[Metric]) -> tuple[EdgeNode, Host]:
    edge, host = EdgeNode("works", "mill"), Host()
    edge.begin_connection(NOW)
    assert parse_messages(host, edge.build_births(node, devices, NOW)) == [
        "NBIRTH",
        *(f"DBIRTH/{name}" for name in devices),
    ]
    return edge, host


def test_births_have_all_metrics_with_names_types_and_units() -> None:
    x = [metric("R", 0.5, unit="ohm"), metric("windows", -3, INT64), metric("text", "grün | ja", STRING)]
    _, host = begun([metric("up", True, BOOLEAN)], X=x, Y=[metric("R", None)])
    assert host.values == {"": {"up": True}, "X": {"R": 0.5, "windows": -3, "text": "grün | ja"}, "Y": {"R": None}}
    assert host.units["X"]["R"] == "ohm"


def test_only_changes_are_sent_by_alias() -> None:
    edge, host = begun([metric("state", "OFF", STRING)], X=[metric("R", 0.5), metric("L", 5e-3)])
    same = [metric("state", "OFF", STRING)]
    assert edge.build_changes(same, {"X": [metric("R", 0.5), metric("L", 5e-3)]}, NOW) == []
    assert parse_messages(host, edge.build_changes(same, {"X": [metric("R", 0.6), metric("L", 5e-3)]}, NOW)) == [
        "DDATA/X"
    ]
    assert host.values["X"] == {"R": 0.6, "L": 5e-3}
    assert parse_messages(
        host, edge.build_changes([metric("state", "ARMED", STRING)], {"X": [metric("R", 0.6)]}, NOW)
    ) == [
        "NDATA",
        "DDATA/X",
    ]
    assert host.values == {"": {"state": "ARMED"}, "X": {"R": 0.6, "L": None}}
    nan = edge.build_changes([metric("state", "ARMED", STRING)], {"X": [metric("R", math.nan)]}, NOW)
    assert parse_messages(host, nan) == ["DDATA/X"]
    assert host.values["X"]["R"] is None
    assert edge.build_changes([metric("state", "ARMED", STRING)], {"X": [metric("R", math.nan)]}, NOW) == []


def test_a_silent_device_dies_and_is_born_again() -> None:
    edge, host = begun([], X=[metric("R", 0.5)], Y=[metric("R", 0.7)])
    assert parse_messages(host, edge.build_changes([], {"Y": [metric("R", 0.7)]}, NOW)) == ["DDEATH/X"]
    assert set(host.values) == {"", "Y"}
    assert parse_messages(host, edge.build_changes([], {"X": [metric("R", 0.5)], "Y": [metric("R", 0.7)]}, NOW)) == [
        "DBIRTH/X"
    ]
    assert host.values["X"] == {"R": 0.5}


def test_device_with_a_new_metric_is_born_again() -> None:
    edge, host = begun([], X=[metric("R", 0.5)])
    assert parse_messages(host, edge.build_changes([], {"X": [metric("R", 0.5), metric("load", 1.0)]}, NOW)) == [
        "DBIRTH/X"
    ]
    more = edge.build_changes([metric("program", "a.ngc", STRING)], {"X": [metric("R", 0.5), metric("load", 1.0)]}, NOW)
    assert parse_messages(host, more) == ["NBIRTH", "DBIRTH/X"]
    assert host.values == {"": {"program": "a.ngc"}, "X": {"R": 0.5, "load": 1.0}}


def test_each_connection_has_its_own_death_certificate() -> None:
    edge, host = begun([metric("state", "OFF", STRING)])
    first = edge.build_death(NOW)
    assert (first.topic, first.qos) == ("spBv1.0/works/NDEATH/mill", 1)
    assert decoded(edge.begin_connection(NOW).payload)[2][0].value(INT64) == 1
    parse_messages(host, edge.build_births([metric("state", "OFF", STRING)], {}, NOW))
    parse_messages(host, [first])  # the broker tells of the connection before only now
    assert host.alive
    parse_messages(host, [edge.build_death(NOW)])
    assert not host.alive


def test_requested_births_keep_the_number_of_the_connection() -> None:
    edge, host = begun([metric("state", "OFF", STRING)], X=[metric("R", 0.5)])
    before = host.bd_seq
    assert parse_messages(
        host, edge.build_births([metric("state", "OFF", STRING)], {"X": [metric("R", 0.5)]}, NOW)
    ) == [
        "NBIRTH",
        "DBIRTH/X",
    ]
    assert host.bd_seq == before


def test_sequence_numbers_wrap_at_256() -> None:
    edge, host = begun([])
    for k in range(600):
        parse_messages(host, edge.build_changes([], {"X": [metric("R", float(k))]}, NOW))
    assert host.values["X"] == {"R": 599.0}
    for _ in range(300):
        will = edge.begin_connection(NOW)
    assert decoded(will.payload)[2][0].value(INT64) == 300 % 256


@pytest.mark.parametrize(
    ("payload", "wanted"),
    [
        (command("Node Control/Rebirth", True), True),
        (command("Node Control/Rebirth", False), False),
        (command("Node Control/Reboot", True), False),
        (command("arm", True), False),
        (b"", False),
        (b"\xff\xff\xff", False),
        (b"arm", False),
    ],
)
def test_only_rebirth_is_a_command(payload: bytes, wanted: bool) -> None:
    assert is_rebirth_command(payload) is wanted


@given(st.text(st.characters()), st.floats(), st.integers(-(2**63), 2**63 - 1))
def test_any_value_is_decoded_or_null(text: str, number: float, count: int) -> None:
    result = [metric("text", text, STRING), metric("number", number), metric("count", count, INT64)]
    values = begun(result)[1].values[""]
    assert values["text"] == text.encode("utf-8", "replace").decode()
    assert values["number"] == (number if math.isfinite(number) else None)
    assert values["count"] == count


@given(st.binary(max_size=60))
def test_any_bytes_are_parsed_without_error(payload: bytes) -> None:
    assert is_rebirth_command(payload) in (True, False)
    assert parse_host_state(payload) is None or isinstance(parse_host_state(payload), HostState)


def test_primary_host_state_is_parsed() -> None:
    assert make_host_topic("scada") == "spBv1.0/STATE/scada"
    assert parse_host_state(b'{"online": true, "timestamp": 5}') == HostState(True, 5)
    assert parse_host_state(b'{"online": false, "timestamp": 6}') == HostState(False, 6)
    for none in (b"ONLINE", b"[]", b'{"online": 1, "timestamp": 5}', b'{"online": true}'):
        assert parse_host_state(none) is None
