"""Values of the language: numbers, parameters, functions and bracketed expressions, read and evaluated in one pass.

A value is evaluated while it is read, as the language wants it: ``#1=2 X#1`` moves to what #1 was before. Operators
bind in six steps: ``**``; ``* / MOD``; ``+ -``; ``EQ NE GT GE LT LE``; ``AND OR XOR``; equal ones from the left.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Protocol

from fdhil.errors import ProgramError

_NUMBER = re.compile(r"[+-]?(?:\d++\.?\d*+|\.\d++)")
_OPERATOR = re.compile(r"\*\*|[*/+\-]|mod|and|xor|or|eq|ne|gt|ge|lt|le")
_FUNCTION = re.compile(r"abs|acos|asin|atan|cos|exists|exp|fix|fup|ln|round|sin|sqrt|tan")
_STEPS = {
    "**": 6, "*": 5, "/": 5, "mod": 5, "+": 4, "-": 4,
    "eq": 3, "ne": 3, "gt": 3, "ge": 3, "lt": 3, "le": 3, "and": 2, "or": 2, "xor": 2,
}  # fmt: skip
_EQUAL = 1e-6  # numbers nearer than this are equal to EQ and NE, and to the integer that an index wants


class Parameters(Protocol):
    """Where ``#5`` and ``#<name>`` come from; both raise KeyError for one that is not there."""

    def number(self, index: int) -> float: ...

    def named(self, name: str) -> float: ...


class Reader:
    """Reads values from ``text`` (lower case, without blanks and comments) at ``at``; ProgramError with its line."""

    __slots__ = ("_depth", "_max_depth", "_parameters", "at", "line", "text", "word_at")

    def __init__(self, text: str, line: int, parameters: Parameters, max_depth: int) -> None:
        self.text = text
        self.line = line
        self.at = self.word_at = 0
        self._parameters = parameters
        self._max_depth = max_depth
        self._depth = 0

    def fault(self, message: str, word: str | None = None) -> ProgramError:
        """Return the error for the word being read (from ``word_at`` on), or for another one."""
        return ProgramError(self.line, (word or self.text[self.word_at : self.word_at + 12]).upper(), message)

    def done(self) -> bool:
        """Tell whether the text is used up."""
        return self.at >= len(self.text)

    def take(self, mark: str) -> bool:
        """Step over ``mark`` when it stands here."""
        if self.text.startswith(mark, self.at):
            self.at += len(mark)
            return True
        return False

    def value(self) -> float:
        """Read one value: a number, ``#`` parameter, ``[expression]`` or function, each with or without a sign."""
        match = _NUMBER.match(self.text, self.at)
        if match is not None:
            self.at = match.end()
            return self._finite(float(match.group()))
        self._depth += 1
        if self._depth > self._max_depth:
            raise self.fault(f"nests deeper than {self._max_depth} levels; write it in several steps")
        try:
            return self._composed()
        finally:
            self._depth -= 1

    def _composed(self) -> float:
        if self.take("-"):
            return -self.value()
        if self.take("+"):
            return self.value()
        if self.take("["):
            return self.bracketed()
        if self.take("#"):
            return self._parameter()
        match = _FUNCTION.match(self.text, self.at)
        if match is None:
            raise self.fault("is no value; a number, a parameter (#), a function or a bracket must stand here")
        self.at = match.end()
        return self._function(match.group())

    def _finite(self, value: float) -> float:
        if not math.isfinite(value):
            raise self.fault("is too large a number; write one that a machine can reach")
        return value

    def bracketed(self) -> float:
        """Read on to the bracket that closes the one just read, and return the expression's value."""
        values = [self.value()]
        operators: list[str] = []
        while not self.take("]"):
            match = _OPERATOR.match(self.text, self.at)
            if match is None:
                what = "the bracket is not closed" if self.done() else "is no operator"
                raise self.fault(f"{what}; write [value operator value ...]", None if not self.done() else "[")
            operator = match.group()
            while operators and _STEPS[operators[-1]] >= _STEPS[operator]:
                self._reduce(values, operators)
            self.at = match.end()
            operators.append(operator)
            values.append(self.value())
        while operators:
            self._reduce(values, operators)
        return values[0]

    def _reduce(self, values: list[float], operators: list[str]) -> None:
        right, left, operator = values.pop(), values.pop(), operators.pop()
        try:
            values.append(self._finite(_BINARY[operator](left, right)))
        except ZeroDivisionError:
            raise self.fault("divides by zero; guard it with IF", operator) from None
        except (ValueError, OverflowError, TypeError):
            raise self.fault(f"has no real value for {left:g} and {right:g}", operator) from None

    def _parameter(self) -> float:
        if self.text.startswith("<", self.at):
            name = self.name()
            try:
                return self._parameters.named(name)
            except KeyError:
                raise self.fault("is a parameter that was never given a value; set it first", f"#<{name}>") from None
        index = self.index()
        try:
            return self._parameters.number(index)
        except KeyError:
            raise self.fault("is no parameter; they are numbered 1 to 5602", f"#{index}") from None

    def name(self) -> str:
        """Read ``<name>``."""
        end = self.text.find(">", self.at)
        if not self.take("<") or end < 0:
            raise self.fault("is a name without its closing '>'")
        name = self.text[self.at : end]
        self.at = end + 1
        return name

    def index(self) -> int:
        """Read a parameter's number, itself a value of any kind, that must be a whole number."""
        value = self.value()
        if abs(value - round(value)) > _EQUAL:
            raise self.fault("is no whole number; a parameter's number must be one", f"#{value:g}")
        return round(value)

    def _function(self, name: str) -> float:
        if name == "exists":
            return self._exists()
        if not self.take("["):
            raise self.fault("the function's argument must stand in brackets", name)
        argument = self.bracketed()
        if name == "atan":
            if not (self.take("/") and self.take("[")):
                raise self.fault("ATAN wants two arguments: ATAN[y]/[x]", name)
            return math.degrees(math.atan2(argument, self.bracketed()))
        try:
            return self._finite(_UNARY[name](argument))
        except (ValueError, OverflowError):
            raise self.fault(f"has no real value for {argument:g}", name) from None

    def _exists(self) -> float:
        if not (self.take("[") and self.take("#") and self.text.startswith("<", self.at)):
            raise self.fault("EXISTS wants the name of a parameter: EXISTS[#<name>]", "exists")
        name = self.name()
        if not self.take("]"):
            raise self.fault("EXISTS wants the name of a parameter: EXISTS[#<name>]", "exists")
        try:
            self._parameters.named(name)
        except KeyError:
            return 0.0
        return 1.0


def _modulo(left: float, right: float) -> float:
    result = math.fmod(left, right) if right else left % right
    return result + abs(right) if result < 0.0 else result


def _round(value: float) -> float:
    return math.copysign(math.floor(abs(value) + 0.5), value)  # halves go away from zero


_UNARY: Mapping[str, Callable[[float], float]] = {
    "abs": abs,
    "acos": lambda x: math.degrees(math.acos(x)),
    "asin": lambda x: math.degrees(math.asin(x)),
    "cos": lambda x: math.cos(math.radians(x)),
    "exp": math.exp,
    "fix": math.floor,
    "fup": math.ceil,
    "ln": math.log,
    "round": _round,
    "sin": lambda x: math.sin(math.radians(x)),
    "sqrt": math.sqrt,
    "tan": lambda x: math.tan(math.radians(x)),
}
_BINARY: Mapping[str, Callable[[float, float], float]] = {
    "**": math.pow,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "mod": _modulo,
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "eq": lambda a, b: float(abs(a - b) < _EQUAL),
    "ne": lambda a, b: float(abs(a - b) >= _EQUAL),
    "gt": lambda a, b: float(a > b),
    "ge": lambda a, b: float(a >= b),
    "lt": lambda a, b: float(a < b),
    "le": lambda a, b: float(a <= b),
    "and": lambda a, b: float(a != 0 and b != 0),
    "or": lambda a, b: float(a != 0 or b != 0),
    "xor": lambda a, b: float((a != 0) != (b != 0)),
}
