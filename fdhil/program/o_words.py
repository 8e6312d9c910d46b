"""Parse O-words: a label, a keyword, and the values in brackets after it."""

from __future__ import annotations

import re

from fdhil.errors import ProgramError
from fdhil.program.expressions import ExpressionReader, Value, evaluate_value, require_whole
from fdhil.program.parameters import ProgramVariables

_KEYWORD = re.compile(r"endsub|sub|call|return|while|endwhile|do|repeat|endrepeat|if|elseif|else|endif|break|continue")
FANUC = "fanuc"  # the keyword of a bare O-number


class OWordCommand:
    """One O-word; what follows its keyword is parsed on first execution, since skipped lines may contain anything."""

    __slots__ = ("_label", "_reader", "_shown", "_values", "_variables", "keyword")

    def __init__(self, text: str, variables: ProgramVariables, max_nesting: int) -> None:
        self._variables = variables
        self._reader = reader = ExpressionReader(text, variables, max_nesting)
        self._values: tuple[Value, ...] | None = None
        reader.take_mark("o")
        label: str | Value = reader.read_name() if text.startswith("<", reader.at) else reader.read_value()
        self._label = str(require_whole(variables, label, "O")) if isinstance(label, float) else label
        self._shown = text[: reader.at]
        self.keyword = FANUC
        if reader.is_done():
            return
        match = _KEYWORD.match(text, reader.at)
        if match is None:
            raise reader.build_error("is not an O-word; O-words are sub, call, while, do, repeat, if and their ends")
        reader.at = match.end()
        self.keyword = match.group()

    def evaluate_label(self) -> str:
        """Return the label: a name, or a whole number as text."""
        label = self._label
        return label if isinstance(label, str) else str(require_whole(self._variables, evaluate_value(label), "O"))

    def evaluate_values(self) -> list[float]:
        """Evaluate the values in brackets; ProgramError for anything else after the keyword."""
        if self._values is None:
            reader, values = self._reader, []
            while reader.take_mark("["):
                values.append(reader.read_bracketed())
            if not reader.is_done():
                what = f"{self.keyword} may be followed by values in brackets only"
                raise reader.build_error(what, reader.text[reader.at :][:12])
            self._values = tuple(values)
        return [evaluate_value(value) for value in self._values]

    def evaluate_condition(self) -> float:
        """Evaluate the single value that the command needs."""
        values = self.evaluate_values()
        if len(values) != 1:
            raise self.build_error("needs one value in brackets")
        return values[0]

    def build_error(self, message: str) -> ProgramError:
        """Return an error that names this command."""
        return self._reader.build_error(message, f"{self._shown} {self.keyword}")
