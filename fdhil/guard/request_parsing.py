"""Parses a request into the record that the core decides on; an invalid one becomes a record that is refused.

No input raises an exception here.
"""

import hashlib
import hmac
import json
from collections.abc import Mapping
from typing import Any

from fdhil.guard.feedforward_law import Law
from fdhil.guard.guard_settings import GuardSettings, refuse_constant
from fdhil.guard.guard_state import GuardRequest

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


def parse_request(kind: Any, document: Mapping[str, Any], settings: GuardSettings) -> GuardRequest:
    """Return the request; the token is compared by its hash alone."""
    facts = document.get("facts")
    digest = hashlib.sha256(_read_text(document, "token").encode("utf-8", "surrogatepass")).hexdigest()
    valid = bool(settings.token_sha256) and hmac.compare_digest(digest, settings.token_sha256)
    facts = facts if isinstance(facts, dict) else {}
    laws, program = _read_feedforward_laws(document.get("laws"), settings), _read_text(document, "program_digest")
    compared, touched = (
        _read_compared_fingerprints(document.get("axes"), settings),
        _read_touch_counts(document.get("touched"), settings),
    )
    return GuardRequest(kind, valid, program, facts, laws, compared, touched)


def _read_text(document: Mapping[str, Any], key: str) -> str:
    """Return the text of a key, empty when it is missing, not a text or too long."""
    value = document.get(key)
    return value if isinstance(value, str) and len(value) <= MOST_CHARACTERS else ""


def _read_compared_fingerprints(given: object, settings: GuardSettings) -> dict[str, str]:
    found = given if isinstance(given, dict) else {}
    return {axis.name: _read_text(found, axis.name) for axis in settings.axes if axis.name in found}


def _read_touch_counts(given: object, settings: GuardSettings) -> dict[str, int]:
    found = given if isinstance(given, dict) else {}
    return {axis.name: found[axis.name] for axis in settings.axes if type(found.get(axis.name)) is int}


def _read_feedforward_laws(given: object, settings: GuardSettings) -> tuple[Law, ...]:
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
        if (
            not isinstance(weights, list)
            or not 0 < len(weights) <= MOST_WEIGHTS
            or not all(map(_is_weight_valid, weights))
        ):
            return None
        parts.append(tuple(weights))
    dry = document.get("dry")
    return Law(parts[0], parts[1], parts[2], dry) if _is_weight_valid(dry) and isinstance(dry, int) else None


def _is_weight_valid(value: Any) -> bool:
    return type(value) is int and abs(value) <= MOST_WEIGHT
