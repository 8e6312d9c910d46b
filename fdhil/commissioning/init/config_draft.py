"""A configuration in the making: values with their sources, missing values, and remarks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from fdhil.commissioning.init.sourced_value import SourcedValue
from fdhil.config import check_value, find_field
from fdhil.errors import ConfigError, ConfigFault

OPERATOR = "entered by the operator"
ANSWERS = "from the answers"


@dataclass(frozen=True, slots=True)
class OperatorQuestion:
    """A question to the operator: the key's path, its meaning, where to find the value, and the proposed value.

    ``check`` returns the value of an answer; ConfigError with the reason if the answer is invalid.
    """

    path: str
    meaning: str
    where: str
    proposal: SourcedValue | None
    check: Check


Check = Callable[[str], Any]
Ask = Callable[[OperatorQuestion], Any]
"""Returns the operator's value; None accepts the proposal."""


@dataclass(slots=True)
class ConfigDraft:
    """``values`` by full path, for example ``axis.X.nominal.R``; ``ask`` is None without an operator to ask."""

    ask: Ask | None = None
    values: dict[str, SourcedValue] = field(default_factory=dict)
    missing: list[ConfigFault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add_answers(self, table: Mapping[str, Any], path: str = "") -> None:
        """Add the nested tables of an answers file with configuration keys; invalid values are listed as missing."""
        for key, value in table.items():
            here = f"{path}.{key}" if path else key
            if isinstance(value, Mapping) and value:
                self.add_answers(value, here)
            else:
                self._add_answer(here, value)

    def _add_answer(self, path: str, value: Any) -> None:
        if not isinstance(value, Mapping) and ".options." not in path:  # python-can checks its own options
            try:
                value = check_value(path, value)
            except ConfigError as error:
                self.missing += error.faults
        self.values[path] = SourcedValue(value, ANSWERS)

    def add_source_value(self, path: str, reported: SourcedValue) -> None:
        """Add a value reported by a device or file; an answer takes precedence, and a contradiction is noted."""
        known = self.values.get(path)
        if known is None or known.guessed:
            self.values[path] = reported
        elif not reported.guessed and known.source == ANSWERS and not _is_same_value(known.value, reported.value):
            source = reported.source.partition(":")[0]
            self.notes.append(f"{path}: the answers have {known.value}, {source} has {reported.value}")

    def get_value(self, path: str) -> Any:
        """Return a value; None if it is unknown."""
        found = self.values.get(path)
        return None if found is None else found.value

    def has_table(self, path: str) -> bool:
        """Return whether a table, or any key in it, has a value."""
        return path in self.values or any(key.startswith(f"{path}.") for key in self.values)

    def settle_value(
        self, path: str, where: str, proposal: SourcedValue | None = None, check: Check | None = None
    ) -> None:
        """Fix the value of a key: the known one, else the operator's, else a guess; without any it is missing."""
        proposal = self.values.get(path) or proposal
        if proposal is not None and not proposal.guessed:
            self.values[path] = proposal
            return
        key = find_field(path)
        meaning = key.description or "" if key is not None else ""
        if self.ask is not None:
            answer = self.ask(OperatorQuestion(path, meaning, where, proposal, check or partial(check_value, path)))
            proposal = proposal if answer is None else SourcedValue(answer, OPERATOR)
        if proposal is None:
            self.missing.append(ConfigFault(path, f"is unknown: {meaning}", where))
        else:
            self.values[path] = proposal

    def ask_again(self, path: str, why: str) -> None:
        """Ask for an invalid value again, with the reason; the old value is proposed, for another one may be wrong."""
        self.values[path] = SourcedValue(self.get_value(path), "unchanged", guessed=True)
        self.settle_value(path, f"invalid: {why}")

    @property
    def guessed_count(self) -> int:
        """Number of guessed values."""
        return sum(value.guessed for value in self.values.values())

    @property
    def document(self) -> dict[str, Any]:
        """The values as nested tables."""
        tables: dict[str, Any] = {}
        for path, sourced in self.values.items():
            *outer, key = path.split(".")
            table = tables
            for name in outer:
                table = table.setdefault(name, {})
            table[key] = sourced.value
        return tables


def _is_same_value(one: Any, other: Any) -> bool:
    numbers = isinstance(one, int | float) and isinstance(other, int | float)
    return abs(one - other) <= 1e-3 * abs(other) if numbers else bool(one == other)
