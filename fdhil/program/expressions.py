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


class EvaluationContext(Protocol):
    """Evaluation context of values: the parameters (KeyError for a missing one) and the executed line."""

    line: int

    def get_numbered(self, index: int) -> float: ...

    def get_named(self, name: str) -> float: ...


def evaluate_value(value: Value) -> float:
    """Evaluate a value."""
    return value() if callable(value) else value


class ExpressionReader:
    """Parses values from ``text`` (lower case, no blanks and comments) at ``at``; ProgramError for invalid text."""

    __slots__ = ("_context", "_depth", "_max_depth", "at", "text", "word_at")

    def __init__(self, text: str, context: EvaluationContext, max_depth: int) -> None:
        self.text = text
        self.at = self.word_at = 0
        self._context = context
        self._max_depth = max_depth
        self._depth = 0

    def build_error(self, message: str, word: str | None = None) -> ProgramError:
        """Return the error for the word being parsed (from ``word_at`` on), or for another one."""
        if word is None and not self.text[self.at : self.at + 1].isascii():
            return self._build_foreign_character_error()
        return _build_error(self._context, word or self.text[self.word_at : self.word_at + 12], message)

    def _build_foreign_character_error(self) -> ProgramError:
        end = self.at + 1
        while end < min(len(self.text), self.at + 4) and not self.text[end].isascii():
            end += 1
        ways = (decode_as_written(self.text[self.at : stop]) for stop in range(end, self.at, -1))
        character = next((way for way in ways if len(way) == 1), self.text[self.at])
        name = f"U+{ord(character):04X}, {unicodedata.name(character, 'unnamed').lower()}"
        word = self.text[self.word_at : self.at].upper() + character
        return ProgramError(self._context.line, word, f"ends in a character that no NC accepts ({name}); type it again")

    def is_done(self) -> bool:
        """Return whether all of the text is parsed."""
        return self.at >= len(self.text)

    def take_mark(self, mark: str) -> bool:
        """Step over ``mark`` if it is next."""
        if self.text.startswith(mark, self.at):
            self.at += len(mark)
            return True
        return False

    def read_value(self) -> Value:
        """Parse one value: a number, ``#`` parameter, ``[expression]`` or function, each with or without a sign."""
        match = _NUMBER.match(self.text, self.at)
        if match is not None:
            self.at = match.end()
            return _require_finite(self._context, float(match.group()), match.group()[:12])
        self._depth += 1
        if self._depth > self._max_depth:
            raise self.build_error(f"nests deeper than {self._max_depth} levels; write it in several steps")
        try:
            return self._read_composed_value()
        finally:
            self._depth -= 1

    def _read_composed_value(self) -> Value:
        if self.take_mark("-"):
            value = self.read_value()
            return _apply_lazily(lambda a: -a, value)
        if self.take_mark("+"):
            return self.read_value()
        if self.take_mark("["):
            return self.read_bracketed()
        if self.take_mark("#"):
            return self._read_parameter()
        match = _FUNCTION.match(self.text, self.at)
        if match is None:
            raise self.build_error(
                "is not a value; a number, a parameter (#), a function or a bracket is expected here"
            )
        self.at = match.end()
        return self._read_function(match.group())

    def read_bracketed(self) -> Value:
        """Parse up to the bracket that closes the one just read, and return the expression's value."""
        values = [self.read_value()]
        operators: list[str] = []
        while not self.take_mark("]"):
            match = _OPERATOR.match(self.text, self.at)
            if match is None:
                what = "the bracket is not closed" if self.is_done() else "is not an operator"
                word = "[" if self.is_done() else self.text[self.at : self.at + 12]
                raise self.build_error(f"{what}; write [value operator value ...]", word)
            operator = match.group()
            while operators and _STEPS[operators[-1]] >= _STEPS[operator]:
                self._reduce_operators(values, operators)
            self.at = match.end()
            operators.append(operator)
            values.append(self.read_value())
        while operators:
            self._reduce_operators(values, operators)
        return values[0]

    def _reduce_operators(self, values: list[Value], operators: list[str]) -> None:
        right, left, operator = values.pop(), values.pop(), operators.pop()
        values.append(_build_binary_value(self._context, operator, left, right))

    def _read_parameter(self) -> Value:
        if self.text.startswith("<", self.at):
            return _build_named_reader(self._context, self.read_name())
        return _build_numbered_reader(self._context, self.read_value())

    def read_name(self) -> str:
        """Parse ``<name>``."""
        end = self.text.find(">", self.at)
        if not self.take_mark("<") or end < 0:
            raise self.build_error("is a name without its closing '>'")
        name = self.text[self.at : end]
        self.at = end + 1
        return name

    def _read_function(self, name: str) -> Value:
        if name == "exists":
            return self._read_exists()
        if not self.take_mark("["):
            raise self.build_error("the function's argument must be in brackets", name)
        argument = self.read_bracketed()
        if name == "atan":
            if not (self.take_mark("/") and self.take_mark("[")):
                raise self.build_error("ATAN needs two arguments: ATAN[y]/[x]", name)
            other = self.read_bracketed()
            return lambda: math.degrees(math.atan2(evaluate_value(argument), evaluate_value(other)))
        return _build_function_value(self._context, name, argument)

    def _read_exists(self) -> Value:
        if self.take_mark("[") and self.take_mark("#") and self.text.startswith("<", self.at):
            name = self.read_name()
            if self.take_mark("]"):
                return lambda: _is_parameter_set(self._context, name)
        raise self.build_error("EXISTS needs the name of a parameter: EXISTS[#<name>]", "exists")


def is_whole(value: float) -> bool:
    """Return whether a value counts as a whole number."""
    return abs(value - round(value)) <= _EQUAL


def require_whole(context: EvaluationContext, value: float, what: str) -> int:
    """Return a value as a whole number; ProgramError for any other value."""
    if not is_whole(value):
        raise _build_error(context, f"{what}{value:g}", "is not a whole number, which is required here")
    return round(value)


def _build_error(context: EvaluationContext, word: str, message: str) -> ProgramError:
    return ProgramError(context.line, word.upper() if word.isascii() else decode_as_written(word), message)


def decode_as_written(text: str) -> str:
    """Decode characters that represent the bytes of a file: UTF-8 if valid, else Latin-1."""
    try:
        return text.encode("latin-1").decode("utf-8")
    except UnicodeDecodeError:
        return text


def _require_finite(context: EvaluationContext, value: float, word: str) -> float:
    if value - value != 0.0:
        raise _build_error(context, word, "is too large a number; use one that a machine can reach")
    return value


def _apply_lazily(function: Callable[[float], float], value: Value) -> Value:
    return (lambda: function(value())) if callable(value) else function(value)


def _is_parameter_set(context: EvaluationContext, name: str) -> float:
    try:
        context.get_named(name)
    except KeyError:
        return 0.0
    return 1.0


def _build_named_reader(context: EvaluationContext, name: str) -> Value:
    def read_named() -> float:
        try:
            return context.get_named(name)
        except KeyError:
            raise _build_error(context, f"#<{name}>", "is a parameter without a value; set it first") from None

    return read_named


def _build_numbered_reader(context: EvaluationContext, index: Value) -> Value:
    if not callable(index):
        number = require_whole(context, index, "#")
        _read_numbered(context, number)
        return partial(context.get_numbered, number)
    return lambda: _read_numbered(context, require_whole(context, index(), "#"))


def _read_numbered(context: EvaluationContext, number: int) -> float:
    try:
        return context.get_numbered(number)
    except KeyError:
        raise _build_error(context, f"#{number}", "is not a parameter; parameters are numbered 1 to 5601") from None


def _build_function_value(context: EvaluationContext, name: str, argument: Value) -> Value:
    function = _UNARY[name]

    def apply_function(value: float) -> float:
        try:
            return _require_finite(context, function(value), name)
        except (ValueError, OverflowError):
            raise _build_error(context, name, f"has no real value for {value:g}") from None

    return _apply_lazily(apply_function, argument)


def _build_binary_value(context: EvaluationContext, operator: str, left: Value, right: Value) -> Value:
    function = _BINARY[operator]

    def combine_operands() -> float:
        a = left() if callable(left) else left
        b = right() if callable(right) else right
        try:
            value = function(a, b)
            return value if value - value == 0.0 else _require_finite(context, value, operator)
        except ZeroDivisionError:
            raise _build_error(context, operator, "divides by zero; guard it with IF") from None
        except (ValueError, OverflowError, TypeError):
            raise _build_error(context, operator, f"has no real value for {a:g} and {b:g}") from None

    return combine_operands if callable(left) or callable(right) else combine_operands()


def _compute_modulo(left: float, right: float) -> float:
    result = math.fmod(left, right) if right else left % right
    return result + abs(right) if result < 0.0 else result


def _round_half_away(value: float) -> float:
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
    "round": _round_half_away,
    "sin": lambda x: math.sin(math.radians(x)),
    "sqrt": math.sqrt,
    "tan": lambda x: math.tan(math.radians(x)),
}
_BINARY: Mapping[str, Callable[[float, float], float]] = {
    "**": math.pow,
    "*": operators.mul,
    "/": operators.truediv,
    "mod": _compute_modulo,
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
