"""Machines of the demonstration: that of the paper, and one with realistic imperfections."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PAPER, REAL = "machine.toml", "realistic.toml"


def load_machine_document(*more: str) -> dict[str, Any]:
    """Return the machine configuration as a parsed file, with the files ``more`` merged into it."""
    document: dict[str, Any] = {}
    for name in (PAPER, *more):
        merge_tables(document, tomllib.loads(Path(__file__).with_name(name).read_text("utf-8")))
    return document


def merge_tables(document: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Merge another document into ``document``, table by table."""
    for key, value in more.items():
        if isinstance(value, Mapping):
            merge_tables(document.setdefault(key, {}), value)
        else:
            document[key] = value
