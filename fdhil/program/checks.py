"""Words that need a code beside them: a letter that no code of the block reads is a mistake, and is refused."""

from __future__ import annotations

from collections.abc import Mapping

from fdhil.errors import ProgramError
from fdhil.program.words import Block

CYCLES = frozenset({730, 740, *range(810, 900, 10)})
_COMPENSATION = frozenset({400, 410, 411, 420, 421})
_LATHE = frozenset({700, 710, 711, 712, 720, 721, 722})

# letter -> G codes times ten that read it, M codes that read it, how the error names them
_READERS: Mapping[str, tuple[frozenset[int], frozenset[int], str]] = {
    "d": (frozenset({410, 411, 420, 421, 960}) | _LATHE, frozenset(), "G41, G42, G70 or G96"),
    "e": (frozenset({700, 760}), frozenset({66, 67, 68}), "G70, G76 or M66 to M68"),
    "h": (frozenset({430, 432, 760}), frozenset(), "G43 or G76"),
    "i": (frozenset({20, 30, 50, 51, 100, 331, 760, 870}) | _LATHE, frozenset(), "G2, G3, G5 or G76"),
    "j": (frozenset({20, 30, 50, 51, 100, 331, 760, 870}), frozenset(), "G2, G3, G5 or G76"),
    "k": (frozenset({20, 30, 330, 331, 760, 870}), frozenset(), "G2, G3, G33 or G76"),
    "l": ((CYCLES - {740}) | (_COMPENSATION - {400}) | {52, 100, 760}, frozenset({66, 98}), "G10, a cycle, M66 or M98"),
    "p": (frozenset({20, 30, 40, 50, 52, 100, 640, 700, 760, 820, 840, 740, 860, 880, 890}),
          frozenset({50, 51, 52, 53, 62, 63, 64, 65, 66, 98, 19}), "G2, G3, G4, G10, G64, G82, G86, G89 or M50 to M66"),
    "q": (frozenset({50, 100, 640, 730, 760, 830}) | _LATHE,
          frozenset({19, 61, 66, 67, 68}), "G5, G64, G73, G76, G83 or M66 to M68"),
    "r": (CYCLES | _LATHE | {20, 30, 100, 760}, frozenset({19}), "G2, G3, G10 or a cycle"),
}  # fmt: skip


def check_readers(block: Block, motion: int | None) -> None:
    """Raise ProgramError for a letter that neither a code of the block nor its ``motion`` reads."""
    words = block.words
    for letter in words:
        if letter in _READERS:
            g, m, names = _READERS[letter]
            if motion not in g and g.isdisjoint(block.g.values()) and m.isdisjoint(block.m.values()):
                raise block.fault(letter, f"has no code that reads it; it belongs to {names}")


def one_reader_of_axes(block: Block) -> None:
    """Raise ProgramError when two codes of the block both want its axis words."""
    wanting = [code for group, code in block.g.items()
               if (group == "one-shot" and code in (100, 280, 300, 520, 920))
               or (group == "motion" and code != 800)]  # fmt: skip
    if len(wanting) > 1:
        names = " and ".join(f"G{code / 10:g}" for code in sorted(wanting))
        raise ProgramError(block.line, f"G{wanting[-1] / 10:g}", f"{names} would both use the axis words; keep one")
