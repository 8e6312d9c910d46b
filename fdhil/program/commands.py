"""Parse O-words: a label, a keyword, and the values in brackets after it."""

from __future__ import annotations

import re

from fdhil.errors import ProgramError
from fdhil.program.expressions import Reader, Value, now, whole
from fdhil.program.parameters import Variables

_KEYWORD = re.compile(r"endsub|sub|call|return|while|endwhile|do|repeat|endrepeat|if|elseif|else|endif|break|continue")
FANUC = "fanuc"  # the keyword of a bare O-number


class Command:
    """One O-word; what follows its keyword is parsed on first execution, since skipped lines may contain anything."""

    __slots__ = ("_label", "_reader", "_shown", "_values", "_variables", "keyword")

    def __init__(self, text: str, variables: Variables, max_nesting: int) -> None:
        self._variables = variables
        self._reader = reader = Reader(text, variables, max_nesting)
        self._values: tuple[Value, ...] | None = None
        reader.take("o")
        label: str | Value = reader.name() if text.startswith("<", reader.at) else reader.value()
        self._label = str(whole(variables, label, "O")) if isinstance(label, float) else label
        self._shown = text[: reader.at]
        self.keyword = FANUC
        if reader.done():
            return
        match = _KEYWORD.match(text, reader.at)
        if match is None:
            raise reader.fault("is not an O-word; O-words are sub, call, while, do, repeat, if and their ends")
        reader.at = match.end()
        self.keyword = match.group()

    def label(self) -> str:
        """Return the label: a name, or a whole number as text."""
        label = self._label
        return label if isinstance(label, str) else str(whole(self._variables, now(label), "O"))

    def values(self) -> list[float]:
        """Evaluate the values in brackets; ProgramError for anything else after the keyword."""
        if self._values is None:
            reader, values = self._reader, []
            while reader.take("["):
                values.append(reader.bracketed())
            if not reader.done():
                what = f"{self.keyword} may be followed by values in brackets only"
                raise reader.fault(what, reader.text[reader.at :][:12])
            self._values = tuple(values)
        return [now(value) for value in self._values]

    def condition(self) -> float:
        """Evaluate the single value that the command needs."""
        values = self.values()
        if len(values) != 1:
            raise self.fault("needs one value in brackets")
        return values[0]

    def fault(self, message: str) -> ProgramError:
        """Return an error that names this command."""
        return self._reader.fault(message, f"{self._shown} {self.keyword}")
