"""Motions that follow the spindle: G33 (synchronised feed), G33.1 (rigid tapping) and G76 (threading cycle)."""

from __future__ import annotations

from fdhil.errors import ProgramError
from fdhil.program.machine import Machine
from fdhil.program.targets import axis_words, target
from fdhil.program.words import Block


def synchronised(machine: Machine, block: Block) -> None:
    """G33 is a feed of K per revolution to its target; G33.1 feeds there and back to where it started."""
    modal = machine.modal
    code = f"G{modal.motion / 10:g}"
    if not axis_words(block):
        raise ProgramError(block.line, code, "wants axis words")
    if "k" not in block.words:
        raise ProgramError(block.line, code, "wants K, the distance per revolution")
    if modal.spindle_turns == 0 or modal.spindle_rpm <= 0.0:
        raise ProgramError(block.line, code, "wants a turning spindle; give S and M3 or M4 first")
    start = list(modal.position)
    feed = abs(block.words["k"]) * modal.scale * modal.spindle_rpm
    machine.feed_at(block, target(modal, block), feed)
    if modal.motion == 331:
        machine.feed_at(block, start, feed * abs(block.words.get("i", 1.0)))
