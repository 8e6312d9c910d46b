"""Determines the kind of a move from the text of its block, as an NC shows it. Pure.

A G word of motion is modal: a block without one moves as the block before it. Any motion but G0 ends a G0, and so does
a word whose motion is unknown: threads (G32, G33), probing (G31, G38), splines, cycles and calls are never rapids. An
interface may skip blocks, and then the kind is unknown until a block has a word of its own.
Sources: ISO 6983-1 (G00 to G03); LinuxCNC's modal groups; Fanuc's lathe codes of system A, in which G90, G92 and G94
with axis words cut; for Klartext the vendor's user's manuals: FMAX is valid in its block only.
"""

import re
from collections.abc import Sequence
from typing import Protocol

from fdhil.records import MoveKind

G_WORDS = {0: MoveKind.RAPID, 1: MoveKind.FEED, 2: MoveKind.ARC, 3: MoveKind.ARC}
_COMMENT = re.compile(r"\([^)]*\)?|;.*")
_G = re.compile(r"(?<![A-Z_$])G\s*(\d+)(\.\d+)?(?!_)", re.IGNORECASE)
_STRAIGHT = re.compile(r"^\s*\d*\s*(LP|LN|L)\s(?!BL)", re.IGNORECASE)
_ARC = re.compile(r"^\s*\d*\s*(CTP|CP|CR|CT|C)\s", re.IGNORECASE)
_RAPID = re.compile(r"\bF\s*MAX\b", re.IGNORECASE)
_OTHERWISE = re.compile(
    r"(?<![A-Z_$])(G\s*[\[#=]|(CIP|CT|INVC?CW|POLY|[ABC]SPLINE|CYCLE\d+|POCKET\w*|HOLES\d+|CALL|M98)(?![A-Z_]))",
    re.IGNORECASE,
)
_AXIS = re.compile(r"(?<![A-Z_$])[XYZUVWABC]\s*[-+=.\[#\d]", re.IGNORECASE)
# codes without motion, except the lathe codes that cut with axis words
_NEUTRAL = frozenset({
    4, 7, 8, 9, 10, 11, *range(15, 24), 25, 26, *range(40, 45), 49, *range(50, 60), 61, 62, 64, 67, 68, 69,
    *range(90, 100), 450, 451, *range(500, 604), *range(641, 647), 700, 710,
})  # fmt: skip
_NEUTRAL_FORMS = frozenset(
    {10, 12, 13, 15, 28, 30, *range(40, 45), 49, 50, 51, 52, 53, 54, 59, 61, 64, 68, 69, 90, 91, 92, 96}
)
_CUT_WITH_AXES = frozenset({90, 92, 94})
_ONCE = frozenset({28, 29, 30, 31, 37})  # move in their block only: home, skip, tool length


class BlockReader(Protocol):
    """Tracks the blocks that an NC shows."""

    def classify_block(self, text: str, line: int | None) -> MoveKind | None:
        """Return how the block at this source line moves, None where that is unknown."""


class IsoBlocks:
    """Blocks of ISO 6983: the last G0, G1, G2 or G3 is valid as long as no block is skipped."""

    def __init__(self) -> None:
        self._held: MoveKind | None = None
        self._line: int | None = None  # last line of an unbroken sequence
        self._text = ""

    def classify_block(self, text: str, line: int | None) -> MoveKind | None:
        """Return how the block moves; None without a word of its own where blocks may have been skipped."""
        code = _COMMENT.sub(" ", text)
        words = [(int(word[1]), bool((word[2] or "").strip(".0"))) for word in _G.finditer(code)]
        motions = {G_WORDS.get(number) for number, form in words if number in G_WORDS and not form}
        follows = line is not None and self._line is not None and 0 <= line - self._line <= 1
        if _has_other_motion(words, code, bool(motions)):
            self._held = None
        elif motions:
            self._held = motions.pop() if len(motions) == 1 else None
        elif not follows:
            self._held = None
        # a line may arrive before its block: far from the last one, with the former text
        self._line = line if follows or text != self._text else None
        self._text = text
        return None if any(number in _ONCE and not form for number, form in words) else self._held


def _has_other_motion(words: Sequence[tuple[int, bool]], code: str, straight: bool) -> bool:
    """Return whether a block commands, or may command, another motion than G0 to G3.

    ``words`` are its G codes, and whether each has a digit behind its point; ``straight``: it has one of G0 to G3, with
    which G90, G92 and G94 cut nothing.
    """
    cuts = not straight and _AXIS.search(code) is not None
    for number, form in words:
        known = number in _NEUTRAL_FORMS if form else number in _NEUTRAL or number in G_WORDS or number in _ONCE
        if not known or (cuts and not form and number in _CUT_WITH_AXES):
            return True
    return _OTHERWISE.search(code) is not None


class KlartextBlocks:
    """Blocks of Heidenhain's Klartext: a straight line with FMAX is a rapid; no word is modal."""

    def classify_block(self, text: str, line: int | None) -> MoveKind | None:
        """Return how the block moves, None where it is neither line nor arc."""
        block = _COMMENT.sub(" ", text) + " "
        if not _STRAIGHT.match(block):
            return MoveKind.ARC if _ARC.match(block) and not _RAPID.search(block) else None
        return MoveKind.RAPID if _RAPID.search(block) else MoveKind.FEED


BLOCKS: dict[str, type[IsoBlocks] | type[KlartextBlocks]] = {"iso_block": IsoBlocks, "klartext_block": KlartextBlocks}
