"""Any bytes of clients parse into a request, or into a harmless refusal."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.guard.guard_state import GuardRequest
from fdhil.guard.request_parsing import parse_line, parse_request
from tests.guard.simulated_bus import settings

DEEP = b"[" * 100_000


@pytest.mark.parametrize(
    "line", [b"", b"\xff", b"{", b"[]", b"1", b'"status"', b"null", b'{"request": NaN}', b'{"a": Infinity}', DEEP]
)
def test_invalid_line_is_not_a_request(line: bytes) -> None:
    assert parse_line(line) is None


@pytest.mark.parametrize(
    ("mark", "kept"), [(1, True), ("a", True), (True, False), (1 << 60, False), ("a" * 999, False)]
)
def test_only_a_short_id_is_returned(mark: object, kept: bool) -> None:
    document = parse_line(json.dumps({"request": "status", "id": mark}).encode())
    assert document == {"request": "status", **({"id": mark} if kept else {})}


def test_touch_count_is_a_number_or_unknown() -> None:
    for output, touched in (({"X": 2, "Y": 0}, {"X": 2, "Y": 0}), ({"X": True, "Y": "0", "Z": 1}, {}), ([1], {})):
        assert parse_request("compared", {"touched": output}, settings()).touched == touched


@given(st.binary(max_size=200) | st.from_type(dict).map(lambda found: json.dumps(found, default=str).encode()))
def test_any_bytes_parse_without_error(line: bytes) -> None:
    document = parse_line(line)
    assert document is None or isinstance(parse_request("arm", document, settings()), GuardRequest)
    assert document is None or not parse_request("arm", document, settings()).token_valid
