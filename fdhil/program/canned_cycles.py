"""Execute the canned cycles G73, G74, G81 to G89: drilling, tapping and boring as rapids, feeds and dwells.

A cycle works along the normal of the plane: to the hole at the higher of the present level and R, down to R, the hole
itself, and back to R (G99) or to the level before the cycle if that is higher (G98). The words of a cycle stay in force
as long as blocks without a new motion code repeat it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from fdhil.program.expressions import is_whole
from fdhil.program.modal_state import AXES, ModalState
from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.motions import PLANE_AXES
from fdhil.program.targets import compute_target, convert_to_mm, get_plane_axes
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
class CycleSeries:
    """Words shared by a series of cycle blocks, and the level at which the series began, both in program units.

    The numbers are kept if units or plane change, as in the reference.
    """

    words: dict[str, float] = field(default_factory=dict)
    began: float | None = None


def order_canned_cycle(machine: MotionBuilder, block: Block, series: CycleSeries, fresh: bool) -> None:
    """Order one canned-cycle block of a series; ``fresh``: another motion was in force before it."""
    modal = machine.modal
    first, second, normal = get_plane_axes(modal, block)
    given = {} if fresh else dict(series.words)
    _update_kept_words(modal, block, given)
    words = {
        letter: _convert_to_mm(modal, letter, value)
        for letter, value in _update_kept_words(modal, block, series.words).items()
    }
    _check_cycle_words(modal, block, given, words)
    repeats = round(block.words.get("l", 1.0))
    if "l" in block.words and (repeats < 1 or not is_whole(block.words["l"])):
        raise block.build_error("l", "is not a valid number of repeats; L must be a whole number from 1")
    if series.began is None:
        series.began = modal.position[normal] / modal.scale
    old = series.began * modal.scale
    depth, clearance = _compute_levels(modal, words, old)
    if depth > clearance:
        raise block.build_error(modal.code, "its clearance level R lies below its depth")
    if old < clearance:
        machine.move_rapid_to(block, _replace_axes(modal.position, {normal: clearance}))
    hole = CannedHole(machine, block, words, depth, clearance, clearance if modal.retract_to_r else max(old, clearance))
    for _ in range(repeats):
        place = compute_target(modal, block)
        level = modal.position[normal] if modal.position[normal] > clearance + _SAME_MM else hole.retract
        there = {first: place[first], second: place[second], normal: level}
        machine.move_rapid_to(block, _replace_axes(modal.position, there))
        if abs(modal.position[normal] - clearance) > _SAME_MM:
            hole.move_rapid_to(clearance)
        hole.order_cycle()


def _replace_axes(position: list[float], changed: dict[int, float]) -> list[float]:
    moved = list(position)
    for axis, value in changed.items():
        moved[axis] = value
    return moved


def _update_kept_words(modal: ModalState, block: Block, kept: dict[str, float]) -> dict[str, float]:
    normal = PLANE_AXES[modal.plane_name][2]
    if AXES[normal] in block.words:
        kept[_DEPTH] = convert_to_mm(modal, normal, block.words[AXES[normal]]) / modal.scale
    for letter in _KEPT:
        if letter in block.words:
            kept[letter] = block.words[letter]
    return kept


def _convert_to_mm(modal: ModalState, letter: str, value: float) -> float:
    return value if letter == "p" else value * modal.scale


def _check_cycle_words(modal: ModalState, block: Block, given: Mapping[str, float], words: Mapping[str, float]) -> None:
    code = modal.code
    first, second, normal = (AXES[axis] for axis in PLANE_AXES[modal.plane_name])
    if modal.feed_mode == 930:
        raise block.build_error(code, "cannot be used in inverse-time mode (G93); use G94 or G95")
    if not any(letter in block.words for letter in (first, second, normal, "@", "^")):
        raise block.build_error(code, f"needs a word of {first.upper()}, {second.upper()} or {normal.upper()}")
    for letter in "abcuvw":
        if letter in block.words:
            raise block.build_error(letter, "cannot be moved by a canned cycle")
    needs = [_DEPTH, "r"]
    needs += ["q"] if modal.motion in _PECKING else []
    needs += ["p"] if modal.motion in _WITH_DWELL else []
    for letter in needs + (["i", "j", "k"] if modal.motion == _BACK_BORING else []):
        if letter not in given:
            shown = normal if letter == _DEPTH else letter
            raise block.build_error(code, f"needs {shown.upper()}, {_MEANING.get(letter, 'its depth')}")
    if modal.motion in _PECKING and not words["q"] > 0.0:
        raise block.build_error(f"Q{words['q']:g}", "is not a valid peck depth; Q must be positive")
    if words.get("p", 0.0) < 0.0:
        raise block.build_error(f"P{words['p']:g}", "is not a valid dwell time; P must not be negative")
    if modal.motion in _SPINNING and modal.spindle_turns == 0:
        raise block.build_error(code, "needs a turning spindle; use M3 or M4 first")
    if modal.motion in _TAPPING and modal.spindle_turns != _TAPPING[modal.motion]:
        raise block.build_error(code, "needs the spindle to turn into the hole; use M3 for G84, M4 for G74")


def _compute_levels(modal: ModalState, words: dict[str, float], began: float) -> tuple[float, float]:
    """Return depth and clearance level in active co-ordinates; incremental R is relative to ``began``, Z to R."""
    if modal.absolute:
        return words[_DEPTH], words["r"]
    clearance = began + words["r"]
    return clearance + words[_DEPTH], clearance


@dataclass(slots=True)
class CannedHole:
    """One hole, machined from the clearance level down to ``depth`` and back to ``retract``."""

    machine: MotionBuilder
    block: Block
    words: Mapping[str, float]
    depth: float
    clearance: float
    retract: float

    def move_rapid_to(self, level: float) -> None:
        """Move to a level along the normal at rapid speed."""
        self._move_to_level(level, self.machine.move_rapid_to)

    def feed_to(self, level: float) -> None:
        """Move to a level along the normal at the feed in force."""
        self._move_to_level(level, self.machine.feed_to)

    def _move_to_level(self, level: float, how: Callable[[Block, list[float]], None]) -> None:
        modal = self.machine.modal
        how(self.block, _replace_axes(modal.position, {PLANE_AXES[modal.plane_name][2]: level}))

    def order_cycle(self) -> None:
        """Order the motions of the active cycle from the clearance level on."""
        motion = self.machine.modal.motion
        if motion in _PECKING:
            self._peck_hole(motion == 830)
        elif motion == _BACK_BORING:
            self._bore_backwards()
        else:
            self._drill_hole(motion)

    def _drill_hole(self, motion: int) -> None:
        self.feed_to(self.depth)
        if motion in _WITH_DWELL or motion in _TAPPING:
            self.machine.add_dwell(self.block, self.words.get("p", 0.0))
        if motion == 850:
            self.feed_to(self.clearance)
            self.move_rapid_to(self.retract)
        elif motion == 890 or motion in _TAPPING:
            self.feed_to(self.retract)
        elif motion == 880:  # the operator retracts the tool by hand
            modal = self.machine.modal
            self.machine.set_position(
                self.block, _replace_axes(modal.position, {PLANE_AXES[modal.plane_name][2]: self.retract})
            )
        else:
            self.move_rapid_to(self.retract)

    def _peck_hole(self, to_clearance: bool) -> None:
        level = self.clearance
        while level - self.words["q"] > self.depth:
            level -= self.words["q"]
            self.feed_to(level)
            if to_clearance:
                self.move_rapid_to(self.clearance)
            self.move_rapid_to(level + _CLEARANCE_MM)
        self.feed_to(self.depth)
        self.move_rapid_to(self.retract)

    def _bore_backwards(self) -> None:
        modal, words = self.machine.modal, self.words
        first, second, normal = PLANE_AXES[modal.plane_name]
        letters = "ijk"[first], "ijk"[second], "ijk"[normal]
        centre = {first: modal.position[first], second: modal.position[second]}
        side = {first: centre[first] + words[letters[0]], second: centre[second] + words[letters[1]]}
        bored = words[letters[2]] if modal.absolute else self.depth + words[letters[2]]
        for place in (side, {normal: self.depth}, centre):
            self.machine.move_rapid_to(self.block, _replace_axes(modal.position, place))
        self.feed_to(bored)
        self.feed_to(self.depth)
        for place in (side, {normal: self.retract}, centre):
            self.machine.move_rapid_to(self.block, _replace_axes(modal.position, place))
