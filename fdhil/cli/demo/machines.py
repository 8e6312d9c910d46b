"""The demonstration's machines: the paper's plant, and the same with what real ones have."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PAPER, REAL = "machine.toml", "realistic.toml"


def machine_document(*more: str) -> dict[str, Any]:
    """Return the configuration of the demonstration's machine as a parsed file; ``more`` names what it has besides."""
    document: dict[str, Any] = {}
    for name in (PAPER, *more):
        merge(document, tomllib.loads(Path(__file__).with_name(name).read_text("utf-8")))
    return document


def merge(document: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Put what another file says into a document, table by table."""
    for key, value in more.items():
        if isinstance(value, Mapping):
            merge(document.setdefault(key, {}), value)
        else:
            document[key] = value
