"""Records survive encoding and decoding; all other input is refused with a reason."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.fleet.message import Message, Record, Unread, decode, joined, of_entry, of_machine
from fdhil.store.outbox import Entry

STORE, DIGEST = "5" * 32, "a" * 64
ROW = {
    "id": 3,
    "axis": "X",
    "ft": 0.05,
    "covariance": "[[1.0, NaN], [0.0, 2.0]]",
    "temperature_c": math.inf,
    "wall_s": 1_800_000_000.25,
    "boot": "boot-1",
    "monotonic_ns": 5,
    "digest": DIGEST,
}


def entry(**changes: Any) -> Entry:
    given: dict[str, Any] = {"row": ROW, "left_out": "", "with_file": False}
    return Entry(number=7, kind="parameters", axis="X", message=DIGEST, **(given | changes))


def only(message: Message) -> Record:
    (record,) = decode(message.subject, message.payload)
    assert isinstance(record, Record)
    return record


def test_a_record_comes_back_as_it_was_and_no_number_is_null() -> None:
    message = of_entry(entry(), "mill-1", STORE, b"PAR1\n\x00window")
    assert message.subject == "fdhil.v1.mill-1.records"
    record = only(message)
    assert (record.machine, record.store, record.sequence, record.message) == ("mill-1", STORE, 7, DIGEST)
    assert (record.axis, record.kind, record.window) == ("X", "parameters", b"PAR1\n\x00window")
    assert record.recorded_at.isoformat() == "2027-01-15T08:00:00.250000+00:00"
    assert json.loads(record.text) == {
        "number": 3, "axis": "X", "ft": 0.05, "covariance": [[1.0, None], [0.0, 2.0]], "temperature_c": None,
    }  # fmt: skip


def test_what_is_left_out_is_told_and_is_the_same_each_time() -> None:
    first, again = (of_entry(entry(row={}, left_out="damaged"), "mill-1", STORE, None) for _ in range(2))
    assert first == again
    assert first.identity == again.identity != of_entry(entry(), "mill-1", STORE, None).identity
    record = only(first)
    assert (json.loads(record.text), record.recorded_at.year, record.window) == ({"left_out": "damaged"}, 1970, None)


def test_what_a_machine_is() -> None:
    message = of_machine({"labels": {"type": "V-800"}}, "mill-1", STORE, 1_800_000_000.0)
    record = only(message)
    assert (record.axis, record.kind, record.sequence) == ("", "about", 0)


WINDOWS = [None, b"PAR1\n\n{}\n", b"", None, b"\x00" * 300, None]


def several() -> list[Message]:
    return [
        of_entry(replace(entry(), number=number), "mill-1", STORE, window) for number, window in enumerate(WINDOWS, 1)
    ]


@pytest.mark.parametrize("most_bytes", [1, 400, 800, 1000, 10_000])
def test_records_that_go_together_come_apart_in_their_order(most_bytes: int) -> None:
    sent = list(joined(several(), most_bytes))
    assert all(count == 1 or len(message.payload) <= most_bytes for message, count in sent)
    records = [decode(message.subject, message.payload) for message, _ in sent]
    assert [len(told) for told in records] == [count for _, count in sent]
    told = [record for each in records for record in each if isinstance(record, Record)]
    assert [(record.sequence, record.window) for record in told] == list(enumerate(WINDOWS, 1))


def test_one_record_that_is_none_takes_no_other_with_it() -> None:
    parts = several()
    broken = parts[1].payload.replace(b'"ft": 0.05', b'"ft": "no"')
    payload = b"".join([parts[0].payload, broken, parts[2].payload])
    first, second, third = decode(parts[0].subject, payload)
    assert isinstance(first, Record)
    assert isinstance(third, Record)
    assert (first.sequence, second, third.sequence) == (1, Unread("its ft is not a number", broken), 3)


@pytest.mark.parametrize("part", [b"{}\n{}\n", b"nothing\n{}\n", b"\n", b"{"])
def test_behind_what_cannot_be_read_nothing_is_believed(part: bytes) -> None:
    good = several()[0]
    record, rest = decode(good.subject, good.payload + part + good.payload)
    assert isinstance(record, Record)
    assert isinstance(rest, Unread)
    assert rest.payload == part + good.payload


def test_every_cut_of_a_message_loses_what_is_cut_off_alone() -> None:
    parts = several()[:3]
    payload = b"".join(part.payload for part in parts)
    ends = [sum(len(part.payload) for part in parts[: k + 1]) for k in range(3)]
    for cut in range(1, len(payload)):
        told = decode(parts[0].subject, payload[:cut])
        assert sum(isinstance(each, Record) for each in told) == sum(end <= cut for end in ends)


NAMES = ("schema", "store", "axis", "kind", "message", "sequence", "recorded_s", "window_bytes")
LINES = of_entry(entry(), "mill-1", STORE, None).payload.splitlines()
HEAD = dict(zip(NAMES, LINES[0].decode().split(), strict=True))
GOOD: dict[str, Any] = HEAD | {"record": json.loads(LINES[1])}


def payload_of(told: Mapping[str, Any]) -> bytes:
    """Return a message with one record."""
    head = " ".join(str(told[name]) for name in NAMES)
    return f"{head}\n{json.dumps(told['record'])}\n".encode("utf-8", "surrogatepass")


def refused(payload: bytes, subject: str = "fdhil.v1.mill-1.records") -> str:
    """Return why the single part of a message is invalid."""
    (told,) = decode(subject, payload)
    assert isinstance(told, Unread)
    return told.reason


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"schema": "fdhil-record-2"}, "fdhil-record-1"),
        ({"store": "x"}, "header"),
        ({"message": ""}, "header"),
        ({"message": "a" * 63}, "header"),
        ({"axis": "XX"}, "header"),
        ({"axis": ""}, "header"),
        ({"kind": "Notice"}, "header"),
        ({"sequence": -1}, "header"),
        ({"sequence": 1 << 63}, "header"),
        ({"recorded_s": "now"}, "header"),
        ({"recorded_s": -1.0}, "header"),
        ({"recorded_s": 1e300}, "header"),
        ({"recorded_s": "10000000000.000000"}, "header"),
        ({"window_bytes": 1}, "truncated"),
        ({"window_bytes": -1}, "header"),
        ({"record": []}, "not a JSON object"),
        ({"record": {"text": "a\x00b"}}, "character"),
        ({"record": {"a\x00b": 1}}, "character"),
        ({"record": {"text": "\ud800"}}, "character"),
        ({"record": {"a": [[[[[[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]]]]]]}}, "deeper"),
    ],
)
def test_a_message_that_no_database_should_take(change: dict[str, Any], told: str) -> None:
    assert told in refused(payload_of(GOOD | change))


@pytest.mark.parametrize("text", [b'{"a": NaN}', b'{"a": 1', b"", b"\xff", b"[" * 100_000, b"9" * 5000])
def test_what_is_no_json(text: bytes) -> None:
    assert refused(text)
    assert refused(payload_of(HEAD | {"record": None}).replace(b"null", text))


@pytest.mark.parametrize("number", [b"1e999", b"-1E+309", b"1e0309", b"9" * 250 + b"e99", b"9" * 310 + b".0",
                                    b"1e-999", b"-0.001E-400", b"0." + 400 * b"0" + b"1"])  # fmt: skip
def test_a_number_beyond_all_bounds(number: bytes) -> None:
    text = payload_of(GOOD).replace(b"0.05", number)
    assert "out of range" in refused(text)


@pytest.mark.parametrize("number", [b"0e999", b"0." + 400 * b"0", b"1e99", b"5e-324", b"1e-0300"])
def test_a_number_that_a_float_holds(number: bytes) -> None:
    (told,) = decode("fdhil.v1.mill-1.records", payload_of(GOOD).replace(b"0.05", number))
    assert isinstance(told, Record)


@pytest.mark.parametrize("subject", ["", "fdhil.v1.mill 1.records", "fdhil.v1.m.X.records", "fdhil.v2.m.records"])
def test_a_foreign_subject(subject: str) -> None:
    assert "subject" in refused(payload_of(GOOD), subject)


@pytest.mark.parametrize(
    ("kind", "record"),
    [
        ("parameters", {"revision": "7"}),
        ("parameters", {"ft": "0.05"}),
        ("parameters", {"ft": True}),
        ("parameters", {"ft": 10**400}),
        ("window", {"accepted": 0.5}),
        ("window", {"fit_percent": []}),
        ("skill", {"rms_um": {}}),
        ("notice", {"number": "1"}),
        ("acknowledgement", {"notices": 3}),
        ("acknowledgement", {"notices": ["x"]}),
        ("about", {"labels": {"type": 1}}),
        ("about", {"axis_labels": {"X": "screw"}}),
        ("about", {"axis_labels": []}),
    ],
)
def test_a_record_that_would_break_the_views_of_all(kind: str, record: dict[str, Any]) -> None:
    assert refused(payload_of(GOOD | {"kind": kind, "record": record}))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(change=st.dictionaries(st.sampled_from(sorted(GOOD)), JSON, max_size=3), cut=st.integers(0, 400))
def test_anything_else_is_a_record_or_a_bad_message(change: dict[str, Any], cut: int) -> None:
    raw = payload_of(GOOD | change)
    for payload in (raw, raw[:cut], raw[:cut] + b"\n" + raw[cut:], raw + raw[cut:]):
        for told in decode("fdhil.v1.mill-1.records", payload):
            if isinstance(told, Record):
                json.dumps(json.loads(told.text), allow_nan=False, ensure_ascii=False).encode()
