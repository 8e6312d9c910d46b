"""Encodes and decodes JSON lines, one object per line: the format of daemon, clients and child processes."""

import json
from collections.abc import Mapping
from typing import Any


def encode_line(document: Mapping[str, Any]) -> bytes:
    """Encode an object as one line."""
    return json.dumps(document).encode() + b"\n"


def decode_line(line: bytes | str) -> dict[str, Any] | None:
    """Decode the object of a line; None when it is truncated, invalid, nested too deeply, or not an object.

    >>> decode_line(encode_line({"ok": True})), decode_line(b'{"ok"'), decode_line(b"[1]")
    ({'ok': True}, None, None)
    """
    try:
        document = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None
