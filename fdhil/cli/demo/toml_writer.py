"""TOML writer for nested tables of plain values."""

import json
from collections.abc import Mapping
from typing import Any


def format_toml(document: Mapping[str, Any], path: str = "") -> str:
    """Return a document of nested tables of plain values as TOML, with ``path`` as prefix of its tables."""
    plain = {key: value for key, value in document.items() if not isinstance(value, Mapping)}
    lines = [f"[{path}]"] if path and plain else []
    lines += [f"{key} = {json.dumps(value)}" for key, value in plain.items()]
    for key, value in document.items():
        if isinstance(value, Mapping):
            lines.append(format_toml(value, f"{path}.{key}" if path else key))
    return "\n".join(lines) + "\n"
