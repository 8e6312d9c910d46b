"""Tells the kind of a move from the text of its block, as an NC shows it. Pure.

A G word holds on: a block without one moves as the block before it. What an interface shows may leave blocks out, and
then the kind is not known until a block has a word of its own.
Sources: ISO 6983-1 (G00 to G03); for Klartext the maker's user's manuals: FMAX holds for its block alone.
"""

from __future__ import annotations

import re
from typing import Protocol

from fdhil.records import MoveKind

G_WORDS = {0: MoveKind.RAPID, 1: MoveKind.FEED, 2: MoveKind.ARC, 3: MoveKind.ARC}
_COMMENT = re.compile(r"\([^)]*\)?|;.*")
_G = re.compile(r"(?<![A-Z_$])G\s*(\d+)(\.\d+)?(?!_)", re.IGNORECASE)
_STRAIGHT = re.compile(r"^\s*\d*\s*(LP|LN|L)\s(?!BL)", re.IGNORECASE)
_ARC = re.compile(r"^\s*\d*\s*(CTP|CP|CR|CT|C)\s", re.IGNORECASE)
_RAPID = re.compile(r"\bF\s*MAX\b", re.IGNORECASE)
_CYCLES = range(73, 90)  # canned ones: rapids and feeds in one block


class BlockReader(Protocol):
    """Follows the blocks that an NC shows."""

    def kind(self, text: str, line: int | None) -> MoveKind | None:
        """Return what the block at this source line moves as, None where it does not show."""


class IsoBlocks:
    """Blocks of ISO 6983: the last G0, G1, G2 or G3 holds, as far as the blocks follow each other."""

    def __init__(self) -> None:
        self._held: MoveKind | None = None
        self._line: int | None = None  # up to which no block was left out
        self._text = ""

    def kind(self, text: str, line: int | None) -> MoveKind | None:
        """Return what the block moves as; None without a word of its own where blocks may have been left out."""
        numbers = [int(word[1]) for word in _G.finditer(_COMMENT.sub(" ", text)) if not word[2]]
        words = {G_WORDS.get(number) for number in numbers if number in G_WORDS or number in _CYCLES}
        follows = line is not None and self._line is not None and 0 <= line - self._line <= 1
        if words:
            self._held = words.pop() if len(words) == 1 else None
        elif not follows:
            self._held = None
        # a line may be told before its block: far from the last one, with the text as before
        self._line = line if follows or text != self._text else None
        self._text = text
        return self._held


class KlartextBlocks:
    """Blocks of Heidenhain's Klartext: a straight line with FMAX is a rapid, and each block tells for itself."""

    def kind(self, text: str, line: int | None) -> MoveKind | None:
        """Return what the block moves as, None for one that is no line and no arc."""
        block = _COMMENT.sub(" ", text) + " "
        if not _STRAIGHT.match(block):
            return MoveKind.ARC if _ARC.match(block) and not _RAPID.search(block) else None
        return MoveKind.RAPID if _RAPID.search(block) else MoveKind.FEED


BLOCKS: dict[str, type[IsoBlocks] | type[KlartextBlocks]] = {"iso_block": IsoBlocks, "klartext_block": KlartextBlocks}
