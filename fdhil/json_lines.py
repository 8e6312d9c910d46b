"""JSON lines: one object a line, as the daemon, its clients and child processes exchange them."""

import json
from collections.abc import Mapping
from typing import Any


def encode_line(document: Mapping[str, Any]) -> bytes:
    """Return an object as one line."""
    return json.dumps(document).encode() + b"\n"


def decode_line(line: bytes | str) -> dict[str, Any] | None:
    """Return the object of a line, None where it is none: cut off, no JSON, nested too deeply, or another value.

    >>> decode_line(encode_line({"ok": True})), decode_line(b'{"ok"'), decode_line(b"[1]")
    ({'ok': True}, None, None)
    """
    try:
        document = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None
