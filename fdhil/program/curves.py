"""Splines G5 (cubic) and G5.1 (quadratic) as feeds along chords that stay within a micrometre of the curve."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.program.machine import Machine
from fdhil.program.modal import NO_MOTION
from fdhil.program.targets import axis_words, spline_feed_mm_min, target
from fdhil.program.words import Block

CODES = (50, 51)
_CHORD_ERROR_MM = 0.001
_MAX_CHORDS = 20_000
Vector = tuple[float, float]


@dataclass(slots=True)
class Spline:
    """What a series of G5 blocks shares: the last control vector, mirrored where a block gives no I and J."""

    leaving: Vector | None = None


def spline(machine: Machine, block: Block, series: Spline) -> None:
    """Order the spline of a G5 or G5.1 block as feeds; ProgramError for words that give none."""
    modal = machine.modal
    code = modal.code
    if modal.plane != 0:
        raise block.fault(code, "works in the XY plane; give G17 first")
    if machine.compensation is not None:
        raise block.fault(code, "cannot be used with cutter compensation on")
    if not axis_words(block):
        raise block.fault(code, "wants X or Y, the end of the curve")
    if any(axis > 1 for axis in axis_words(block)):
        raise block.fault(code, "moves X and Y alone; take the other axis words out")
    start, end = modal.position, target(modal, block)
    a, d = (start[0], start[1]), (end[0], end[1])
    feed = spline_feed_mm_min(modal, block)
    heading = _vector(block, "ij", modal.scale)
    if modal.motion == 51:
        if heading is None:
            raise block.fault(code, "wants I and J, the control point from the start")
        control = _plus(a, heading)
        series.leaving = None
        modal.motion = NO_MOTION  # G5.1 does not stay in force
        points = (a, _between(a, control, 2 / 3), _between(d, control, 2 / 3), d)
    else:
        leaving = _vector(block, "pq", modal.scale)
        words = block.words
        if leaving is None or ("p" in words) != ("q" in words) or ("i" in words) != ("j" in words):
            raise block.fault(code, "wants both P and Q, and I and J both or none")
        if heading is None:  # the first of a series leaves without a direction of its own, as in the reference
            heading = (-series.leaving[0], -series.leaving[1]) if series.leaving is not None else (0.0, 0.0)
        series.leaving = leaving
        points = (a, _plus(a, heading), _plus(d, leaving), d)
    _order(machine, block, points, end, feed)


def _order(
    machine: Machine, block: Block, points: tuple[Vector, Vector, Vector, Vector], end: list[float], feed: float
) -> None:
    """Order chords of a cubic Bezier curve; their number follows from its second derivative."""
    bends = [math.hypot(p[0] - 2 * q[0] + r[0], p[1] - 2 * q[1] + r[1]) for p, q, r in (points[:3], points[1:])]
    chords = min(_MAX_CHORDS, max(1, math.ceil(math.sqrt(6.0 * max(bends) / (8.0 * _CHORD_ERROR_MM)))))
    places = [_at(points, number / chords) for number in range(chords + 1)]
    for x, y in places[1:-1]:
        machine.feed_at(block, [x, y, *end[2:]], feed)
    machine.feed_at(block, end, feed)


def _at(points: tuple[Vector, Vector, Vector, Vector], t: float) -> Vector:
    u = 1.0 - t
    weights = (u * u * u, 3 * u * u * t, 3 * u * t * t, t * t * t)
    return (
        sum(w * p[0] for w, p in zip(weights, points, strict=True)),
        sum(w * p[1] for w, p in zip(weights, points, strict=True)),
    )


def _vector(block: Block, letters: str, scale: float) -> Vector | None:
    if not any(letter in block.words for letter in letters):
        return None
    return (block.words.get(letters[0], 0.0) * scale, block.words.get(letters[1], 0.0) * scale)


def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1])


def _between(a: Vector, b: Vector, share: float) -> Vector:
    return (a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share)
