"""Parse lines of text to blocks: words, codes by modal group, and parameter settings.

Blanks, comments and case are insignificant outside names. A block has each letter once, except G, M and parameter
settings. G codes are stored times ten (G38.2 is 382).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from string import ascii_lowercase, ascii_uppercase

from fdhil.errors import ProgramError
from fdhil.program.expressions import (
    EvaluationContext,
    ExpressionReader,
    Value,
    evaluate_value,
    is_whole,
    require_whole,
)

_NUMBER = re.compile(r"n(\d++)(?:\.\d++)?+")
_CLEANED = str.maketrans(ascii_uppercase, ascii_lowercase, " \t\r\v\f")
_COMMENT = "("
_DIGITS = re.compile(r"[+-]?\d+")
_STRAIGHT = frozenset("xyzf")
_LETTERS = frozenset("abcdefghijklmpqrstuvwxyz@^$")


def _build_groups(*members: tuple[str, tuple[int, ...]]) -> Mapping[int, str]:
    return {code: name for name, codes in members for code in codes}


MOTION = (
    0, 10, 20, 30, 50, 51, 52, 53, 330, 331, 382, 383, 384, 385, 700, 710, 711, 712, 720, 721, 722, 730, 740, 760,
    *range(810, 900, 10),
)  # fmt: skip
G_GROUPS: Mapping[int, str] = _build_groups(
    ("motion", MOTION),
    ("cycle end", (800,)),
    ("one-shot", (40, 100, 280, 281, 300, 301, 520, 920, 921, 922, 923)),
    ("machine co-ordinates", (530,)),
    ("plane", (170, 171, 180, 181, 190, 191)),
    ("distance", (900, 910)),
    ("arc distance", (901, 911)),
    ("feed mode", (930, 940, 950)),
    ("units", (200, 210)),
    ("cutter compensation", (400, 410, 411, 420, 421)),
    ("tool length", (430, 431, 432, 490)),
    ("return", (980, 990)),
    ("co-ordinate system", (540, 550, 560, 570, 580, 590, 591, 592, 593)),
    ("path control", (610, 611, 640)),
    ("spindle mode", (960, 970)),
    ("lathe diameter", (70, 80)),
)
M_GROUPS: Mapping[int, str] = _build_groups(
    ("stop", (0, 1, 2, 30, 60)),
    ("call", (98, 99)),
    ("signals", (62, 63, 64, 65, 66, 67, 68)),
    ("tool", (6, 61)),
    ("spindle", (3, 4, 5, 19)),
    ("coolant", (7, 8, 9)),
    ("overrides", (48, 49, 50, 51, 52, 53)),
    ("modal state", (70, 71, 72, 73)),
)


def format_g_word(code: int) -> str:
    """Return a G code that is stored times ten in program notation: G38.2."""
    return f"G{code / 10:g}"


@dataclass(slots=True)
class Block:
    """One parsed line.

    ``words`` by letter (lower case, program units), G codes times ten and M codes by modal group, and the parameter
    settings in order, applied after the whole line. ``pointless`` are the letters whose value has no decimal point.
    """

    line: int
    words: dict[str, float] = field(default_factory=dict)
    g: dict[str, int] = field(default_factory=dict)
    m: dict[str, int] = field(default_factory=dict)
    settings: list[tuple[int | str, float]] = field(default_factory=list)
    pointless: frozenset[str] = frozenset()

    def build_error(self, word: str, message: str) -> ProgramError:
        """Return the error for one of its words; a letter is shown with its value."""
        if word in self.words:
            word = f"{word.upper()}{self.words[word]:g}"
        return ProgramError(self.line, word, message)


def clean_line(raw: str, line: int) -> str:
    """Return a line in lower case without blanks; ProgramError for an unclosed comment.

    A comment between two words becomes a mark, since it must not be within a word.
    """
    if "(" in raw or ";" in raw:
        return _remove_comments(raw, line).translate(_CLEANED).strip(_COMMENT)
    return raw.translate(_CLEANED)


def _remove_comments(raw: str, line: int) -> str:
    kept: list[str] = []
    at = 0
    while at < len(raw):
        marks = [place for place in (raw.find("(", at), raw.find(";", at)) if place >= 0]
        if not marks:
            kept.append(raw[at:])
            break
        start = min(marks)
        kept += (raw[at:start], _COMMENT)
        if raw[start] == ";":
            break
        end = raw.find(")", start)
        if end < 0:
            raise ProgramError(line, raw[start : start + 12], "the comment is not closed; add ')'")
        if "(" in raw[start + 1 : end]:
            raise ProgramError(line, raw[start : start + 12], "a comment contains a comment; remove the inner one")
        at = end + 1
    return "".join(kept)


def remove_line_number(text: str) -> str:
    """Return a cleaned line without its line number (N...)."""
    if text.startswith("n"):
        match = _NUMBER.match(text)
        if match is not None:
            return text[match.end() :]
    return text


@dataclass(frozen=True, slots=True)
class ParsedLine:
    """A parsed line: ``fixed`` if it is always the same block, else its words and settings to evaluate.

    ``straight`` are X, Y, Z and F of a line without other words except G0 or G1 (``code``, times ten). ``pointless``
    are the letters whose value has no decimal point.
    """

    fixed: Block | None
    words: tuple[tuple[str, Value], ...] = ()
    settings: tuple[tuple[Value | str, Value], ...] = ()
    code: int | None = None
    straight: tuple[Value | None, ...] | None = None
    pointless: frozenset[str] = frozenset()

    def evaluate_block(self, context: EvaluationContext) -> Block:
        """Return the line's block at present, with the parameters before its own settings."""
        fixed, line = self.fixed, context.line
        if fixed is not None:
            return Block(line, fixed.words, fixed.g, fixed.m, pointless=self.pointless)
        block = Block(line, pointless=self.pointless)
        for letter, value in self.words:
            _add_word(block, letter, evaluate_value(value))
        block.settings = self.evaluate_settings(context)
        return _apply_cycle_end(block)

    def evaluate_settings(self, context: EvaluationContext) -> list[tuple[int | str, float]]:
        """Return the parameters that the line sets and their values, with the parameters before that."""
        return [
            (key if isinstance(key, str) else require_whole(context, evaluate_value(key), "#"), evaluate_value(value))
            for key, value in self.settings
        ]


def _apply_cycle_end(block: Block) -> Block:
    """G80 is the motion of a block that has no other; next to another it has no effect."""
    if "cycle end" in block.g:
        block.g.setdefault("motion", block.g["cycle end"])
    return block


def parse_line(text: str, context: EvaluationContext, max_nesting: int) -> ParsedLine:
    """Parse a cleaned line; ProgramError with line and word for invalid syntax."""
    reader = ExpressionReader(text, context, max_nesting)
    words: list[tuple[str, Value]] = []
    settings: list[tuple[Value | str, Value]] = []
    pointless = set()
    while not reader.is_done():
        read_word(reader, words, settings)
        if _DIGITS.fullmatch(text, reader.word_at + 1, reader.at):
            pointless.add(text[reader.word_at])
    if settings:
        return ParsedLine(None, tuple(words), tuple(settings), pointless=frozenset(pointless))
    line = ParsedLine(None, tuple(words), (), *_detect_straight_move(words), frozenset(pointless))
    if not words or any(callable(value) for _, value in words):
        return line
    return replace(line, fixed=line.evaluate_block(context))


def _detect_straight_move(words: list[tuple[str, Value]]) -> tuple[int | None, tuple[Value | None, ...] | None]:
    by_letter = dict(words)
    code = by_letter.pop("g", None)
    if len(by_letter) + (code is not None) != len(words) or not by_letter.keys() <= _STRAIGHT:
        return None, None
    if code is not None and code not in (0.0, 1.0):
        return None, None
    number = 10 * int(code) if isinstance(code, float) else None
    return number, tuple(by_letter.get(letter) for letter in "xyzf")


def read_word(
    reader: ExpressionReader, words: list[tuple[str, Value]], settings: list[tuple[Value | str, Value]]
) -> None:
    """Parse the next word or the next setting of a parameter; ProgramError for anything else."""
    reader.word_at = reader.at
    letter = reader.text[reader.at]
    if letter == "#":
        reader.at += 1
        key = reader.read_name() if reader.text.startswith("<", reader.at) else reader.read_value()
        if not reader.take_mark("="):
            raise reader.build_error("a parameter's setting needs '=' and a value")
        settings.append((key, reader.read_value()))
        return
    if letter == _COMMENT:
        reader.at += 1
        return
    if letter not in _LETTERS and letter not in "no":
        raise reader.build_error("is not a word of the language; check the characters")
    reader.at += 1
    value = reader.read_value()
    if letter in "no":
        word = f"{letter}{value:g}" if isinstance(value, float) else None
        raise reader.build_error("is misplaced; N and O begin a line", word)
    words.append((letter, value))


def _add_word(block: Block, letter: str, value: float) -> None:
    if letter == "g":
        _add_g(block, value)
    elif letter == "m":
        _add_m(block, value)
    elif letter in block.words:
        raise block.build_error(f"{letter.upper()}{value:g}", "this letter occurs twice in the block; keep one")
    else:
        block.words[letter] = value


def _add_g(block: Block, value: float) -> None:
    code = round(value * 10.0)
    group = G_GROUPS.get(code) if abs(value * 10.0 - code) < 1e-3 else None
    if group is None:
        raise block.build_error(f"G{value:g}", "is a G code that fdhil does not support; see the list of codes")
    if group in block.g and group != "cycle end":
        other = format_g_word(block.g[group])
        raise block.build_error(f"G{value:g}", f"contradicts {other} in the same block; keep one of them")
    block.g[group] = code


def _add_m(block: Block, value: float) -> None:
    code = round(value)
    group = M_GROUPS.get(code) if is_whole(value) else None
    if group is None:
        raise block.build_error(f"M{value:g}", "is an M code that fdhil does not support; see the list of codes")
    if group in block.m:
        raise block.build_error(f"M{value:g}", f"contradicts M{block.m[group]} in the same block; keep one")
    block.m[group] = code
