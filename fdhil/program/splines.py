"""Splines as feeds along chords within a micrometre: G5 (cubic), G5.1 (quadratic), G5.2 and G5.3 (NURBS).

G5.2 begins with the present point, the following blocks give control points (X, Y, weight P), G5.3 orders the curve: a
B-spline of order L over an open uniform knot vector. Points in the XY plane are complex: x + j y.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from fdhil.program.expressions import is_whole
from fdhil.program.modal_state import NO_MOTION
from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.targets import collect_axis_words, compute_spline_feed_mm_min, compute_target
from fdhil.program.words import Block

BEZIER_CODES = (50, 51)
NURBS_BEGIN, NURBS_END = 52, 53
_CHORD_ERROR_MM = 0.001
_MAX_CHORDS = 20_000
_MAX_SPLITS = 12
_USUAL_ORDER = 3
Bezier = tuple[complex, complex, complex, complex]
Weighted = tuple[complex, float]  # a control point in mm of the active co-ordinates, and its weight


@dataclass(slots=True)
class SplineSeries:
    """State of a series of G5 blocks: the last control vector, mirrored if a block has no I and J."""

    leaving: complex | None = None


def order_spline(machine: MotionBuilder, series: SplineSeries, block: Block) -> None:
    """Order the spline of a G5 or G5.1 block as feeds; ProgramError if its words define none."""
    modal, words, code = machine.modal, block.words, machine.modal.code
    if modal.plane != 0:
        raise block.build_error(code, "works in the XY plane; use G17 first")
    if machine.compensation is not None:
        raise block.build_error(code, "cannot be used with cutter compensation on")
    if not collect_axis_words(block):
        raise block.build_error(code, "needs X or Y, the end of the curve")
    if any(axis > 1 for axis in collect_axis_words(block)):
        raise block.build_error(code, "moves only X and Y; remove the other axis words")
    whole = compute_target(modal, block)
    start, end = complex(*modal.position[:2]), complex(*whole[:2])
    feed = compute_spline_feed_mm_min(modal, block)
    heading = _read_vector(block, "ij", modal.scale)
    if modal.motion == 51:
        if heading is None:
            raise block.build_error(code, "needs I and J, the control point from the start")
        control = start + heading
        series.leaving = None
        modal.motion = NO_MOTION  # G5.1 is not modal
        points = (start, start + (control - start) * (2 / 3), end + (control - end) * (2 / 3), end)
    else:
        leaving = _read_vector(block, "pq", modal.scale)
        if leaving is None or ("p" in words) != ("q" in words) or ("i" in words) != ("j" in words):
            raise block.build_error(code, "needs both P and Q, and both or none of I and J")
        if heading is None:  # the first of a series starts without a direction, as in the reference
            heading = -series.leaving if series.leaving is not None else 0j
        series.leaving = leaving
        points = (start, start + heading, end + leaving, end)
    for place in _generate_bezier_chords(points):
        machine.move_line_to(block, [place.real, place.imag, *whole[2:]], feed)
    machine.move_line_to(block, whole, feed)


def _generate_bezier_chords(points: Bezier) -> Iterator[complex]:
    """Yield the corners between chords of a cubic Bezier curve; their number follows from its second derivative."""
    a, b, c, d = points
    bend = max(abs(a - 2 * b + c), abs(b - 2 * c + d))
    chords = min(_MAX_CHORDS, max(1, math.ceil(math.sqrt(6.0 * bend / (8.0 * _CHORD_ERROR_MM)))))
    for number in range(1, chords):
        t = number / chords
        u = 1.0 - t
        yield u * u * u * a + 3 * u * u * t * b + 3 * u * t * t * c + t * t * t * d


def _read_vector(block: Block, letters: str, scale: float) -> complex | None:
    if not any(letter in block.words for letter in letters):
        return None
    return complex(block.words.get(letters[0], 0.0), block.words.get(letters[1], 0.0)) * scale


@dataclass(slots=True)
class NurbsCurve:
    """The control points collected so far."""

    points: list[Weighted] = field(default_factory=list)
    order: int = _USUAL_ORDER

    def gather_point(self, machine: MotionBuilder, block: Block) -> None:
        """Add the control point of a G5.2 block; ProgramError if its words define none."""
        modal, words = machine.modal, block.words
        if modal.plane != 0:
            raise block.build_error("G5.2", "works in the XY plane; use G17 first")
        axes = collect_axis_words(block)
        compute_spline_feed_mm_min(modal, block)
        weight = words.get("p", None if self.points else 1.0)
        if weight is None or weight < 0.0:
            raise block.build_error("G5.2", "needs the weight of each control point as P, not negative")
        if not self.points:
            self.order = _read_order(block)
            self.points.append((complex(*modal.position[:2]), weight))
            if not axes:
                return
        if 0 not in axes or 1 not in axes:
            raise block.build_error("G5.2", "needs both X and Y of a control point")
        if len(self.points) >= machine.budget.max_motions_per_block:
            raise block.build_error("G5.2", f"has more than {len(self.points)} control points; split the curve")
        self.points.append((complex(*compute_target(modal, block)[:2]), weight))

    def order_motions(self, machine: MotionBuilder, block: Block) -> None:
        """Order the curve as feeds (G5.3) and clear its points; ProgramError if there are too few."""
        points, self.points = self.points, []
        if len(points) < max(self.order, 2):
            what = f"a curve of order {self.order} needs as many control points; {len(points)} were given"
            raise block.build_error("G5.3", what)
        if not any(weight for _, weight in points):
            raise block.build_error("G5.3", "all weights are zero; use a P that is not")
        places = list(_generate_nurbs_chords(points, self.order))
        feed = compute_spline_feed_mm_min(machine.modal, block)
        machine.modal.motion = NO_MOTION
        rest = machine.modal.position[2:]
        for place in places:
            machine.move_line_to(block, [place.real, place.imag, *rest], feed)


def _read_order(block: Block) -> int:
    value = block.words.get("l", float(_USUAL_ORDER))
    if not is_whole(value) or not 1 <= value <= 20:
        raise block.build_error("l", "is not a valid order; L must be a whole number from 2 to 20")
    order = round(value)
    return order if order > 1 else _USUAL_ORDER  # as LinuxCNC does


def _generate_nurbs_chords(points: list[Weighted], order: int) -> Iterator[complex]:
    left = 0
    for span in range(len(points) - order + 1):
        for part in range(4):  # a span may be S-shaped, so that its middle is not conclusive
            for place in _split_span(points, order, span + part / 4, span + (part + 1) / 4, _MAX_SPLITS):
                left += 1
                if left > _MAX_CHORDS:
                    return
                yield place


def _split_span(points: list[Weighted], order: int, begin: float, end: float, splits: int) -> Iterator[complex]:
    middle = (begin + end) / 2.0
    a, b = _compute_nurbs_point(points, order, begin), _compute_nurbs_point(points, order, end)
    if splits == 0 or _measure_distance(a, b, _compute_nurbs_point(points, order, middle)) < _CHORD_ERROR_MM / 2.0:
        yield b
        return
    yield from _split_span(points, order, begin, middle, splits - 1)
    yield from _split_span(points, order, middle, end, splits - 1)


def _measure_distance(a: complex, b: complex, point: complex) -> float:
    length = abs(b - a)
    if length < 1e-12:
        return abs(point - a)
    return abs(((b - a).conjugate() * (point - a)).imag) / length


def _compute_nurbs_point(points: list[Weighted], order: int, u: float) -> complex:
    """Return the curve's point at ``u``, by de Boor's algorithm in homogeneous co-ordinates."""
    last = len(points) - 1
    span = min(int(u), last - order + 1)
    index = span + order - 1

    def compute_knot(number: int) -> float:
        return float(min(max(number - order + 1, 0), last - order + 2))

    work = [(weight * place, weight) for place, weight in points[index - order + 1 : index + 1]]
    for level in range(1, order):
        for place in range(order - 1, level - 1, -1):
            low, high = compute_knot(index - order + 1 + place), compute_knot(index + 1 + place - level)
            share = (u - low) / (high - low)
            (one, light), (two, heavy) = work[place - 1], work[place]
            work[place] = (one + share * (two - one), light + share * (heavy - light))
    place_and_weight, weight = work[-1]
    return place_and_weight / weight if weight else points[index][0]
