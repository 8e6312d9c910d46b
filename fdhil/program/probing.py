"""Probe moves G38.2 to G38.5: they are assumed to reach their targets, since the touch point is unknown."""

from __future__ import annotations

from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.parameters import ProgramVariables
from fdhil.program.targets import collect_axis_words, compute_feed_mm_min, compute_target, measure_straight_length
from fdhil.program.words import Block

CODES = (382, 383, 384, 385)
_MIN_LENGTH_MM = 0.254
_PROBED_FIRST, _HIT = 5061, 5070


def order_probe_move(machine: MotionBuilder, variables: ProgramVariables, block: Block) -> None:
    """Order a probe move to its target, with #5061 and on as its end and #5070 as 0 (no touch)."""
    modal = machine.modal
    code = modal.code
    if modal.feed_mode == 930 or modal.feed_mm_min <= 0.0:
        raise block.build_error(code, "needs a feed rate per minute; add F")
    end = compute_target(modal, block)
    if not collect_axis_words(block):
        raise block.build_error(code, "needs the axis words of its target")
    if measure_straight_length(modal.position, end) < _MIN_LENGTH_MM:
        raise block.build_error(code, "starts too close to its target")
    machine.probe_to(block, end, compute_feed_mm_min(modal, block, 0.0))
    for axis, value in enumerate(end):
        variables.store_number(_PROBED_FIRST + axis, value / modal.get_unit(axis))
    variables.store_number(_HIT, 0.0)
