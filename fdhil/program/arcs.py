"""Convert the words of G2 and G3 to arcs with a centre, within the tolerances of a control."""

from __future__ import annotations

import math

from fdhil.program.expressions import is_whole
from fdhil.program.modal_state import AXES, MM_PER_INCH, ModalState
from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.motions import SweptArc, sweep_arc
from fdhil.program.targets import collect_axis_words, compute_feed_mm_min, compute_target, get_plane_axes
from fdhil.program.words import Block

CODES = (20, 30)
_OFFSETS = "ijk"
_MIN_RADIUS_MM = 1e-6
# the radii at the ends of an arc may differ by the small one, or by 0.1 % up to the large one
_SPIRAL_SMALL = {1.0: math.sqrt(8.0) * 0.01, MM_PER_INCH: math.sqrt(8.0) * 0.001 * MM_PER_INCH}  # mm, by the units
_SPIRAL_LARGE = 100.0  # times the small one
_SPIRAL_RELATIVE = 0.001
_CHORD_ERROR_MM = 0.001
_CHORD_RELATIVE = 0.001  # by how much half the chord may exceed the radius of an R arc


def order_arc(machine: MotionBuilder, block: Block) -> None:
    """Order the arc of a G2 or G3 block; ProgramError if its words define none."""
    modal, words = machine.modal, block.words
    axes = first, second, normal = get_plane_axes(modal, block)
    by_radius = "r" in words
    if by_radius and any(letter in words for letter in _OFFSETS):
        raise block.build_error("r", "contradicts I, J or K in the same block; give the radius or the centre")
    named = collect_axis_words(block)
    end = compute_target(modal, block)
    here, there = (complex(place[first], place[second]) for place in (modal.position, end))
    clockwise = modal.motion == 20
    if by_radius:
        if first not in named and second not in named and "@" not in words and "^" not in words:
            raise block.build_error("r", "an arc by radius needs an end in its plane; a full circle needs its centre")
        centre = _compute_centre_from_radius_word(block, here, there, words["r"] * modal.scale, clockwise)
    else:
        centre = _compute_centre_from_offsets(modal, block, first, second)
        _check_radii(block, modal, abs(here - centre), abs(there - centre), f"{AXES[first]}, {AXES[second]}".upper())
    turns = -_read_turns(block) if clockwise else _read_turns(block)
    path = sweep_arc(modal.position, end, centre, turns, axes)
    feed = compute_feed_mm_min(modal, block, path.length_mm)
    if modal.rotation_deg and normal != 2:
        _order_tilted_arc(machine, block, end, path, axes, feed)
    else:
        machine.move_arc_to(block, end, centre, turns, feed, path.angle_rad)


def _order_tilted_arc(
    machine: MotionBuilder, block: Block, end: list[float], path: SweptArc, axes: tuple[int, int, int], feed: float
) -> None:
    """Order an arc in a rotated co-ordinate system as chords, since it lies in none of the planes."""
    first, second, _ = axes
    if machine.compensation is not None:
        what = "an arc outside the XY plane of a rotated system cannot be compensated; end compensation by G40 first"
        raise block.build_error(machine.modal.code, what)
    begin = list(machine.modal.position)
    x, y, radii = path.centre.real, path.centre.imag, path.radii
    step = 2.0 * math.acos(max(0.0, 1.0 - _CHORD_ERROR_MM / max(radii)))
    chords = min(math.ceil(abs(path.angle_rad) / step), machine.budget.max_motions_per_block)
    for number in range(1, chords):
        share = number / chords
        place = [a + (b - a) * share for a, b in zip(begin, end, strict=True)]
        radius, turned = radii[0] + (radii[1] - radii[0]) * share, path.begin_rad + path.angle_rad * share
        place[first], place[second] = x + radius * math.cos(turned), y + radius * math.sin(turned)
        machine.move_line_to(block, place, feed)
    machine.move_line_to(block, end, feed)


def _read_turns(block: Block) -> int:
    value = block.words.get("p", 1.0)
    turns = round(value)
    if not is_whole(value) or not 1 <= turns <= 1_000_000:
        raise block.build_error("p", "is not a valid number of turns; P must be a whole number from 1 to 1000000")
    return turns


def _compute_centre_from_offsets(modal: ModalState, block: Block, first: int, second: int) -> complex:
    letters = _OFFSETS[first], _OFFSETS[second]
    given = [letter for letter in letters if letter in block.words]
    wrong = [letter for letter in _OFFSETS if letter in block.words and letter not in letters]
    if wrong:
        raise block.build_error(
            wrong[0], f"defines no centre in the {modal.plane_name} plane; change the plane or the letter"
        )
    if not given:
        raise block.build_error(modal.code, "an arc needs its centre (I J K) or its radius (R)")
    if modal.arc_absolute and len(given) < 2:
        raise block.build_error(given[0], "an absolute centre (G90.1) needs both of its words")
    values = [block.words.get(letter, 0.0) * modal.scale for letter in letters]
    centre = complex(values[0], values[1])
    return centre if modal.arc_absolute else complex(modal.position[first], modal.position[second]) + centre


def _check_radii(block: Block, modal: ModalState, begin_mm: float, finish_mm: float, axes: str) -> None:
    word = next(letter for letter in _OFFSETS if letter in block.words)
    if begin_mm < _MIN_RADIUS_MM or finish_mm < _MIN_RADIUS_MM:
        raise block.build_error(word, "the arc has no radius; move the centre away from start and end")
    if not is_radius_difference_allowed(begin_mm, finish_mm, modal.scale):
        raise block.build_error(word, f"the radius is {begin_mm:.4f} mm at the start and {finish_mm:.4f} mm at the "
                                      f"end of "
                                f"the arc; correct centre or end ({axes})")  # fmt: skip


def is_radius_difference_allowed(begin_mm: float, finish_mm: float, scale: float) -> bool:
    """Return whether the radii at both ends of an arc are close enough (``scale``: mm per program unit)."""
    off, small = abs(begin_mm - finish_mm), _SPIRAL_SMALL[scale]
    return off <= small or off <= min(_SPIRAL_LARGE * small, _SPIRAL_RELATIVE * max(begin_mm, finish_mm))


def _compute_centre_from_radius_word(
    block: Block, start: complex, end: complex, radius_mm: float, clockwise: bool
) -> complex:
    half = abs(end - start) / 2.0
    if half < _MIN_RADIUS_MM:
        raise block.build_error("r", "an arc by radius ends where it starts; give the centre of a full circle")
    if abs(radius_mm) < half * (1.0 - _CHORD_RELATIVE):
        raise block.build_error("r", f"is too small a radius to reach the end, {2 * half:.4f} mm away")
    return compute_arc_centre(start, end, radius_mm, clockwise)


def compute_arc_centre(start: complex, end: complex, radius: float, clockwise: bool) -> complex:
    """Return the centre of an arc of a radius between two points; a negative radius selects the longer way round."""
    half = abs(end - start) / 2.0
    height = math.sqrt(max(0.0, radius * radius - half * half))
    side = -1.0 if clockwise == (radius > 0) else 1.0
    return (start + end) / 2.0 + side * height * 1j * (end - start) / (2.0 * half)
