"""Parses the text of LinuxCNC's INI and HAL files, as its documentation describes them ("INI Configuration", "HAL").

Pure: text in, tables out. Of HAL only what tells the scale of a joint and the loops around it is kept: the parameters
that are set and the pins that each signal joins.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

_SUBSTITUTE = re.compile(r"\[(\w+)\]\(?(\w+)\)?")
_HAL_ARROWS = frozenset({"=>", "<=", "<=>"})

Read = Callable[[str], str]
"""Return the text of a file that another one names; OSError or ValueError where it cannot be read."""


@dataclass(frozen=True, slots=True)
class Ini:
    """Sections of keys, in the order of the file; a key may come several times."""

    sections: Mapping[str, Mapping[str, tuple[str, ...]]]

    def all(self, section: str, key: str) -> tuple[str, ...]:
        """Return every value of a key; empty where there is none."""
        return self.sections.get(section, {}).get(key, ())

    def text(self, section: str, key: str) -> str:
        """Return a key's first value, as LinuxCNC takes it; empty where there is none."""
        return next(iter(self.all(section, key)), "")

    def number(self, section: str, key: str) -> float | None:
        """Return a key's first word as a finite number, None where it is none."""
        return finite(self.text(section, key))


def finite(text: str) -> float | None:
    """Return the first word of a text as a finite number, None where it is none.

    >>> finite("20.0  # mm"), finite("fast"), finite("nan")
    (20.0, None, None)
    """
    try:
        value = float(text.split()[0])
    except (ValueError, IndexError):
        return None
    return value if abs(value) < float("inf") else None


def parse_ini(text: str, read: Read) -> Ini:
    """Parse an INI file and those that it includes (``#INCLUDE file``); what is no section and no key is left out."""
    sections: dict[str, dict[str, tuple[str, ...]]] = {}
    current: dict[str, tuple[str, ...]] = {}
    for line in _included(text, read):
        line = line.strip()
        if line.startswith("[") and "]" in line:
            current = sections.setdefault(line[1 : line.index("]")].strip(), {})
        elif "=" in line and line[0] not in "#;":
            key, _, value = line.partition("=")
            current[key.strip()] = (*current.get(key.strip(), ()), value.strip())
    return Ini(sections)


def _included(text: str, read: Read, depth: int = 0) -> Iterator[str]:
    for line in _joined(text):
        words = line.split()
        if len(words) > 1 and words[0] == "#INCLUDE":
            if depth > 8:
                raise ValueError("files include each other without end")
            yield from _included(read(words[1]), read, depth + 1)
        else:
            yield line


def _joined(text: str) -> Iterator[str]:
    """Yield lines; one that ends with a backslash goes on in the next."""
    yield from re.sub(r"\\[ \t]*\r?\n", " ", text).splitlines()


@dataclass(slots=True)
class Hal:
    """Parameters that are set, and the pins that each signal joins."""

    given: dict[str, str] = field(default_factory=dict)
    nets: dict[str, set[str]] = field(default_factory=dict)

    def joined(self, pin: str) -> list[str]:
        """Return the other pins on a pin's signal, in alphabetical order."""
        return sorted(other for pins in self.nets.values() if pin in pins for other in pins - {pin})

    def around(self, pin: str) -> list[str]:
        """Return the components (with their instance) whose pins are on a pin's signal."""
        return list(dict.fromkeys(other.rpartition(".")[0] for other in self.joined(pin)))


def parse_hal(text: str, ini: Ini, read: Read, hal: Hal, depth: int = 0) -> None:
    """Add the commands of a HAL file, and of those that it sources, to ``hal``; unknown commands are left out."""
    for line in _joined(text):
        words = _substituted(line, ini).split()
        words = words[: next((k for k, word in enumerate(words) if word.startswith("#")), len(words))]
        match words:
            case ["setp", pin, value, *_]:
                hal.given[pin] = value
            case [pin, "=", value, *_]:
                hal.given[pin] = value
            case ["net" | "linksp", signal, *pins]:
                hal.nets.setdefault(signal, set()).update(pin for pin in pins if pin not in _HAL_ARROWS)
            case ["linkps", pin, *rest] if signals := [word for word in rest if word not in _HAL_ARROWS]:
                hal.nets.setdefault(signals[0], set()).add(pin)
            case ["source", name] if depth < 8:
                parse_hal(read(name), ini, read, hal, depth + 1)


def _substituted(line: str, ini: Ini) -> str:
    """Put the INI's values in place of ``[SECTION]KEY``; one that is not there stays as it is."""
    return _SUBSTITUTE.sub(lambda found: ini.text(found[1], found[2]) or found[0], line)
