"""Requests on the guard's socket, and the tables passed with them: a request, a table, or a refusal."""

from __future__ import annotations

import json

from fdhil.guard import correction_table
from fdhil.guard.guard_state import GuardRequest
from fdhil.guard.request_parsing import parse_line, parse_request
from tests.fuzz.input_assessment import Target
from tests.guard.simulated_bus import LIMITS, settings

SETTINGS = settings(token_sha256="0" * 64)
LAW = {"speed": [1, -2], "torque": [3], "pace": [1], "dry": 0}
SAID = [
    {"request": "arm", "id": 1, "token": "t", "program_digest": "p", "facts": {"model_fresh": True}},
    {"request": "feedforward", "laws": {"X": LAW, "Y": LAW}},
    {"request": "compared", "axes": {"X": "as commissioned"}, "touched": {"X": 1}},
    {"request": "status", "id": "a"},
    {"request": "table", "renew": True},
]
ROWS = {"X": [0, 1, 2, 3], "Y": [0, 0, 0, 0]}


def taste(data: bytes) -> None:
    document = parse_line(data)
    if document is not None:
        request = parse_request(document.get("request"), document, SETTINGS)
        assert type(request) is GuardRequest
        json.dumps(document.get("id"))
    try:
        loading = correction_table.begin_table(data, 1, ["X", "Y"], (LIMITS, LIMITS), None, 0)
        for _ in range(100):
            if loading.done:
                break
            loading.check_next_rows(64)
    except correction_table.TableRefused as refused:
        assert len(str(refused)) < 1000
        return
    for axis in loading.joined.offset:
        assert all(abs(value) <= LIMITS.offset for value in axis[: 6400 if not loading.done else None])


def target() -> Target:
    tables = [
        correction_table.encode_table(["X", "Y"], ROWS, ROWS, "p"),
        correction_table.encode_table(["X", "Y"], ROWS, ROWS, "p", final=False),
    ]
    lines = [json.dumps(document).encode() for document in SAID]
    words = [b'"axes"', b'"rows"', b'"first"', b'"final"', b'"program"', b'"laws"', b"NaN", b"1e400", b"null", b"true"]
    return Target("guard_socket", [*lines, *tables], taste, words)
