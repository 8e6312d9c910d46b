"""Change the feeds of a program's lines: its F words are replaced, everything else is kept byte for byte."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from fdhil.errors import ProgramError
from fdhil.program.budget import Budget
from fdhil.program.expressions import ExpressionReader, Value
from fdhil.program.interpreter import Interpreter, interpret
from fdhil.program.modal_state import MM_PER_INCH
from fdhil.program.motions import Arc, Feed, Motion
from fdhil.program.parameters import ProgramVariables
from fdhil.program.words import read_word, remove_line_number

_COMMENT = re.compile(r"\([^)]*\)?|;.*")
_NUMBER = re.compile(r"[+-]?\s*(?:\d[\d\s]*\.?[\d\s]*|\.[\d\s]+)")
_UNITS = re.compile(r"[Gg]\s*0*(2[01])(?![\d.])")
_DIGITS = 3
_SAME = 1e-6  # relative tolerance of a feed that is written and parsed again


def replace_feeds(program: Path, shares: Mapping[int, float], budget: Budget) -> bytes:
    """Return the program with the feed of each line in ``shares`` times its share (0..1, truncated to three digits).

    The new program is interpreted as a check: it orders the same motions, and the same feeds on all other lines.
    ProgramError if F words alone cannot achieve that, and for a program with subroutines in other files.
    """
    run = Interpreter(program, budget, False)
    motions = list(run.run())
    if len(run.files) > 1:
        text = "it has subroutines in other files, whose feeds cannot be written; write them by hand"
        raise ProgramError(0, "", f"{program}: {text}")
    feeds = _collect_feeds(motions)
    raw = io.BytesIO(program.read_bytes()).readlines()
    line = 0
    for everywhere in (False, True):
        made = _FeedWriter(feeds, shares, everywhere).write_lines(raw)
        found = _find_first_difference(motions, made, shares, budget)
        if found is None:
            return b"".join(made)
        line = found
    text = "its new feed cannot be written as an F word, since other passes over it share that word; write it by hand"
    raise ProgramError(line, "", text)


def cut_to_digits(value: float) -> float:
    """Return a feed truncated to three digits, so that it does not exceed the limit."""
    if value <= 0.0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(value)) - _DIGITS + 1)
    return math.floor(value / unit * (1 + 1e-9)) * unit


def _find_feed_word(code: str) -> slice | None:
    places = [place for place, character in enumerate(code) if not character.isspace()]
    text = "".join(code[place] for place in places).lower()
    reader = ExpressionReader(text, ProgramVariables(0, {}, {}), Budget().max_nesting)
    reader.at = len(text) - len(remove_line_number(text.lstrip("/")))
    words: list[tuple[str, Value]] = []
    with suppress(ProgramError):  # an invalid line is never executed
        while not reader.is_done() and not text.startswith(("o", "%"), reader.at):
            read_word(reader, words, [])
            if words and words[-1][0] == "f":
                return slice(places[reader.word_at] + 1, places[reader.at - 1] + 1)
    return None


class _FeedWriter:
    """Writes the lines in order; ``everywhere`` gives each line with a feed its own F word."""

    def __init__(self, feeds: Mapping[int, float], shares: Mapping[int, float], everywhere: bool) -> None:
        self._feeds, self._shares, self._everywhere = feeds, shares, everywhere
        self._in_force = ""  # the F word's value in the program
        self._changed = False  # the written program has another one in force
        self._scale = 1.0

    def write_lines(self, raw: Sequence[bytes]) -> list[bytes]:
        """Return the new lines."""
        return [self._write_line(line.decode("latin-1"), k).encode("latin-1") for k, line in enumerate(raw, 1)]

    def _write_line(self, raw: str, number: int) -> str:
        code = _COMMENT.sub(lambda found: " " * len(found.group()), raw.rstrip("\r\n"))
        if units := _UNITS.search(code):
            self._scale = MM_PER_INCH if units.group(1) == "20" else 1.0
        feed = _find_feed_word(code)
        share = self._shares.get(number, 1.0) if number in self._feeds else 1.0
        if feed is not None:
            self._in_force = code[feed].strip()
            self._changed = share < 1.0
            return raw if share == 1.0 else f"{raw[: feed.start]}{self._format_feed(number, share)}{raw[feed.stop :]}"
        if number not in self._feeds or not (share < 1.0 or self._changed or self._everywhere):
            return raw
        self._changed = share < 1.0
        end = len(code.rstrip())
        return f"{raw[:end]} F{self._format_feed(number, share)}{raw[end:]}"

    def _format_feed(self, number: int, share: float) -> str:
        if _NUMBER.fullmatch(self._in_force) is None and not self._everywhere:
            return f"[{_format_number(cut_to_digits(share))} * {self._in_force}]" if share < 1.0 else self._in_force
        value = self._feeds[number] / self._scale if self._everywhere else float("".join(self._in_force.split()))
        if share == 1.0:
            return _format_number(value) if self._everywhere else self._in_force
        return _format_number(cut_to_digits(value * share))


def _format_number(value: float) -> str:
    return f"{value:.9f}".rstrip("0").rstrip(".")  # programs have no exponents


def _collect_feeds(motions: Sequence[Motion]) -> dict[int, float]:
    return {motion.line: motion.feed for motion in motions if isinstance(motion, Feed | Arc)}


def _find_first_difference(
    motions: Sequence[Motion], made: Sequence[bytes], shares: Mapping[int, float], budget: Budget
) -> int | None:
    try:
        new = list(interpret((line.decode("latin-1") for line in made), budget))
    except ProgramError as error:
        return error.line
    for before, now in zip(motions, new, strict=False):
        if not _is_as_wanted(before, now, shares):
            return before.line
    return None if len(motions) == len(new) else motions[min(len(motions), len(new)) - 1].line


def _is_as_wanted(before: Motion, now: Motion, shares: Mapping[int, float]) -> bool:
    """Return whether a motion is unchanged except for its share of the feed, truncated to three digits."""
    if not isinstance(before, Feed | Arc) or not isinstance(now, Feed | Arc):
        return before == now
    share = shares.get(before.line, 1.0)
    most = before.feed * share * (1 + _SAME)
    least = before.feed * share * (1 - (_SAME if share == 1.0 else 2 * 10.0 ** (1 - _DIGITS)))
    return least <= now.feed <= most and replace(now, feed=before.feed) == before
