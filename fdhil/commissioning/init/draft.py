"""A configuration that is being made: values with their sources, what is still missing, and remarks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from fdhil.commissioning.init.told import Told
from fdhil.config.reading import checked_value, field_at
from fdhil.errors import ConfigError, ConfigFault

OPERATOR = "asked: the operator's word"
ANSWERS = "from the answers"


@dataclass(frozen=True, slots=True)
class Asked:
    """A question to the operator: the key's path, what it means, where its value is found, and what is proposed.

    ``check`` returns the value of what was said; ConfigError with the reason where it is none.
    """

    path: str
    meaning: str
    where: str
    proposal: Told | None
    check: Check


Check = Callable[[str], Any]
Ask = Callable[[Asked], Any]
"""Return the operator's value; None: the proposal."""


@dataclass(slots=True)
class Draft:
    """``values`` by full path, as ``axis.X.nominal.R``; ``ask`` is None where nobody can be asked."""

    ask: Ask | None = None
    values: dict[str, Told] = field(default_factory=dict)
    missing: list[ConfigFault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def take(self, table: Mapping[str, Any], path: str = "") -> None:
        """Take the nested tables of an answers file, whose keys are the configuration's; what is wrong is missing."""
        for key, value in table.items():
            here = f"{path}.{key}" if path else key
            if isinstance(value, Mapping) and value:
                self.take(value, here)
            else:
                self._take(here, value)

    def _take(self, path: str, value: Any) -> None:
        if not isinstance(value, Mapping) and ".options." not in path:  # those are python-can's own
            try:
                value = checked_value(path, value)
            except ConfigError as error:
                self.missing += error.faults
        self.values[path] = Told(value, ANSWERS)

    def tell(self, path: str, told: Told) -> None:
        """Take what a device or a file tells; an answer stays, and where both differ that is noted."""
        known = self.values.get(path)
        if known is None or known.guessed:
            self.values[path] = told
        elif not told.guessed and known.source == ANSWERS and not _same(known.value, told.value):
            self.notes.append(f"{path}: the answers say {known.value}, {told.source.partition(':')[0]} {told.value}")

    def get(self, path: str) -> Any:
        """Return a value, None where it is not known."""
        told = self.values.get(path)
        return None if told is None else told.value

    def has_table(self, path: str) -> bool:
        """Whether a table, or any key in it, is there."""
        return path in self.values or any(key.startswith(f"{path}.") for key in self.values)

    def settle(self, path: str, where: str, proposal: Told | None = None, check: Check | None = None) -> None:
        """Have a value for a key: what is known, else the operator's, else a guess; without any it is missing."""
        proposal = self.values.get(path) or proposal
        if proposal is not None and not proposal.guessed:
            self.values[path] = proposal
            return
        meaning = field_at(path)
        words = meaning.description or "" if meaning is not None else ""
        if self.ask is not None:
            answer = self.ask(Asked(path, words, where, proposal, check or partial(checked_value, path)))
            proposal = proposal if answer is None else Told(answer, OPERATOR)
        if proposal is None:
            self.missing.append(ConfigFault(path, f"is not known: {words}", where))
        else:
            self.values[path] = proposal

    def ask_again(self, path: str, why: str) -> None:
        """Ask for a value that cannot be, and why it cannot; the old one is proposed, for another may be at fault."""
        self.values[path] = Told(self.get(path), "as it was", guessed=True)
        self.settle(path, f"it cannot be: {why}")

    @property
    def guessed(self) -> int:
        """How many values nobody told."""
        return sum(told.guessed for told in self.values.values())

    @property
    def document(self) -> dict[str, Any]:
        """The values as nested tables."""
        tables: dict[str, Any] = {}
        for path, told in self.values.items():
            *outer, key = path.split(".")
            table = tables
            for name in outer:
                table = table.setdefault(name, {})
            table[key] = told.value
        return tables


def _same(one: Any, other: Any) -> bool:
    numbers = isinstance(one, int | float) and isinstance(other, int | float)
    return abs(one - other) <= 1e-3 * abs(other) if numbers else bool(one == other)
