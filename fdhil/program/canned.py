"""Canned cycles G73, G74, G81 to G89: drilling, tapping and boring as sequences of rapids, feeds and dwells.

A cycle works along the normal of the plane: to the hole at the higher of the present level and R, down to R, the hole
itself, and back to R (G99) or to the level before the cycle when that is higher (G98). Words of a cycle stay in force
as long as blocks without a new motion code repeat it.
"""

from __future__ import annotations

from fdhil.errors import ProgramError
from fdhil.program.modal import AXES, Modal
from fdhil.program.motions import PLANE_AXES
from fdhil.program.moves import Machine, target
from fdhil.program.words import Block

_CLEARANCE_MM = 0.254  # by which a peck stays clear of where the drill was
_WITH_DWELL = (820, 860, 880, 890)
_PECKING = (730, 830)
_TAPPING = (740, 840)
_KEPT = "rlpqk"


def cycle(machine: Machine, block: Block, kept: dict[str, float]) -> None:
    """Order one canned-cycle block; ``kept`` holds the cycle's words from block to block."""
    modal = machine.modal
    new = "motion" in block.g
    words = _words(modal, block, kept, new)
    _check(modal, block, words)
    first, second, normal = PLANE_AXES[modal.plane_name]
    repeats = round(block.words.get("l", 1.0))
    if "l" in block.words and (repeats < 1 or abs(block.words["l"] - repeats) > 1e-4):
        raise block.fault("l", "is no number of repeats; L must be a whole number from 1")
    depth, clearance = _levels(modal, words)
    old = modal.position[normal]
    if old < clearance:
        machine.rapid_to(block, _with(modal.position, {normal: clearance}))
    retract = clearance if modal.retract_to_r or old < clearance else old
    for _ in range(repeats):
        place = target(modal, block)
        machine.rapid_to(block, _with(modal.position, {first: place[first], second: place[second]}))
        if modal.position[normal] != clearance:
            machine.rapid_to(block, _with(modal.position, {normal: clearance}))
        _hole(machine, block, normal, words, depth, clearance, retract)


def _with(position: list[float], changed: dict[int, float]) -> list[float]:
    moved = list(position)
    for axis, value in changed.items():
        moved[axis] = value
    return moved


def _words(modal: Modal, block: Block, kept: dict[str, float], new: bool) -> dict[str, float]:
    """Return the cycle's words, those of the block and those still in force, in mm."""
    normal = AXES[PLANE_AXES[modal.plane_name][2]]
    if new:
        kept.clear()
    for letter in (normal, *_KEPT):
        if letter in block.words:
            scale = modal.scale if letter in (normal, "r", "q") else 1.0
            kept[letter] = block.words[letter] * scale
    return kept


def _check(modal: Modal, block: Block, words: dict[str, float]) -> None:
    code = f"G{modal.motion / 10:g}"
    first, second, normal = (AXES[axis] for axis in PLANE_AXES[modal.plane_name])
    if modal.feed_mode == 930:
        raise ProgramError(block.line, code, "cannot be used in inverse-time mode (G93); use G94 or G95")
    if not any(letter in block.words for letter in (first, second, normal, "@", "^")):
        raise ProgramError(block.line, code, f"wants a word of {first.upper()}, {second.upper()} or {normal.upper()}")
    for letter in "abcuvw":
        if letter in block.words:
            raise block.fault(letter, "cannot be moved by a canned cycle")
    needs = [(normal, "its depth"), ("r", "its clearance level")]
    if modal.motion in _PECKING:
        needs.append(("q", "its peck"))
    if modal.motion in _WITH_DWELL:
        needs.append(("p", "its dwell"))
    for letter, what in needs:
        if letter not in words:
            raise ProgramError(block.line, code, f"wants {letter.upper()}, {what}")
    if modal.motion in _PECKING and not words["q"] > 0.0:
        raise ProgramError(block.line, f"Q{words['q']:g}", "is no depth of a peck; Q must be positive")
    if words.get("p", 0.0) < 0.0:
        raise ProgramError(block.line, f"P{words['p']:g}", "is no time to dwell; P must not be negative")
    if modal.motion in (860, 880, *_TAPPING) and modal.spindle_turns == 0:
        raise ProgramError(block.line, code, "wants a turning spindle; give M3 or M4 first")
    if modal.motion in (870, 880):
        raise ProgramError(block.line, code, "is not known to fdhil: it waits for an operator's hand")


def _levels(modal: Modal, words: dict[str, float]) -> tuple[float, float]:
    """Return depth and clearance level in active co-ordinates; incremental R is from here, incremental Z from R."""
    normal = PLANE_AXES[modal.plane_name][2]
    if modal.absolute:
        return words[AXES[normal]], words["r"]
    clearance = modal.position[normal] + words["r"]
    return clearance + words[AXES[normal]], clearance


def _hole(
    machine: Machine, block: Block, normal: int, words: dict[str, float], depth: float, clearance: float, retract: float
) -> None:
    """Order what happens in one hole, from the clearance level back to ``retract``."""
    modal = machine.modal
    if depth > clearance:
        raise ProgramError(block.line, f"G{modal.motion / 10:g}", "its clearance level R lies below its depth")

    def feed(level: float) -> None:
        machine.feed_to(block, _with(modal.position, {normal: level}))

    def rapid(level: float) -> None:
        machine.rapid_to(block, _with(modal.position, {normal: level}))

    motion = modal.motion
    if motion in _PECKING:
        level = clearance
        while level - words["q"] > depth:
            level -= words["q"]
            feed(level)
            if motion == 830:
                rapid(clearance)
                rapid(level + _CLEARANCE_MM)
            else:
                rapid(level + _CLEARANCE_MM)
        feed(depth)
        rapid(retract)
    else:
        feed(depth)
        if motion in _WITH_DWELL or motion in _TAPPING:
            machine.dwell(block, words.get("p", 0.0))
        if motion in (850, 890, *_TAPPING):
            feed(clearance)
            if retract != clearance:
                rapid(retract)
        else:
            rapid(retract)
