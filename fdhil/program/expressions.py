"""Values of the language (numbers, parameters, functions, expressions): parsed once, evaluated on execution.

A constant value becomes a number while it is parsed; any other becomes a function without arguments, so that a loop
parses its lines only once. Operators bind in this order: ``**``; ``* / MOD``; ``+ -``; ``EQ NE GT GE LT LE``; ``AND OR
XOR``; equal ones from the left.
"""

from __future__ import annotations

import math
import operator as operators
import re
import unicodedata
from collections.abc import Callable, Mapping
from functools import partial
from typing import Protocol

from fdhil.errors import ProgramError

Value = float | Callable[[], float]

_NUMBER = re.compile(r"[+-]?(?:\d++\.?\d*+|\.\d++)")
_OPERATOR = re.compile(r"\*\*|[*/+\-]|mod|and|xor|or|eq|ne|gt|ge|lt|le")
_FUNCTION = re.compile(r"abs|acos|asin|atan|cos|exists|exp|fix|fup|ln|round|sin|sqrt|tan")
_STEPS = {
    "**": 6, "*": 5, "/": 5, "mod": 5, "+": 4, "-": 4,
    "eq": 3, "ne": 3, "gt": 3, "ge": 3, "lt": 3, "le": 3, "and": 2, "or": 2, "xor": 2,
}  # fmt: skip
_EQUAL = 1e-4  # tolerance of EQ and NE, and of whole numbers


class Context(Protocol):
    """Evaluation context of values: the parameters (KeyError for a missing one) and the executed line."""

    line: int

    def number(self, index: int) -> float: ...

    def named(self, name: str) -> float: ...


def now(value: Value) -> float:
    """Evaluate a value."""
    return value() if callable(value) else value


class Reader:
    """Parses values from ``text`` (lower case, no blanks and comments) at ``at``; ProgramError for invalid text."""

    __slots__ = ("_context", "_depth", "_max_depth", "at", "text", "word_at")

    def __init__(self, text: str, context: Context, max_depth: int) -> None:
        self.text = text
        self.at = self.word_at = 0
        self._context = context
        self._max_depth = max_depth
        self._depth = 0

    def fault(self, message: str, word: str | None = None) -> ProgramError:
        """Return the error for the word being parsed (from ``word_at`` on), or for another one."""
        if word is None and not self.text[self.at : self.at + 1].isascii():
            return self._stranger()
        return _fault(self._context, word or self.text[self.word_at : self.word_at + 12], message)

    def _stranger(self) -> ProgramError:
        end = self.at + 1
        while end < min(len(self.text), self.at + 4) and not self.text[end].isascii():
            end += 1
        ways = (as_written(self.text[self.at : stop]) for stop in range(end, self.at, -1))
        character = next((way for way in ways if len(way) == 1), self.text[self.at])
        name = f"U+{ord(character):04X}, {unicodedata.name(character, 'unnamed').lower()}"
        word = self.text[self.word_at : self.at].upper() + character
        return ProgramError(self._context.line, word, f"ends in a character that no NC accepts ({name}); type it again")

    def done(self) -> bool:
        """Return whether all of the text is parsed."""
        return self.at >= len(self.text)

    def take(self, mark: str) -> bool:
        """Step over ``mark`` if it is next."""
        if self.text.startswith(mark, self.at):
            self.at += len(mark)
            return True
        return False

    def value(self) -> Value:
        """Parse one value: a number, ``#`` parameter, ``[expression]`` or function, each with or without a sign."""
        match = _NUMBER.match(self.text, self.at)
        if match is not None:
            self.at = match.end()
            return _finite(self._context, float(match.group()), match.group()[:12])
        self._depth += 1
        if self._depth > self._max_depth:
            raise self.fault(f"nests deeper than {self._max_depth} levels; write it in several steps")
        try:
            return self._composed()
        finally:
            self._depth -= 1

    def _composed(self) -> Value:
        if self.take("-"):
            value = self.value()
            return _lazily(lambda a: -a, value)
        if self.take("+"):
            return self.value()
        if self.take("["):
            return self.bracketed()
        if self.take("#"):
            return self._parameter()
        match = _FUNCTION.match(self.text, self.at)
        if match is None:
            raise self.fault("is not a value; a number, a parameter (#), a function or a bracket is expected here")
        self.at = match.end()
        return self._function(match.group())

    def bracketed(self) -> Value:
        """Parse up to the bracket that closes the one just read, and return the expression's value."""
        values = [self.value()]
        operators: list[str] = []
        while not self.take("]"):
            match = _OPERATOR.match(self.text, self.at)
            if match is None:
                what = "the bracket is not closed" if self.done() else "is not an operator"
                word = "[" if self.done() else self.text[self.at : self.at + 12]
                raise self.fault(f"{what}; write [value operator value ...]", word)
            operator = match.group()
            while operators and _STEPS[operators[-1]] >= _STEPS[operator]:
                self._reduce(values, operators)
            self.at = match.end()
            operators.append(operator)
            values.append(self.value())
        while operators:
            self._reduce(values, operators)
        return values[0]

    def _reduce(self, values: list[Value], operators: list[str]) -> None:
        right, left, operator = values.pop(), values.pop(), operators.pop()
        values.append(_binary(self._context, operator, left, right))

    def _parameter(self) -> Value:
        if self.text.startswith("<", self.at):
            return _named(self._context, self.name())
        return _numbered(self._context, self.value())

    def name(self) -> str:
        """Parse ``<name>``."""
        end = self.text.find(">", self.at)
        if not self.take("<") or end < 0:
            raise self.fault("is a name without its closing '>'")
        name = self.text[self.at : end]
        self.at = end + 1
        return name

    def _function(self, name: str) -> Value:
        if name == "exists":
            return self._exists()
        if not self.take("["):
            raise self.fault("the function's argument must be in brackets", name)
        argument = self.bracketed()
        if name == "atan":
            if not (self.take("/") and self.take("[")):
                raise self.fault("ATAN needs two arguments: ATAN[y]/[x]", name)
            other = self.bracketed()
            return lambda: math.degrees(math.atan2(now(argument), now(other)))
        return _applied(self._context, name, argument)

    def _exists(self) -> Value:
        if self.take("[") and self.take("#") and self.text.startswith("<", self.at):
            name = self.name()
            if self.take("]"):
                return lambda: _is_there(self._context, name)
        raise self.fault("EXISTS needs the name of a parameter: EXISTS[#<name>]", "exists")


def is_whole(value: float) -> bool:
    """Return whether a value counts as a whole number."""
    return abs(value - round(value)) <= _EQUAL


def whole(context: Context, value: float, what: str) -> int:
    """Return a value as a whole number; ProgramError for any other value."""
    if not is_whole(value):
        raise _fault(context, f"{what}{value:g}", "is not a whole number, which is required here")
    return round(value)


def _fault(context: Context, word: str, message: str) -> ProgramError:
    return ProgramError(context.line, word.upper() if word.isascii() else as_written(word), message)


def as_written(text: str) -> str:
    """Decode characters that represent the bytes of a file: UTF-8 if valid, else Latin-1."""
    try:
        return text.encode("latin-1").decode("utf-8")
    except UnicodeDecodeError:
        return text


def _finite(context: Context, value: float, word: str) -> float:
    if value - value != 0.0:
        raise _fault(context, word, "is too large a number; use one that a machine can reach")
    return value


def _lazily(function: Callable[[float], float], value: Value) -> Value:
    return (lambda: function(value())) if callable(value) else function(value)


def _is_there(context: Context, name: str) -> float:
    try:
        context.named(name)
    except KeyError:
        return 0.0
    return 1.0


def _named(context: Context, name: str) -> Value:
    def read() -> float:
        try:
            return context.named(name)
        except KeyError:
            raise _fault(context, f"#<{name}>", "is a parameter without a value; set it first") from None

    return read


def _numbered(context: Context, index: Value) -> Value:
    if not callable(index):
        number = whole(context, index, "#")
        _number(context, number)
        return partial(context.number, number)
    return lambda: _number(context, whole(context, index(), "#"))


def _number(context: Context, number: int) -> float:
    try:
        return context.number(number)
    except KeyError:
        raise _fault(context, f"#{number}", "is not a parameter; parameters are numbered 1 to 5601") from None


def _applied(context: Context, name: str, argument: Value) -> Value:
    function = _UNARY[name]

    def apply(value: float) -> float:
        try:
            return _finite(context, function(value), name)
        except (ValueError, OverflowError):
            raise _fault(context, name, f"has no real value for {value:g}") from None

    return _lazily(apply, argument)


def _binary(context: Context, operator: str, left: Value, right: Value) -> Value:
    function = _BINARY[operator]

    def combine() -> float:
        a = left() if callable(left) else left
        b = right() if callable(right) else right
        try:
            value = function(a, b)
            return value if value - value == 0.0 else _finite(context, value, operator)
        except ZeroDivisionError:
            raise _fault(context, operator, "divides by zero; guard it with IF") from None
        except (ValueError, OverflowError, TypeError):
            raise _fault(context, operator, f"has no real value for {a:g} and {b:g}") from None

    return combine if callable(left) or callable(right) else combine()


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
    "*": operators.mul,
    "/": operators.truediv,
    "mod": _modulo,
    "+": operators.add,
    "-": operators.sub,
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
