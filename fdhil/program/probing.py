"""Probe moves G38.2 to G38.5: they are assumed to reach their targets, since the touch point is unknown."""

from __future__ import annotations

from fdhil.program.machine import Machine
from fdhil.program.parameters import Variables
from fdhil.program.targets import axis_words, feed_mm_min, straight_length, target
from fdhil.program.words import Block

CODES = (382, 383, 384, 385)
_MIN_LENGTH_MM = 0.254
_PROBED_FIRST, _HIT = 5061, 5070


def probe(machine: Machine, variables: Variables, block: Block) -> None:
    """Order a probe move to its target, with #5061 and on as its end and #5070 as 0 (no touch)."""
    modal = machine.modal
    code = modal.code
    if modal.feed_mode == 930 or modal.feed_mm_min <= 0.0:
        raise block.fault(code, "needs a feed rate per minute; add F")
    end = target(modal, block)
    if not axis_words(block):
        raise block.fault(code, "needs the axis words of its target")
    if straight_length(modal.position, end) < _MIN_LENGTH_MM:
        raise block.fault(code, "starts too close to its target")
    machine.probe_to(block, end, feed_mm_min(modal, block, 0.0))
    for axis, value in enumerate(end):
        variables.store(_PROBED_FIRST + axis, value / modal.unit(axis))
    variables.store(_HIT, 0.0)
