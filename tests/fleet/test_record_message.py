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

from fdhil.fleet.record_message import (
    Message,
    Record,
    UnreadableRecord,
    decode_message,
    encode_entry,
    encode_machine,
    join_messages,
)
from fdhil.store.outbox import OutboxEntry

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


def create_entry(**changes: Any) -> OutboxEntry:
    given: dict[str, Any] = {"row": ROW, "left_out": "", "with_file": False}
    return OutboxEntry(number=7, kind="parameters", axis="X", message=DIGEST, **(given | changes))


def decode_single(message: Message) -> Record:
    (record,) = decode_message(message.subject, message.payload)
    assert isinstance(record, Record)
    return record


def test_record_round_trips_and_nan_becomes_null() -> None:
    message = encode_entry(create_entry(), "mill-1", STORE, b"PAR1\n\x00window")
    assert message.subject == "fdhil.v1.mill-1.records"
    record = decode_single(message)
    assert (record.machine, record.store, record.sequence, record.message) == ("mill-1", STORE, 7, DIGEST)
    assert (record.axis, record.kind, record.window) == ("X", "parameters", b"PAR1\n\x00window")
    assert record.recorded_at.isoformat() == "2027-01-15T08:00:00.250000+00:00"
    assert json.loads(record.text) == {
        "number": 3, "axis": "X", "ft": 0.05, "covariance": [[1.0, None], [0.0, 2.0]], "temperature_c": None,
    }  # fmt: skip


def test_left_out_columns_are_reported_reproducibly() -> None:
    first, again = (encode_entry(create_entry(row={}, left_out="damaged"), "mill-1", STORE, None) for _ in range(2))
    assert first == again
    assert first.identity == again.identity != encode_entry(create_entry(), "mill-1", STORE, None).identity
    record = decode_single(first)
    assert (json.loads(record.text), record.recorded_at.year, record.window) == ({"left_out": "damaged"}, 1970, None)


def test_machine_description_round_trips() -> None:
    message = encode_machine({"labels": {"type": "V-800"}}, "mill-1", STORE, 1_800_000_000.0)
    record = decode_single(message)
    assert (record.axis, record.kind, record.sequence) == ("", "about", 0)


WINDOWS = [None, b"PAR1\n\n{}\n", b"", None, b"\x00" * 300, None]


def create_several() -> list[Message]:
    return [
        encode_entry(replace(create_entry(), number=number), "mill-1", STORE, window)
        for number, window in enumerate(WINDOWS, 1)
    ]


@pytest.mark.parametrize("most_bytes", [1, 400, 800, 1000, 10_000])
def test_joined_records_are_split_in_order(most_bytes: int) -> None:
    sent = list(join_messages(create_several(), most_bytes))
    assert all(count == 1 or len(message.payload) <= most_bytes for message, count in sent)
    records = [decode_message(message.subject, message.payload) for message, _ in sent]
    assert [len(told) for told in records] == [count for _, count in sent]
    reported = [record for each in records for record in each if isinstance(record, Record)]
    assert [(record.sequence, record.window) for record in reported] == list(enumerate(WINDOWS, 1))


def test_invalid_record_does_not_affect_others() -> None:
    parts = create_several()
    broken = parts[1].payload.replace(b'"ft": 0.05', b'"ft": "no"')
    payload = b"".join([parts[0].payload, broken, parts[2].payload])
    first, second, third = decode_message(parts[0].subject, payload)
    assert isinstance(first, Record)
    assert isinstance(third, Record)
    assert (first.sequence, second, third.sequence) == (1, UnreadableRecord("its ft is not a number", broken), 3)


@pytest.mark.parametrize("part", [b"{}\n{}\n", b"nothing\n{}\n", b"\n", b"{"])
def test_nothing_is_accepted_after_unreadable_header(part: bytes) -> None:
    good = create_several()[0]
    record, rest = decode_message(good.subject, good.payload + part + good.payload)
    assert isinstance(record, Record)
    assert isinstance(rest, UnreadableRecord)
    assert rest.payload == part + good.payload


def test_truncated_message_loses_only_truncated_records() -> None:
    parts = create_several()[:3]
    payload = b"".join(part.payload for part in parts)
    ends = [sum(len(part.payload) for part in parts[: k + 1]) for k in range(3)]
    for cut in range(1, len(payload)):
        reported = decode_message(parts[0].subject, payload[:cut])
        assert sum(isinstance(each, Record) for each in reported) == sum(end <= cut for end in ends)


NAMES = ("schema", "store", "axis", "kind", "message", "sequence", "recorded_s", "window_bytes")
LINES = encode_entry(create_entry(), "mill-1", STORE, None).payload.splitlines()
HEAD = dict(zip(NAMES, LINES[0].decode().split(), strict=True))
GOOD: dict[str, Any] = HEAD | {"record": json.loads(LINES[1])}


def build_payload(told: Mapping[str, Any]) -> bytes:
    """Return a message with one record."""
    head = " ".join(str(told[name]) for name in NAMES)
    return f"{head}\n{json.dumps(told['record'])}\n".encode("utf-8", "surrogatepass")


def read_refusal(payload: bytes, subject: str = "fdhil.v1.mill-1.records") -> str:
    """Return why the single part of a message is invalid."""
    (reported,) = decode_message(subject, payload)
    assert isinstance(reported, UnreadableRecord)
    return reported.reason


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
def test_invalid_message_is_refused(change: dict[str, Any], told: str) -> None:
    assert told in read_refusal(build_payload(GOOD | change))


@pytest.mark.parametrize("text", [b'{"a": NaN}', b'{"a": 1', b"", b"\xff", b"[" * 100_000, b"9" * 5000])
def test_invalid_json_is_refused(text: bytes) -> None:
    assert read_refusal(text)
    assert read_refusal(build_payload(HEAD | {"record": None}).replace(b"null", text))


@pytest.mark.parametrize("number", [b"1e999", b"-1E+309", b"1e0309", b"9" * 250 + b"e99", b"9" * 310 + b".0",
                                    b"1e-999", b"-0.001E-400", b"0." + 400 * b"0" + b"1"])  # fmt: skip
def test_number_out_of_range_is_refused(number: bytes) -> None:
    text = build_payload(GOOD).replace(b"0.05", number)
    assert "out of range" in read_refusal(text)


@pytest.mark.parametrize("number", [b"0e999", b"0." + 400 * b"0", b"1e99", b"5e-324", b"1e-0300"])
def test_number_within_float_range_is_accepted(number: bytes) -> None:
    (reported,) = decode_message("fdhil.v1.mill-1.records", build_payload(GOOD).replace(b"0.05", number))
    assert isinstance(reported, Record)


@pytest.mark.parametrize("subject", ["", "fdhil.v1.mill 1.records", "fdhil.v1.m.X.records", "fdhil.v2.m.records"])
def test_foreign_subject_is_refused(subject: str) -> None:
    assert "subject" in read_refusal(build_payload(GOOD), subject)


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
def test_record_that_breaks_views_is_refused(kind: str, record: dict[str, Any]) -> None:
    assert read_refusal(build_payload(GOOD | {"kind": kind, "record": record}))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(change=st.dictionaries(st.sampled_from(sorted(GOOD)), JSON, max_size=3), cut=st.integers(0, 400))
def test_arbitrary_bytes_are_records_or_refused(change: dict[str, Any], cut: int) -> None:
    raw = build_payload(GOOD | change)
    for payload in (raw, raw[:cut], raw[:cut] + b"\n" + raw[cut:], raw + raw[cut:]):
        for reported in decode_message("fdhil.v1.mill-1.records", payload):
            if isinstance(reported, Record):
                json.dumps(json.loads(reported.text), allow_nan=False, ensure_ascii=False).encode()
