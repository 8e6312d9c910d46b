"""Parses a request into the record that the core decides on; an invalid one becomes a record that is refused.

No input raises an exception here.
"""

import hashlib
import hmac
import json
from collections.abc import Mapping
from typing import Any

from fdhil.guard.feedforward import Law
from fdhil.guard.settings import Settings, refuse_constant
from fdhil.guard.state import Request

Document = dict[str, Any]
MOST_WEIGHTS = 64
MOST_WEIGHT = 1 << 48
MOST_CHARACTERS = 200


def parse_line(line: bytes) -> Document | None:
    """Return the JSON object of a line, None when it is invalid; ``id`` is kept only where it can be returned."""
    try:
        document = json.loads(line, parse_constant=refuse_constant)
    except (ValueError, RecursionError):
        return None
    if not isinstance(document, dict):
        return None
    mark = document.get("id")
    if not (type(mark) is int and abs(mark) < 1 << 53) and not (isinstance(mark, str) and len(mark) <= MOST_CHARACTERS):
        document.pop("id", None)
    return document


def parse_request(kind: Any, document: Mapping[str, Any], settings: Settings) -> Request:
    """Return the request; the token is compared by its hash alone."""
    facts = document.get("facts")
    digest = hashlib.sha256(_text(document, "token").encode("utf-8", "surrogatepass")).hexdigest()
    valid = bool(settings.token_sha256) and hmac.compare_digest(digest, settings.token_sha256)
    facts = facts if isinstance(facts, dict) else {}
    laws, program = _laws(document.get("laws"), settings), _text(document, "program_digest")
    compared, touched = _compared(document.get("axes"), settings), _touched(document.get("touched"), settings)
    return Request(kind, valid, program, facts, laws, compared, touched)


def _text(document: Mapping[str, Any], key: str) -> str:
    """Return the text of a key, empty when it is missing, not a text or too long."""
    value = document.get(key)
    return value if isinstance(value, str) and len(value) <= MOST_CHARACTERS else ""


def _compared(given: object, settings: Settings) -> dict[str, str]:
    found = given if isinstance(given, dict) else {}
    return {axis.name: _text(found, axis.name) for axis in settings.axes if axis.name in found}


def _touched(given: object, settings: Settings) -> dict[str, int]:
    found = given if isinstance(given, dict) else {}
    return {axis.name: found[axis.name] for axis in settings.axes if type(found.get(axis.name)) is int}


def _laws(given: object, settings: Settings) -> tuple[Law, ...]:
    """Return the feed-forward law of every axis, in the guard's order; empty when one is missing or invalid."""
    laws = [parse_law(given.get(axis.name)) for axis in settings.axes] if isinstance(given, dict) else []
    return tuple([law for law in laws if law is not None]) if None not in laws else ()


def parse_law(document: object) -> Law | None:
    """Return the law of a request, None when it is invalid."""
    if not isinstance(document, Mapping):
        return None
    parts: list[tuple[int, ...]] = []
    for key in ("speed", "torque", "pace"):
        weights = document.get(key)
        if not isinstance(weights, list) or not 0 < len(weights) <= MOST_WEIGHTS or not all(map(_fits, weights)):
            return None
        parts.append(tuple(weights))
    dry = document.get("dry")
    return Law(parts[0], parts[1], parts[2], dry) if _fits(dry) and isinstance(dry, int) else None


def _fits(value: Any) -> bool:
    return type(value) is int and abs(value) <= MOST_WEIGHT
