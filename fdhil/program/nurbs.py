"""NURBS G5.2 and G5.3 as feeds along chords that stay within a micrometre of the curve.

G5.2 begins with the present point, the blocks after it give control points (X, Y, weight P), G5.3 orders the curve: a
B-spline of order L over an open uniform knot vector.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from fdhil.program.machine import Machine
from fdhil.program.modal import NO_MOTION
from fdhil.program.targets import axis_words, spline_feed_mm_min, target
from fdhil.program.words import Block

BEGIN, END = 52, 53
_CHORD_ERROR_MM = 0.001
_MAX_CHORDS = 20_000
_MAX_SPLITS = 12
_USUAL_ORDER = 3
Point = tuple[float, float]


@dataclass(slots=True)
class Nurbs:
    """The control points gathered so far, each (x, y, weight) in mm of the active co-ordinates."""

    points: list[tuple[float, float, float]] = field(default_factory=list)
    order: int = _USUAL_ORDER

    def gather(self, machine: Machine, block: Block) -> None:
        """Take the control point of a block of G5.2; ProgramError for words that give none."""
        modal, words = machine.modal, block.words
        if modal.plane != 0:
            raise block.fault("G5.2", "works in the XY plane; give G17 first")
        axes = axis_words(block)
        spline_feed_mm_min(modal, block)
        weight = words.get("p", None if self.points else 1.0)
        if weight is None or weight < 0.0:
            raise block.fault("G5.2", "wants the weight of each control point as P, not negative")
        if not self.points:
            self.order = _order(block)
            self.points.append((modal.position[0], modal.position[1], weight))
            if not axes:
                return
        if 0 not in axes or 1 not in axes:
            raise block.fault("G5.2", "wants both X and Y of a control point")
        if len(self.points) >= machine.budget.max_motions_per_block:
            raise block.fault("G5.2", f"has more than {len(self.points)} control points; split the curve")
        place = target(modal, block)
        self.points.append((place[0], place[1], weight))

    def order_motions(self, machine: Machine, block: Block) -> None:
        """Order the curve as feeds (G5.3) and forget its points; ProgramError when there are too few."""
        points, self.points = self.points, []
        if len(points) < max(self.order, 2):
            what = f"a curve of order {self.order} wants as many control points; {len(points)} were given"
            raise block.fault("G5.3", what)
        if not any(weight for _, _, weight in points):
            raise block.fault("G5.3", "all weights are zero; give one P that is not")
        places = list(_chords(points, self.order))
        feed = spline_feed_mm_min(machine.modal, block)
        machine.modal.motion = NO_MOTION
        rest = machine.modal.position[2:]
        for x, y in places[1:]:
            machine.feed_at(block, [x, y, *rest], feed)


def _order(block: Block) -> int:
    value = block.words.get("l", float(_USUAL_ORDER))
    if abs(value - round(value)) > 1e-4 or not 1 <= value <= 20:
        raise block.fault("l", "is no order of a curve; L must be a whole number from 2 to 20")
    order = round(value)
    return order if order > 1 else _USUAL_ORDER  # as LinuxCNC does


def _chords(points: list[tuple[float, float, float]], order: int) -> Iterator[Point]:
    """Yield the corners of a polyline beside the curve, each span halved until its middle is near its chord."""
    spans = len(points) - order + 1
    left = 0
    for span in range(spans):
        begin, end = float(span), float(span + 1)
        if span == 0:
            yield _at(points, order, begin)
        for part in range(4):  # a span may be S-shaped, so that its middle tells nothing
            a, b = begin + part * (end - begin) / 4, begin + (part + 1) * (end - begin) / 4
            for place in _split(points, order, a, b, _MAX_SPLITS):
                left += 1
                if left > _MAX_CHORDS:
                    return
                yield place


def _split(
    points: list[tuple[float, float, float]], order: int, begin: float, end: float, splits: int
) -> Iterator[Point]:
    a, b = _at(points, order, begin), _at(points, order, end)
    middle = _at(points, order, (begin + end) / 2.0)
    if splits == 0 or _beside(a, b, middle) < _CHORD_ERROR_MM / 2.0:
        yield b
        return
    yield from _split(points, order, begin, (begin + end) / 2.0, splits - 1)
    yield from _split(points, order, (begin + end) / 2.0, end, splits - 1)


def _beside(a: Point, b: Point, point: Point) -> float:
    length = math.dist(a, b)
    if length < 1e-12:
        return math.dist(a, point)
    return abs((b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])) / length


def _at(points: list[tuple[float, float, float]], order: int, u: float) -> Point:
    """The curve's point at ``u``, by de Boor's algorithm in homogeneous co-ordinates."""
    last = len(points) - 1
    span = min(int(u), last - order + 1)
    index = span + order - 1

    def knot(number: int) -> float:
        return float(min(max(number - order + 1, 0), last - order + 2))

    work = [(w * x, w * y, w) for x, y, w in points[index - order + 1 : index + 1]]
    for level in range(1, order):
        for place in range(order - 1, level - 1, -1):
            low, high = knot(index - order + 1 + place), knot(index + 1 + place - level)
            share = (u - low) / (high - low)
            one, two = work[place - 1], work[place]
            work[place] = (
                one[0] + share * (two[0] - one[0]),
                one[1] + share * (two[1] - one[1]),
                one[2] + share * (two[2] - one[2]),
            )
    x, y, w = work[-1]
    return (x / w, y / w) if w else (points[index][0], points[index][1])
