"""Encodes and decodes messages: records of one machine's history, in the order in which they were recorded.

The subject, ``fdhil.v1.MACHINE.records``, names the machine: the server lets each publish under its own name alone.
Each record is a header line, a line of JSON with its row of the history, and optionally its recorded window. A record
carries the digest of its row, so that repeated records are recognised. Concatenated messages of one machine form a
message.

The header is ``fdhil-record-1 STORE AXIS KIND DIGEST SEQUENCE SECONDS BYTES``: the digest of the machine's history
file; the axis, or ``-``; the digest of the row; its number in the outbox; when it was recorded (UNIX); and the size of
the window, or ``-``.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

from pydantic_core import from_json

from fdhil.fleet import record_shapes
from fdhil.store import OutboxEntry

SCHEMA = "fdhil-record-1"
PREFIX = "fdhil.v1"
SUBJECTS = f"{PREFIX}.>"
ABOUT = "about"
OFFER = "offer"
LARGEST_RECORD = 1 << 20  # bytes of JSON
MOST_DEPTH = 20  # of nested lists
_SUBJECT = re.compile(r"fdhil\.v1\.([A-Za-z0-9_-]{1,64})\.records")
_HEAD = re.compile(
    rb"fdhil-record-1 ([0-9a-f]{32}) ([A-Z]2?|-) ([a-z]{1,20}) ([0-9a-f]{64}) (\d{1,18}) (\d{1,10}\.\d{6})"
    rb" (\d{1,9}|-)\n"
)
MANY_DIGITS = 100 * b"0"
LARGEST_NUMBER = 1e100  # numbers are squared in evaluations
_ONLY_DIGITS = bytes.maketrans(b"123456789E-", b"000000000e+")
_JSON_COLUMNS = {"reasons", "parameters", "covariance", "window_ids", "terms", "warnings", "friction", "nc", "gains",
                 "notices", "loops"}  # fmt: skip
_NOT_SENT = {"id", "digest", "wall_s", "boot", "monotonic_ns", "told"}


class BadMessage(ValueError):
    """A record that is damaged or of another format; it is stored as refused."""


@dataclass(frozen=True, slots=True)
class Message:
    """A message to publish: some records of one machine."""

    subject: str
    payload: bytes

    @property
    def identity(self) -> str:
        """The id by which the server recognises a repeated message."""
        return f"{self.subject}:{hashlib.sha256(self.payload).hexdigest()}"


class Record(NamedTuple):  # thousands are created per second, and this is the fastest type
    """A decoded record; ``text`` is its JSON, one object, ``payload`` its original bytes."""

    machine: str
    store: str
    sequence: int
    message: str
    axis: str
    kind: str
    recorded_at: datetime
    text: str
    window: bytes | None
    payload: bytes

    @property
    def window_name(self) -> str | None:
        """The name of its window file: the SHA-256 of the content."""
        return None if self.window is None else hashlib.sha256(self.window).hexdigest()


@dataclass(frozen=True, slots=True)
class UnreadableRecord:
    """A part of a message that is not a valid record, and why."""

    reason: str
    payload: bytes


def encode_entry(entry: OutboxEntry, machine: str, store: str, window: bytes | None) -> Message:
    """Return the message of an outbox entry; an entry whose row was deleted is dated 1970."""
    record = {name: _encode_column(name, value) for name, value in entry.row.items() if name not in _NOT_SENT}
    if "id" in entry.row:
        record["number"] = str(entry.row["id"])
    if entry.left_out:
        record["left_out"] = json.dumps(entry.left_out)
    text = "{" + ", ".join(f'"{name}": {value}' for name, value in record.items()) + "}"
    recorded_s = entry.row.get("wall_s", 0.0)
    head = f"{store} {entry.axis or '-'} {entry.kind} {entry.message} {entry.number} {recorded_s:.6f}"
    return _build_message(machine, head, text, window)


def encode_machine(about: Mapping[str, Any], machine: str, store: str, wall_s: float) -> Message:
    """Return the message that describes a machine."""
    head = f"{store} - {ABOUT} {compute_digest(about, wall_s)} 0 {wall_s:.6f}"
    return _build_message(machine, head, json.dumps(about), None)


def join_messages(messages: Iterable[Message], most_bytes: int) -> Iterator[tuple[Message, int]]:
    """Yield messages of one machine joined up to ``most_bytes``, each with the number of messages in it."""
    parts: list[Message] = []
    size = 0
    for message in messages:
        if parts and size + len(message.payload) > most_bytes:
            yield _concatenate_payloads(parts), len(parts)
            parts, size = [], 0
        parts.append(message)
        size += len(message.payload)
    if parts:
        yield _concatenate_payloads(parts), len(parts)


def _concatenate_payloads(parts: list[Message]) -> Message:
    return Message(parts[0].subject, b"".join(part.payload for part in parts))


def encode_answer(answer: Mapping[str, Any], machine: str, store: str) -> Message:
    """Return the message that reports an operator's answer to an offer."""
    head = f"{store} - {OFFER} {compute_digest(answer)} 0 {answer['at_s']:.6f}"
    return _build_message(machine, head, json.dumps(answer), None)


def compute_digest(*what: Any) -> str:
    """Return the SHA-256 of JSON data."""
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


def _build_message(machine: str, head: str, text: str, window: bytes | None) -> Message:
    lines = f"{SCHEMA} {head} {'-' if window is None else len(window)}\n{text}\n".encode()
    return Message(f"{PREFIX}.{machine}.records", lines if window is None else lines + window)


def _encode_column(name: str, value: Any) -> str:
    """Return a column's value as JSON; NaN and infinity become null."""
    if name in _JSON_COLUMNS and isinstance(value, str):
        if "NaN" not in value and "Infinity" not in value:
            return value
        value = json.loads(value)
    return json.dumps(_replace_non_finite(value))


def _replace_non_finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _replace_non_finite(each) for key, each in value.items()}
    return [_replace_non_finite(each) for each in value] if isinstance(value, list) else value


def decode_message(subject: str, payload: bytes) -> list[Record | UnreadableRecord]:
    """Return the valid records of a message, checked so that the database accepts them, and its invalid parts."""
    found = _SUBJECT.fullmatch(subject)
    if found is None:
        return [UnreadableRecord("its subject is not that of a machine's records", payload)]
    parts: list[Record | UnreadableRecord] = []
    at = 0
    while at < len(payload) or not parts:
        try:
            head, line, end = _find_record(payload, at)
        except BadMessage as error:  # the start of the next record is unknown
            return [*parts, UnreadableRecord(str(error), payload[at:])]
        try:
            parts.append(
                _decode_record(found[1], head, payload[head.end() : line], payload[line + 1 : end], payload[at:end])
            )
        except BadMessage as error:
            parts.append(UnreadableRecord(str(error), payload[at:end]))
        at = end
    return parts


def _find_record(payload: bytes, at: int) -> tuple[re.Match[bytes], int, int]:
    """Return the header match of the record at ``at``, and where its JSON line and the record end."""
    head = _HEAD.match(payload, at)
    if head is None:
        raise BadMessage(f"it has no {SCHEMA} header")
    line = payload.find(b"\n", head.end())
    if line < 0:
        raise BadMessage("it is truncated")
    if line - at > LARGEST_RECORD:
        raise BadMessage(f"its record is larger than {LARGEST_RECORD >> 10} KiB")
    end = line + 1 + (0 if head[7] == b"-" else int(head[7]))
    if end > len(payload):
        raise BadMessage("its window is truncated")
    return head, line, end


def _decode_record(machine: str, head: re.Match[bytes], line: bytes, window: bytes, payload: bytes) -> Record:
    store, axis, kind, message, sequence, recorded_s, window_bytes = head.groups()
    kind = kind.decode()
    try:
        record = from_json(line, allow_inf_nan=False)
    except ValueError:
        record = _parse_json(line)  # the second parser decides, and explains the fault
    if not isinstance(record, dict):
        raise BadMessage("its record is not a JSON object")
    if b"\\" in line or line.count(b"[") + line.count(b"{") > MOST_DEPTH:  # otherwise nothing can be nested too deep
        _check_nesting(_parse_json(line), MOST_DEPTH)
    digits = line.translate(_ONLY_DIGITS)
    if (
        b"e+000" in digits or b"e000" in digits or MANY_DIGITS in digits
    ):  # a number beyond the range of a float has this form
        _NUMBERS.decode(line.decode())
    if fault := record_shapes.find_fault(kind, record):
        raise BadMessage(fault)
    recorded_at = datetime.fromtimestamp(float(recorded_s), UTC)
    return Record(
        machine, store.decode(), int(sequence), message.decode(), "" if axis == b"-" else axis.decode(), kind,
        recorded_at, line.decode(), None if window_bytes == b"-" else window, payload,
    )  # fmt: skip


def _parse_json(line: bytes) -> Any:
    try:
        return _DECODER.decode(line.decode())
    except BadMessage:
        raise
    except (ValueError, RecursionError):
        raise BadMessage("it is not valid JSON") from None


def _reject_constant(name: str) -> None:
    raise BadMessage(f"it contains {name}")


def _parse_bounded_number(number: str) -> float:
    """Return a number within bounds; PostgreSQL rejects a nonzero number that underflows."""
    value = float(number)
    if not abs(value) < LARGEST_NUMBER or (value == 0.0 and _IS_SOMETHING.match(number)):
        raise BadMessage("it contains a number out of range")
    return value


_IS_SOMETHING = re.compile(r"-?[0.]*[1-9]")
_DECODER = json.JSONDecoder(parse_constant=_reject_constant)
_NUMBERS = json.JSONDecoder(
    parse_constant=_reject_constant, parse_float=_parse_bounded_number, parse_int=_parse_bounded_number
)


def _check_nesting(value: Any, depth: int) -> None:
    if depth == 0:
        raise BadMessage(f"it is nested deeper than {MOST_DEPTH}")
    if isinstance(value, dict):
        for key, each in value.items():
            _check_nesting(key, depth - 1)
            _check_nesting(each, depth - 1)
    elif isinstance(value, list):
        for each in value:
            _check_nesting(each, depth - 1)
    elif isinstance(value, str) and ("\x00" in value or any("\ud800" <= letter <= "\udfff" for letter in value)):
        raise BadMessage("it contains a character that the database rejects")
