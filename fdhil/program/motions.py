"""The motions that a program orders, in machine millimetres: output of the interpreter, input of the planner."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

Point = tuple[float, float, float]
ALL_AXES = "XYZABCUVW"
Place = tuple[float, ...]  # of ALL_AXES: mm, of A B C degrees
ORIGIN: Place = (0.0,) * len(ALL_AXES)
PLANES = ("XY", "XZ", "YZ")
# plane -> indices of its two axes, ordered so that a positive angle is counter-clockwise seen from the positive end of
# the normal axis, then the normal axis; XZ rotates about +Y from Z to X
PLANE_AXES = {"XY": (0, 1, 2), "XZ": (2, 0, 1), "YZ": (1, 2, 0)}


@dataclass(frozen=True, slots=True)
class Corner:
    """How the path may leave a motion's end: G61 on the exact path, G61.1 from an exact stop, G64 by a blend.

    ``tolerance_mm`` is the largest deviation of a blend from the path (P); infinite if the program gives none.
    ``joining_mm`` is the largest deviation of short lines from the one that they are joined to (Q).
    """

    mode: Literal["exact_path", "exact_stop", "blend"] = "blend"
    tolerance_mm: float = math.inf
    joining_mm: float = 0.0


BLEND = Corner()


class AxisMove(NamedTuple):
    """The order for one axis of A B C (degrees) U V W (mm) in machine co-ordinates."""

    axis: str
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Rapid:
    """G0: a straight line at rapid speed to ``end`` (mm); ``line`` is the 1-based source line.

    ``rotary`` are the axes other than X, Y and Z that the block names or moves.
    """

    line: int
    end: Point
    corner: Corner = BLEND
    rotary: tuple[AxisMove, ...] = ()


@dataclass(frozen=True, slots=True)
class Feed:
    """G1: a straight line to ``end`` (mm) at ``feed`` mm/min; of A B C alone degrees/min."""

    line: int
    end: Point
    feed: float
    corner: Corner = BLEND
    rotary: tuple[AxisMove, ...] = ()


@dataclass(frozen=True, slots=True)
class Probe(Feed):
    """G38.2 to G38.5: a feed to its target, which ends where the probe touches or leaves: unknown in advance."""


@dataclass(frozen=True, slots=True)
class Arc:
    """G2, G3: an arc, circle or helix to ``end`` (mm) at ``feed`` mm/min about ``centre``, None on the normal axis.

    ``turns`` is 1 up to and including one circle, n for n - 1 additional full circles, negative clockwise seen from the
    positive end of the normal axis; ``plane`` is one of ``PLANES``. If start and end have different radii, the radius
    changes linearly with the angle.
    """

    line: int
    end: Point
    centre: tuple[float | None, float | None, float | None]
    turns: int
    plane: str
    feed: float
    corner: Corner = BLEND
    rotary: tuple[AxisMove, ...] = ()


@dataclass(frozen=True, slots=True)
class Dwell:
    """G4: stand still for ``seconds``."""

    line: int
    seconds: float


Motion = Rapid | Feed | Arc | Dwell


def compute_end(motion: Rapid | Feed | Arc, start: Place) -> Place:
    """Return where a motion from ``start`` ends, of all axes."""
    end = [*motion.end, *start[3:]]
    for turned in motion.rotary:
        end[ALL_AXES.index(turned.axis)] = turned.end
    return tuple(end)


class SweptArc(NamedTuple):
    """An arc's geometry in mm and rad: its ``centre``, the ``radii`` at its ends, start angle and swept angle.

    Points in a plane are complex: first + j second axis.
    """

    centre: complex
    radii: tuple[float, float]
    begin_rad: float
    angle_rad: float
    rise_mm: float
    length_mm: float

    @staticmethod
    def create_from_arc(motion: Arc, start: Sequence[float]) -> SweptArc:
        """Return the geometry of an arc from ``start``."""
        axes = PLANE_AXES[motion.plane]
        centre = complex(motion.centre[axes[0]] or 0.0, motion.centre[axes[1]] or 0.0)
        return sweep_arc(start, motion.end, centre, motion.turns, axes)


def sweep_arc(
    start: Sequence[float], end: Sequence[float], centre: complex, turns: int, axes: tuple[int, int, int]
) -> SweptArc:
    """Return the arc from start to end about a centre in the plane of ``axes`` (first, second, normal)."""
    first, second, normal = axes
    begin = complex(start[first], start[second]) - centre
    finish = complex(end[first], end[second]) - centre
    radii = abs(begin), abs(finish)
    angle = _compute_swept_rad(begin, finish, turns)
    rise = end[normal] - start[normal]
    length = math.hypot((radii[0] + radii[1]) / 2.0 * angle, rise)
    return SweptArc(centre, radii, cmath.phase(begin), angle, rise, length)


def _compute_swept_rad(begin: complex, finish: complex, turns: int) -> float:
    """Return the signed angle (rad) from one radius to the other: coincident ones give a full circle."""
    circle = 2.0 * math.pi
    angle = math.remainder(cmath.phase(finish) - cmath.phase(begin), circle)
    if abs(angle) < 1e-12:
        angle = 0.0
    if turns > 0 and angle <= 0.0:
        angle += circle
    elif turns < 0 and angle >= 0.0:
        angle -= circle
    return angle + (turns - (1 if turns > 0 else -1)) * circle


def serialise_motion(motion: Motion) -> dict[str, Any]:
    """Return one motion as the object that ``interpret --json`` lists: mm, mm/min and s with 6 decimals."""
    if isinstance(motion, Dwell):
        return {"line": motion.line, "kind": "dwell", "seconds": round(motion.seconds, 6)}
    shown: dict[str, Any] = {
        "line": motion.line,
        "kind": type(motion).__name__.lower(),
        "end": [_round_coordinate(value) for value in motion.end],
    }
    if isinstance(motion, Arc):
        shown["centre"] = [None if value is None else _round_coordinate(value) for value in motion.centre]
        shown["turns"] = motion.turns
        shown["plane"] = motion.plane
    if not isinstance(motion, Rapid):
        shown["feed"] = _round_coordinate(motion.feed)
    if motion.rotary:
        shown["rotary"] = {turned.axis: _round_coordinate(turned.end) for turned in motion.rotary}
    return shown


def _round_coordinate(value: float) -> float:
    return round(value, 6) + 0.0  # + 0.0 makes the negative zero positive
