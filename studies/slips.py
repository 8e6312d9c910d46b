"""One wrong character in a configuration: a reader never takes it for the content of another line.

A character of the file is left out, doubled with another, or replaced. What is read then either means the same, or is
refused with its line or key; else the very value that was mistyped is another one that a machine may have, or a key
that may be left out is not there any more. Nothing else may change.
"""

from __future__ import annotations

import random
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from fdhil import config
from fdhil.errors import ConfigError

ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "configs" / "sim.toml"
TYPED = ("0", "1", "9", ".", ",", "-", "e", "n", "X", "_", " ", '"', "'", "#", "=", "[", "]", "\n", "\0", "µ")
OUTCOMES = {
    "same": "means the same",
    "refused": "refused, with line or key",
    "value": "another value of the key that was mistyped",
    "absent": "the key that was mistyped is left out, or another optional one",
    "unplaced": "refused without line or key",
    "elsewhere": "another key changed",
}
WRONG = ("unplaced", "elsewhere")
Leaves = Mapping[str, Any]


def generate_slips(text: str) -> Iterator[tuple[int, str]]:
    """Yield the place and the text of every slip of one character."""
    for at, right in enumerate(text):
        yield at, text[:at] + text[at + 1 :]
        for wrong in TYPED:
            yield at, text[:at] + wrong + text[at:]
            if wrong != right:
                yield at, text[:at] + wrong + text[at + 1 :]


def sample_slips(text: str, count: int, seed: int) -> list[tuple[int, str]]:
    """Return some of them."""
    return random.Random(seed).sample(list(generate_slips(text)), count)


def flatten_tables(document: Any, path: str = "") -> dict[str, Any]:
    """Return the values of nested tables by their path."""
    if not isinstance(document, Mapping):
        return {path: document}
    return {
        key: value for name, inner in document.items() for key, value in flatten_tables(inner, f"{path}.{name}").items()
    }


class Reader:
    """Judges slips of one text."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._told, self._true = self._read(text)

    @staticmethod
    def _read(text: str) -> tuple[Leaves, Leaves]:
        """Return the parsed text, and the configuration made of it."""
        raw = config.parse_toml(text.encode("utf-8"), SAMPLE.name)
        return flatten_tables(raw), flatten_tables(config.parse_config(raw, SAMPLE.name).model_dump(mode="json"))

    def classify_slip(self, at: int, text: str) -> str:
        """Return the outcome of a slip at a position, one of ``OUTCOMES``."""
        lines = self._text.splitlines()
        number = self._text.count("\n", 0, at)
        words = {*_list_keys(lines[number]), *_list_keys(text.splitlines()[min(number, text.count(chr(10)))])}
        around = {word for line in lines[max(0, number - 1) : number + 2] for word in _list_keys(line)} | words
        try:
            reported, found = self._read(text)
        except ConfigError as error:
            message = str(error)
            placed = any(word in message for word in around) or _describe_line(message) in range(number, number + 4)
            return "refused" if placed or "at end of document" in message else "unplaced"
        changed = {path for path in {*found, *self._true} if found.get(path) != self._true.get(path)}
        if not changed:
            return "same"
        if all({*path.split(".")} & words for path in changed):
            return "absent" if {*self._told} - {*reported} else "value"
        section = _find_section(lines, number)
        return "absent" if all(section in path for path in changed) else "elsewhere"


def _list_keys(line: str) -> set[str]:
    """Return the words of a line that a key or a table's name may be made of."""
    return {word for word in re.findall(r"\w+", line.partition("#")[0], re.ASCII) if not word.isdigit()} or {"\0"}


def _find_section(lines: list[str], number: int) -> str:
    heads = [line for line in lines[: number + 1] if line.startswith("[")]
    return "." + heads[-1].partition("]")[0][1:] if heads else "\0"


def _describe_line(told: str) -> int:
    found = re.search(r"at line (\d+)", told)
    return int(found[1]) if found else -1


def count_outcomes(
    chosen: Iterator[tuple[int, str]] | list[tuple[int, str]], text: str
) -> tuple[Counter[str], list[str]]:
    """Count the outcomes of slips, and list those that must not occur."""
    reader, counts, wrong = Reader(text), Counter[str](), []
    for at, slipped in chosen:
        outcome = reader.classify_slip(at, slipped)
        counts[outcome] += 1
        if outcome in WRONG:
            number = text.count("\n", 0, at)
            wrong.append(f"{outcome}: {slipped.splitlines()[number]!r}")
    return counts, wrong
