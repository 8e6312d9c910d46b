"""Execute the canned cycles G73, G74, G81 to G89: drilling, tapping and boring as rapids, feeds and dwells.

A cycle works along the normal of the plane: to the hole at the higher of the present level and R, down to R, the hole
itself, and back to R (G99) or to the level before the cycle if that is higher (G98). The words of a cycle stay in force
as long as blocks without a new motion code repeat it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from fdhil.program.expressions import is_whole
from fdhil.program.machine import Machine
from fdhil.program.modal import AXES, Modal
from fdhil.program.motions import PLANE_AXES
from fdhil.program.targets import length_mm, plane_axes, target
from fdhil.program.words import Block

_CLEARANCE_MM = 0.254  # distance of a peck from the previous depth
_SAME_MM = 1e-9  # levels that differ by rounding only are equal
_WITH_DWELL = (820, 860, 880, 890)
_PECKING = (730, 830)
_TAPPING = {740: -1, 840: 1}  # direction of the spindle
_BACK_BORING = 870
_SPINNING = (860, 870, 880)
_KEPT = "rpqijk"
_DEPTH = "depth"  # one name in every plane, as in the reference
_MEANING = {"r": "its clearance level", "q": "its peck", "p": "its dwell", "i": "the entry's distance from the hole",
            "j": "the entry's distance from the hole", "k": "the level to bore up to"}  # fmt: skip


@dataclass(slots=True)
class Series:
    """Words shared by a series of cycle blocks, and the level at which the series began, both in program units.

    The numbers are kept if units or plane change, as in the reference.
    """

    words: dict[str, float] = field(default_factory=dict)
    began: float | None = None


def cycle(machine: Machine, block: Block, series: Series, fresh: bool) -> None:
    """Order one canned-cycle block of a series; ``fresh``: another motion was in force before it."""
    modal = machine.modal
    first, second, normal = plane_axes(modal, block)
    given = {} if fresh else dict(series.words)
    _words(modal, block, given)
    words = {letter: _mm(modal, letter, value) for letter, value in _words(modal, block, series.words).items()}
    _check(modal, block, given, words)
    repeats = round(block.words.get("l", 1.0))
    if "l" in block.words and (repeats < 1 or not is_whole(block.words["l"])):
        raise block.fault("l", "is not a valid number of repeats; L must be a whole number from 1")
    if series.began is None:
        series.began = modal.position[normal] / modal.scale
    old = series.began * modal.scale
    depth, clearance = _levels(modal, words, old)
    if depth > clearance:
        raise block.fault(modal.code, "its clearance level R lies below its depth")
    if old < clearance:
        machine.rapid_to(block, _with(modal.position, {normal: clearance}))
    hole = Hole(machine, block, words, depth, clearance, clearance if modal.retract_to_r else max(old, clearance))
    for _ in range(repeats):
        place = target(modal, block)
        level = modal.position[normal] if modal.position[normal] > clearance + _SAME_MM else hole.retract
        there = {first: place[first], second: place[second], normal: level}
        machine.rapid_to(block, _with(modal.position, there))
        if abs(modal.position[normal] - clearance) > _SAME_MM:
            hole.rapid(clearance)
        hole.work()


def _with(position: list[float], changed: dict[int, float]) -> list[float]:
    moved = list(position)
    for axis, value in changed.items():
        moved[axis] = value
    return moved


def _words(modal: Modal, block: Block, kept: dict[str, float]) -> dict[str, float]:
    normal = PLANE_AXES[modal.plane_name][2]
    if AXES[normal] in block.words:
        kept[_DEPTH] = length_mm(modal, normal, block.words[AXES[normal]]) / modal.scale
    for letter in _KEPT:
        if letter in block.words:
            kept[letter] = block.words[letter]
    return kept


def _mm(modal: Modal, letter: str, value: float) -> float:
    return value if letter == "p" else value * modal.scale


def _check(modal: Modal, block: Block, given: Mapping[str, float], words: Mapping[str, float]) -> None:
    code = modal.code
    first, second, normal = (AXES[axis] for axis in PLANE_AXES[modal.plane_name])
    if modal.feed_mode == 930:
        raise block.fault(code, "cannot be used in inverse-time mode (G93); use G94 or G95")
    if not any(letter in block.words for letter in (first, second, normal, "@", "^")):
        raise block.fault(code, f"needs a word of {first.upper()}, {second.upper()} or {normal.upper()}")
    for letter in "abcuvw":
        if letter in block.words:
            raise block.fault(letter, "cannot be moved by a canned cycle")
    needs = [_DEPTH, "r"]
    needs += ["q"] if modal.motion in _PECKING else []
    needs += ["p"] if modal.motion in _WITH_DWELL else []
    for letter in needs + (["i", "j", "k"] if modal.motion == _BACK_BORING else []):
        if letter not in given:
            shown = normal if letter == _DEPTH else letter
            raise block.fault(code, f"needs {shown.upper()}, {_MEANING.get(letter, 'its depth')}")
    if modal.motion in _PECKING and not words["q"] > 0.0:
        raise block.fault(f"Q{words['q']:g}", "is not a valid peck depth; Q must be positive")
    if words.get("p", 0.0) < 0.0:
        raise block.fault(f"P{words['p']:g}", "is not a valid dwell time; P must not be negative")
    if modal.motion in _SPINNING and modal.spindle_turns == 0:
        raise block.fault(code, "needs a turning spindle; use M3 or M4 first")
    if modal.motion in _TAPPING and modal.spindle_turns != _TAPPING[modal.motion]:
        raise block.fault(code, "needs the spindle to turn into the hole; use M3 for G84, M4 for G74")


def _levels(modal: Modal, words: dict[str, float], began: float) -> tuple[float, float]:
    """Return depth and clearance level in active co-ordinates; incremental R is relative to ``began``, Z to R."""
    if modal.absolute:
        return words[_DEPTH], words["r"]
    clearance = began + words["r"]
    return clearance + words[_DEPTH], clearance


@dataclass(slots=True)
class Hole:
    """One hole, machined from the clearance level down to ``depth`` and back to ``retract``."""

    machine: Machine
    block: Block
    words: Mapping[str, float]
    depth: float
    clearance: float
    retract: float

    def rapid(self, level: float) -> None:
        """Move to a level along the normal at rapid speed."""
        self._go(level, self.machine.rapid_to)

    def feed(self, level: float) -> None:
        """Move to a level along the normal at the feed in force."""
        self._go(level, self.machine.feed_to)

    def _go(self, level: float, how: Callable[[Block, list[float]], None]) -> None:
        modal = self.machine.modal
        how(self.block, _with(modal.position, {PLANE_AXES[modal.plane_name][2]: level}))

    def work(self) -> None:
        """Order the motions of the active cycle from the clearance level on."""
        motion = self.machine.modal.motion
        if motion in _PECKING:
            self._peck(motion == 830)
        elif motion == _BACK_BORING:
            self._back_bore()
        else:
            self._drill(motion)

    def _drill(self, motion: int) -> None:
        self.feed(self.depth)
        if motion in _WITH_DWELL or motion in _TAPPING:
            self.machine.dwell(self.block, self.words.get("p", 0.0))
        if motion == 850:
            self.feed(self.clearance)
            self.rapid(self.retract)
        elif motion == 890 or motion in _TAPPING:
            self.feed(self.retract)
        elif motion == 880:  # the operator retracts the tool by hand
            modal = self.machine.modal
            self.machine.stand_at(self.block, _with(modal.position, {PLANE_AXES[modal.plane_name][2]: self.retract}))
        else:
            self.rapid(self.retract)

    def _peck(self, to_clearance: bool) -> None:
        level = self.clearance
        while level - self.words["q"] > self.depth:
            level -= self.words["q"]
            self.feed(level)
            if to_clearance:
                self.rapid(self.clearance)
            self.rapid(level + _CLEARANCE_MM)
        self.feed(self.depth)
        self.rapid(self.retract)

    def _back_bore(self) -> None:
        modal, words = self.machine.modal, self.words
        first, second, normal = PLANE_AXES[modal.plane_name]
        letters = "ijk"[first], "ijk"[second], "ijk"[normal]
        centre = {first: modal.position[first], second: modal.position[second]}
        side = {first: centre[first] + words[letters[0]], second: centre[second] + words[letters[1]]}
        bored = words[letters[2]] if modal.absolute else self.depth + words[letters[2]]
        for place in (side, {normal: self.depth}, centre):
            self.machine.rapid_to(self.block, _with(modal.position, place))
        self.feed(bored)
        self.feed(self.depth)
        for place in (side, {normal: self.retract}, centre):
            self.machine.rapid_to(self.block, _with(modal.position, place))
