"""Changes values in the text of a configuration, line by line, so that all that a person wrote around them stays."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from fdhil.config.config_template import format_toml

_HEADER = re.compile(r"\s*(\[[^\[\]]+\])\s*(#.*)?\r?")
_NOTE = "# offer "


class NotEditable(ValueError):
    """The text is written in a way that is not edited by line."""


def edit_toml(text: str, values: Mapping[str, Any], note: str) -> str:
    """Return the text with these values, as ``axis.X.nominal.ft``, ``note`` above each; NotEditable.

    The result is parsed again, and must equal the former document with only these values changed.
    """
    wanted = tomllib.loads(text)
    end = "\r\n" if "\r\n" in text else "\n"
    lines = text.removesuffix("\n").removesuffix("\r").split("\n")
    lines = [line.removesuffix("\r") for line in lines]
    for path, value in values.items():
        *outer, key = path.split(".")
        _put(wanted, outer, key, value)
        _set(lines, outer, key, format_toml(value), note)
    out = end.join(lines) + end
    try:
        same = tomllib.loads(out) == wanted
    except ValueError:
        same = False
    if not same:
        raise NotEditable(f"it sets {', '.join(values)} in a form that cannot be edited; change them by hand")
    return out


def _put(document: dict[str, Any], outer: Sequence[str], key: str, value: Any) -> None:
    for name in outer:
        document = document.setdefault(name, {})
        if not isinstance(document, dict):
            raise NotEditable(f"its {name} is not a table; change it by hand")
    document[key] = list(value) if isinstance(value, tuple) else value


def _set(lines: list[str], outer: Sequence[str], key: str, value: str, note: str) -> None:
    first, last = _table(lines, outer)
    if first is None:
        lines += ["", f"[{'.'.join(outer)}]", f"{_NOTE}{note}", f"{key} = {value}"]
        return
    own = re.compile(rf"(\s*{re.escape(key)}\s*=\s*)(.*)")
    shown = re.compile(rf"#{re.escape(key)}\s*=")  # as the template has it: at its default
    present = next(((at, found) for at in range(first, last) if (found := own.fullmatch(lines[at]))), None)
    if present is not None:
        at, found = present
        lines[at] = found[1] + value + _behind(found[2])
    else:
        at = next((at + 1 for at in range(first, last) if shown.match(lines[at])), first)
        lines.insert(at, f"{key} = {value}")
    lines[at - 1 if lines[at - 1].startswith(_NOTE) else at : at] = [f"{_NOTE}{note}"]


def _table(lines: Sequence[str], outer: Sequence[str]) -> tuple[int | None, int]:
    headers = list(_headers(lines))
    for (at, names), (after, _) in zip(headers, [*headers[1:], (len(lines), ())], strict=False):
        if names == tuple(outer):
            return at + 1, after
    return None, len(lines)


def _headers(lines: Sequence[str]) -> Iterator[tuple[int, tuple[str, ...]]]:
    for at, line in enumerate(lines):
        found = _HEADER.fullmatch(line)
        if found is None:
            continue
        try:
            yield at, tuple(_names(tomllib.loads(found[1])))
        except ValueError:  # a line of an array that only looks like one
            continue


def _names(document: Mapping[str, Any]) -> Iterator[str]:
    while document:
        ((name, document),) = document.items()
        yield name


def _behind(rest: str) -> str:
    for found in re.finditer(r"\s*#", rest):
        try:
            tomllib.loads(f"v = {rest[: found.start()]}")
        except ValueError:
            continue
        return rest[found.start() :]
    return ""
