"""Motions that follow the spindle: G33 (synchronised feed), G33.1 (rigid tapping) and G76 (threading cycle)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from fdhil.program.modal_state import ModalState
from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.targets import collect_axis_words, compute_target
from fdhil.program.words import Block

_MAX_PASSES = 10_000


def order_synchronised_feed(machine: MotionBuilder, block: Block) -> None:
    """G33 feeds K per revolution to its target; G33.1 feeds there and back to its start."""
    modal = machine.modal
    code = modal.code
    if not collect_axis_words(block):
        raise block.build_error(code, "needs axis words")
    if "k" not in block.words:
        raise block.build_error(code, "needs K, the distance per revolution")
    start = list(modal.position)
    feed = _compute_synchronous_feed(modal, block, abs(block.words["k"]) * modal.scale)
    machine.move_line_to(block, compute_target(modal, block), feed)
    if modal.motion == 331:
        machine.move_line_to(block, start, feed * abs(block.words.get("i", 1.0)))


def _compute_synchronous_feed(modal: ModalState, block: Block, pitch_mm: float) -> float:
    if modal.spindle_turns == 0:
        code = modal.code
        raise block.build_error(code, "needs a turning spindle; use S and M3 or M4 first")
    return pitch_mm * modal.spindle_rpm


@dataclass(frozen=True, slots=True)
class ThreadGeometry:
    """A thread in mm.

    ``offset`` from the drive line to its crest (negative outside), total ``depth``, depth ``first`` of the first pass,
    ``degression`` of the later ones, ``slide`` = tan of the compound's angle, ``taper`` lengths.
    """

    feed: float
    offset: float
    first: float
    depth: float
    degression: float
    slide: float
    springs: int
    taper: float
    at_entry: bool
    at_exit: bool

    @property
    def taper_feed(self) -> float:
        """Feed along a taper that keeps the pitch along Z."""
        return self.feed * math.hypot(self.depth, self.taper) / self.taper if self.taper else self.feed

    def list_depths(self) -> Iterator[float]:
        """Yield the depth of each pass, the full one ``springs`` times more."""
        number, depth, crest = 1, self.first, abs(self.offset)
        while (
            crest + depth < crest + self.depth and number < _MAX_PASSES
        ):  # rounded from the drive line, as in LinuxCNC
            yield depth
            number += 1
            depth = self.first * number ** (1.0 / self.degression)
        for _ in range(1 + self.springs):
            yield self.depth


def order_threading_cycle(machine: MotionBuilder, block: Block) -> None:
    """G76: passes of growing depth from the drive line (X at the start) along Z, and a rapid to the end."""
    modal = machine.modal
    thread = _read_thread(modal, block)
    end = compute_target(modal, block)
    start = list(modal.position)
    for depth in thread.list_depths():
        _order_pass(machine, block, thread, start, end[2], depth)
    machine.move_rapid_to(block, end)


def _order_pass(
    machine: MotionBuilder, block: Block, thread: ThreadGeometry, start: list[float], end_z: float, depth: float
) -> None:
    outward = 1.0 if thread.offset > 0.0 else -1.0
    along = 1.0 if end_z > start[2] else -1.0
    clear = start[0] - outward * (thread.depth - depth)
    crest, root = clear + thread.offset, clear + thread.offset + outward * thread.depth
    first_z = start[2] + along * depth * thread.slide
    last_z = end_z - along * (thread.depth - depth) * thread.slide

    def build_position(x: float, z: float) -> list[float]:
        return [x, start[1], z, *start[3:]]

    machine.move_rapid_to(block, build_position(clear, first_z))
    if thread.at_entry:
        machine.move_line_to(block, build_position(crest, first_z), thread.taper_feed)
        machine.move_line_to(block, build_position(root, first_z + along * thread.taper), thread.taper_feed)
    else:
        machine.move_rapid_to(block, build_position(root, first_z))
    if thread.at_exit:
        machine.move_line_to(block, build_position(root, last_z - along * thread.taper), thread.feed)
        machine.move_line_to(block, build_position(crest, last_z), thread.taper_feed)
    else:
        machine.move_line_to(block, build_position(root, last_z), thread.feed)
    machine.move_rapid_to(block, build_position(clear, last_z))


def _read_thread(modal: ModalState, block: Block) -> ThreadGeometry:
    words = block.words
    if not collect_axis_words(block):
        raise block.build_error("G76", "needs Z, the thread's end")
    for letter, meaning in (
        ("p", "the pitch"),
        ("i", "the thread's offset"),
        ("j", "the first depth"),
        ("k", "the depth"),
    ):
        if letter not in words:
            raise block.build_error("G76", f"needs {letter.upper()}, {meaning}")
    if words["i"] == 0.0 or words["p"] <= 0.0 or not 0.0 < words["j"] < words["k"]:
        raise block.build_error("G76", "needs P and J greater than 0, K greater than J, and I other than 0")
    ends = round(words.get("l", 0.0))
    degression, springs, angle = words.get("r", 1.0), words.get("h", 0.0), words.get("q", 0.0)
    if ends < 0 or springs != round(springs) or springs > _MAX_PASSES or not abs(angle) < 89.0:
        raise block.build_error("G76", "needs H whole, L not negative, and Q below 89 degrees")
    half = modal.scale * (0.5 if modal.diameter else 1.0)
    return ThreadGeometry(
        feed=_compute_synchronous_feed(modal, block, words["p"] * modal.scale),
        offset=words["i"] * half,
        first=words["j"] * half,
        depth=words["k"] * half,
        degression=max(1.0, degression),
        slide=math.tan(math.radians(angle)),
        springs=round(springs),
        taper=words.get("e", 0.0) * modal.scale,
        at_entry=ends in (1, 3),
        at_exit=ends in (2, 3),
    )
