"""Evaluate the words of a block: its target, its length and its feed."""

from __future__ import annotations

import math

from fdhil.program.modal_state import AXES, INDEX, ModalState
from fdhil.program.motions import PLANE_AXES
from fdhil.program.words import Block

_MIN_INVERSE_TIME_FEED = 0.1  # program units per minute; a move without length has no feed of its own


def measure_straight_length(start: list[float], end: list[float]) -> float:
    """Return the length that a feed refers to: of X Y Z, else of U V W, else of A B C."""
    for first in (0, 6, 3):
        length = math.dist(start[first : first + 3], end[first : first + 3])
        if length > 0.0:
            return length
    return 0.0


def compute_feed_mm_min(modal: ModalState, block: Block, length_mm: float) -> float:
    """Return the feed of a move of this length; ProgramError if none is in force."""
    if modal.feed_mode == 930:
        if "f" not in block.words:
            raise block.build_error("G93", "a feed move in inverse-time mode needs its own F word")
        modal.feed_mm_min = max(_MIN_INVERSE_TIME_FEED * modal.scale, length_mm * block.words["f"])
        return modal.feed_mm_min
    if modal.feed_mm_min <= 0.0:
        raise block.build_error(modal.code, "there is no feed rate; add F before a feed move")
    if modal.feed_mode == 950:
        if modal.spindle_rpm <= 0.0:
            raise block.build_error("G95", "feed per revolution needs a spindle speed; add S")
        return modal.feed_mm_min * modal.spindle_rpm
    return modal.feed_mm_min


def compute_spline_feed_mm_min(modal: ModalState, block: Block) -> float:
    """Return the feed of a spline; under G93 that of the previous move, since LinuxCNC has no inverse-time splines."""
    if modal.feed_mode != 930:
        return compute_feed_mm_min(modal, block, 0.0)
    code = modal.code
    if "f" not in block.words and modal.motion in (50, 51):
        raise block.build_error(code, "a feed move in inverse-time mode needs its own F word")
    if modal.feed_mm_min <= 0.0:
        raise block.build_error(code, "keeps the active feed under G93, but there is none; use G94 and F")
    return modal.feed_mm_min


def get_plane_axes(modal: ModalState, block: Block) -> tuple[int, int, int]:
    """Return the plane's axes as in ``PLANE_AXES``; ProgramError for a plane of U V W."""
    axes = PLANE_AXES.get(modal.plane_name)
    if axes is None:
        what = f"is not supported in the {modal.plane_name} plane; use G17, G18 or G19"
        raise block.build_error(modal.code, what)
    return axes


def find_axis_letter(block: Block) -> str | None:
    """Return one axis letter of the block, None without one."""
    return next((letter for letter in block.words if letter in INDEX or letter in "@^"), None)


def collect_axis_words(block: Block) -> dict[int, float]:
    """Return the block's axis words by axis index, in program units."""
    words = block.words
    return {INDEX[letter]: words[letter] for letter in AXES if letter in words}


def convert_to_mm(modal: ModalState, index: int, value: float) -> float:
    """Return an axis word in mm or degrees; X is a diameter under G7."""
    if index == 0 and modal.diameter:
        value /= 2.0
    return value * modal.get_unit(index)


def compute_target(modal: ModalState, block: Block) -> list[float]:
    """Return the target of the block's axis words in active co-ordinates; G53 words are machine co-ordinates."""
    words = collect_axis_words(block)
    polar = "@" in block.words or "^" in block.words
    if "machine co-ordinates" in block.g:
        if polar or not modal.absolute or modal.motion not in (0, 10):
            raise block.build_error("G53", "needs absolute X Y Z words (G90) and G0 or G1")
        whole = [c + t for c, t in zip(modal.convert_all_to_machine(), modal.tool, strict=True)]
        for index, value in words.items():
            whole[index] = convert_to_mm(modal, index, value)
        end = modal.convert_from_machine([w - t for w, t in zip(whole, modal.tool, strict=True)])
        for index in modal.wrapped.intersection(words):
            end[index] = _compute_wrapped_target(block, index, words[index], end[index], modal.position[index])
        return end
    end = list(modal.position)
    if polar:
        end[0], end[1] = _compute_polar_target(modal, block)
    for index, value in words.items():
        value = convert_to_mm(modal, index, value)
        if modal.absolute and index in modal.wrapped:
            value = _compute_wrapped_target(block, index, value, value, end[index])
        end[index] = value if modal.absolute else end[index] + value
    return end


def _compute_wrapped_target(block: Block, index: int, word: float, place: float, now: float) -> float:
    """Return the target of an absolute word of a wrapped rotary axis from ``now``: its sign is the direction.

    LinuxCNC 2.9, WRAPPED_ROTARY: the axis moves to the angle within a turn that is next in that direction.
    """
    if abs(word) >= 360.0:
        raise block.build_error(
            AXES[index], f"{word:g} is not a position of a wrapped rotary axis; use less than one turn"
        )
    end = abs(place) + math.floor(now / 360.0) * 360.0
    backward = math.copysign(1.0, word) < 0.0
    if backward:
        return end - 360.0 if end > now else end
    return end + 360.0 if end < now else end


def _compute_polar_target(modal: ModalState, block: Block) -> tuple[float, float]:
    """Return X and Y of polar words: @ is the distance from the origin, ^ the angle; a missing one is unchanged."""
    for letter in "xy":
        if letter in block.words:
            raise block.build_error(letter, "contradicts the polar words @ and ^ in the same block")
    letter = "@" if "@" in block.words else "^"
    if modal.plane != 0 and "plane" not in block.g:
        raise block.build_error(letter, "is a polar word, which needs the XY plane (G17)")
    x, y = modal.position[0], modal.position[1]
    if x == 0.0 and y == 0.0 and not ("^" in block.words and modal.absolute):
        raise block.build_error(letter, "there is no angle at the origin; add an absolute one by ^")
    distance, angle = math.hypot(x, y), math.degrees(math.atan2(y, x))
    if not modal.absolute:
        distance += block.words.get("@", 0.0) * modal.scale
        angle += block.words.get("^", 0.0)
    else:
        distance = block.words["@"] * modal.scale if "@" in block.words else distance
        angle = block.words.get("^", angle)
    return distance * math.cos(math.radians(angle)), distance * math.sin(math.radians(angle))
