"""Check words that need a code: a letter that no code of the block uses is an error."""

from __future__ import annotations

from collections.abc import Mapping

from fdhil.program.expressions import is_whole
from fdhil.program.words import Block, format_g_word

CYCLES = frozenset({730, 740, *range(810, 900, 10)})
_COMPENSATION = frozenset({400, 410, 411, 420, 421})
_LATHE = frozenset({700, 710, 711, 712, 720, 721, 722})

# letter -> G codes times ten that use it, M codes that use it, their names in the error
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

_CORNERING = (
    "is for the S-curve planner of LinuxCNC 2.10, whose corners fdhil does not plan; remove R, or "
    "record the demand with fdhil record"
)


def check_word_usage(block: Block, motion: int | None) -> None:
    """Raise ProgramError for a letter that neither a code of the block nor its ``motion`` uses."""
    words = block.words
    if "r" in words and block.g.get("path control") == 640 and _READERS["r"][0].isdisjoint(block.g.values()):
        raise block.build_error("G64 R", _CORNERING)
    for letter in words:
        if letter in _READERS:
            g, m, names = _READERS[letter]
            if motion not in g and g.isdisjoint(block.g.values()) and m.isdisjoint(block.m.values()):
                raise block.build_error(letter, f"has no code that uses it; it belongs to {names}")


def check_machine_words(block: Block) -> None:
    """Raise ProgramError for invalid values of a tool, a spindle, an input or an output."""
    words, m = block.words, block.m
    tool = words.get("t", 0.0)
    if tool < 0.0 or not is_whole(tool):
        raise block.build_error("t", "is not a valid tool number; T must be a whole number from 0")
    if words.get("$", 0.0) not in (0.0, -1.0):
        raise block.build_error("$", "is not a spindle; the machine has only spindle 0")
    if m.get("tool") == 61 and words.get("q", -1.0) < 0.0:
        raise block.build_error("M61", "needs the tool number as Q, not negative")
    if m.get("spindle") == 19:
        if not 0.0 <= words.get("r", 0.0) <= 360.0:
            raise block.build_error("r", "is not a valid spindle angle; R must be 0 to 360")
        if words.get("p", 0.0) not in (0.0, 1.0, 2.0):
            raise block.build_error("p", "is not a valid spindle direction; P must be 0, 1 or 2")
    if "signals" in m:
        _check_signal(block, m["signals"])


def _check_signal(block: Block, code: int) -> None:
    """M62 to M65 name an output by P (LinuxCNC accepts any), M67 and M68 by E; M66 an input by one of them."""
    words = block.words
    if code in (62, 63, 64, 65) and "p" in words:
        return
    wanted = {67: "e", 68: "e"}.get(code, "p")
    given = [letter for letter in ("pe" if code == 66 else wanted) if words.get(letter, -1.0) >= 0.0]
    if len(given) != 1:
        what = "one input as P or E" if code == 66 else f"the output's number as {wanted.upper()}"
        raise block.build_error(f"M{code}", f"needs {what}, not negative")
    if code != 66:
        return
    wait = words.get("l", 0.0)
    if wait not in (0.0, 1.0, 2.0, 3.0, 4.0) or (given == ["e"] and wait != 0.0):
        raise block.build_error("M66", "needs L from 0 to 4, and 0 for an analogue input")
    if wait != 0.0 and words.get("q", 0.0) <= 0.0:
        raise block.build_error("M66", "needs the maximum waiting time as Q")


def require_single_axis_code(block: Block) -> None:
    """Raise ProgramError if two codes of the block both use its axis words."""
    wanting = [code for group, code in block.g.items()
               if (group == "one-shot" and code in (100, 280, 300, 520, 920))
               or (group == "motion" and code != 800)]  # fmt: skip
    if len(wanting) > 1:
        names = " and ".join(format_g_word(code) for code in sorted(wanting))
        raise block.build_error(format_g_word(wanting[-1]), f"{names} would both use the axis words; keep one")
