"""Contours of a turned part: lines and arcs in the ZX plane, as complex numbers z + j x, and their parallels.

Geometry for G70 to G72: intersections with a height, mirror images, parallels at a distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

_NEAR = 1e-6
_SHORT = 1e-3  # shorter parts are omitted from a parallel
_GAP = 1e-2  # smallest gap at an outside corner that an arc closes
_MAX_STEPS = 5_000


class ContourError(Exception):
    """A contour that cannot be machined; the message is the reason, without line and word."""


@dataclass(slots=True)
class ContourPart:
    """A line from ``start`` to ``end``, or with a ``centre`` an arc, counter-clockwise (from Z to X) if ``ccw``.

    ``corner`` other than 0 marks a corner to be rounded by that radius (with a centre) or cut (without).
    """

    start: complex
    end: complex
    centre: complex | None = None
    ccw: bool = False
    corner: float = 0.0

    @property
    def size(self) -> float:
        """The shortest length in it: of the chord, and of an arc's radius."""
        chord = abs(self.start - self.end)
        return chord if self.centre is None else min(chord, abs(self.start - self.centre))

    def map_part(self, turn: Callable[[complex], complex], mirrored: bool) -> ContourPart:
        """Return its image under a rotation or reflection."""
        centre = None if self.centre is None else turn(self.centre)
        return ContourPart(turn(self.start), turn(self.end), centre, self.ccw != mirrored, self.corner)

    def is_falling(self) -> bool:
        """Return whether z never increases along it, within tolerance."""
        dz = (self.end - self.start).real
        if self.centre is None:
            return dz <= _SHORT
        if self.corner:
            return True
        entry, leaving = (self.start - self.centre).imag, (self.end - self.centre).imag
        sign = 1.0 if self.ccw else -1.0
        return sign * entry >= -_SHORT and sign * leaving >= -_SHORT and dz <= -_SHORT

    def find_crossings(self, x: float) -> list[float]:
        """Return the z at which it has the height ``x``: both ends of a level line."""
        if self.centre is not None:
            return self._find_arc_crossings(self.centre, x)
        low, high = sorted((self.start.imag, self.end.imag))
        if low > x + _NEAR or high < x - _NEAR:
            return []
        rise = self.end.imag - self.start.imag
        if abs(rise) < _NEAR:
            return [self.start.real, self.end.real]
        return [(x - self.start.imag) / rise * (self.end.real - self.start.real) + self.start.real]

    def _find_arc_crossings(self, centre: complex, x: float) -> list[float]:
        radius = abs(self.start - centre)
        square = -(x - radius - centre.imag) * (x + radius - centre.imag)
        if square < -_NEAR:
            return []
        half = math.sqrt(max(0.0, square))
        places = (complex(centre.real + half, x), complex(centre.real - half, x))
        return [place.real for place in places if self._is_on_arc(centre, place)]

    def _is_on_arc(self, centre: complex, place: complex) -> bool:
        sign = 1.0 if self.ccw else -1.0
        first, last = ((end - centre).conjugate() * (place - centre) for end in (self.start, self.end))
        return sign * first.imag >= -_NEAR and sign * last.imag <= _NEAR

    def shift_sideways(self, distance: float) -> None:
        """Move it to its parallel, to the left of its direction from end to start."""
        if self.centre is None:
            way = self.start - self.end
            aside = 1j * distance * way
            length = abs(way)
            if length == 0.0:
                raise ContourError("a line of the contour has no length; its corners use all of it")
            step = complex(aside.real / length, aside.imag / length)
            self.start, self.end = self.start + step, self.end + step
            return
        radius = abs(self.start - self.centre)
        if radius == 0.0:
            raise ContourError("an arc of the contour has no radius")
        share = (radius + (distance if self.ccw else -distance)) / radius
        self.start = share * (self.start - self.centre) + self.centre
        self.end = share * (self.end - self.centre) + self.centre


@dataclass(slots=True)
class Contour:
    """A contour and its orientation: ``parts`` are the programmed ones rotated by ``turn`` after mirroring."""

    parts: list[ContourPart]
    turn: complex = 1.0 + 0.0j
    mirrored: bool = False

    def copy(self) -> Contour:
        """Return an independent copy."""
        return Contour([replace(part) for part in self.parts], self.turn, self.mirrored)

    def convert_to_program(self, place: complex) -> complex:
        """Return a point in the program's orientation."""
        back = self.turn.conjugate() * place
        return back.conjugate() if self.mirrored else back

    def lay_out(self, along_x: bool) -> None:
        """Rotate and mirror it for a cut along Z or ``along_x``, and finish its corners; ContourError on failure."""
        if along_x:
            self.rotate_quarter_turn()
        self.mirror_downwards()
        self.finish_corners()
        self.check_falling()

    def rotate_quarter_turn(self) -> None:
        """Rotate it so that x becomes z."""
        self._map_parts(-1j, False)

    def mirror_downwards(self) -> None:
        """Mirror it so that both z and x are larger at the end of its first part than at its end."""
        way = self.parts[0].end - self.parts[-1].end
        if way.imag > 0.0:
            self._map_parts(1.0 + 0.0j, True)
        if way.real < 0.0:
            self._map_parts(-1.0 + 0.0j, True)

    def _map_parts(self, turn: complex, mirrored: bool) -> None:
        def map_point(place: complex) -> complex:
            return turn * (place.conjugate() if mirrored else place)

        self.parts = [part.map_part(map_point, mirrored) for part in self.parts]
        self.turn = turn * (self.turn.conjugate() if mirrored else self.turn)
        self.mirrored = self.mirrored != mirrored

    def finish_corners(self) -> None:
        """Round and cut the marked corners; ContourError if they are too small."""
        for before, part, after in zip(self.parts, self.parts[1:], self.parts[2:], strict=False):
            if part.corner:
                _finish_corner(before, part, after)
        self.parts = [part for part in self.parts if part.size >= _SHORT]

    def check_falling(self) -> None:
        """Raise ContourError unless z falls along all of it; a first part that leads back is set upright."""
        first = self.parts[0]
        if (first.end - first.start).real > 0.0:
            first.start = complex(first.end.real, first.start.imag)
        if not all(part.is_falling() for part in self.parts):
            raise ContourError("its contour does not continue in one direction along the cut")

    def move_to_parallel(self, distance: float) -> None:
        """Move all but the first part to the parallel at ``distance``; the first one ends where that begins.

        ContourError if the parts cannot be joined.
        """
        first = self.parts[0]
        across = (first.end - first.start) * (self.parts[-1].start - first.start).conjugate()
        parts = self.parts[1:]
        if across.imag < 0.0:
            distance = -distance
        done = 0.0
        for _ in range(_MAX_STEPS):
            if done == distance or not parts:
                break
            step = min(min(part.size for part in parts) / 2.0, abs(distance - done))
            step = -step if distance < 0.0 else step
            parts = _join_parts(_shift_parts(parts, step))
            done += step
        if not parts or done != distance:
            raise ContourError("the contour has no parallel at the finishing allowance; use a smaller D")
        for before, after in pairwise(parts):
            before.end = after.start = (before.end + after.start) / 2.0
        first.end = parts[0].start
        self.parts = [first, *parts]


def _finish_corner(before: ContourPart, part: ContourPart, after: ContourPart) -> None:
    for distance in (part.corner, -part.corner):
        one, two = replace(before), replace(after)
        one.shift_sideways(distance)
        two.shift_sideways(distance)
        if (one.end - two.start).real <= _GAP:
            break
    else:
        raise ContourError("a corner is too small for the rounding or cut by A or C")
    _cut_at_intersection(one, two)
    centre = (one.end + two.start) / 2.0
    one.shift_sideways(-distance)
    two.shift_sideways(-distance)
    part.start = before.end = one.end
    part.end = after.start = two.start
    if part.centre is not None:
        part.centre, part.corner = centre, 0.0
        part.ccw = (part.start - centre).imag > 0.0 or (part.end - centre).imag > 0.0


def _shift_parts(parts: list[ContourPart], step: float) -> list[ContourPart]:
    """Shift parts, omit those that became too short, and join the ends at outside corners by arcs."""
    for part in parts:
        part.shift_sideways(step)
    parts = [part for part in parts if part.size >= _SHORT]
    joined = parts[:1]
    for before, after in pairwise(parts):
        if (before.end - after.start).real > _GAP:
            one, two = replace(before), replace(after)
            one.shift_sideways(-step)
            two.shift_sideways(-step)
            joined.append(ContourPart(before.end, after.start, (one.end + two.start) / 2.0, step > 0.0))
        joined.append(after)
    return joined


def _join_parts(parts: list[ContourPart]) -> list[ContourPart]:
    at = rounds = 0
    while at < len(parts) - 1:
        rounds += 1
        if rounds > _MAX_STEPS:
            raise ContourError("the contour has no parallel at the finishing allowance; use a smaller D")
        if not parts[at].is_falling() and at > 0:
            del parts[at if parts[at].size < parts[at - 1].size else at - 1]
            at = 0
            if len(parts) < 2:
                break
        if parts[at].size < _SHORT:
            del parts[at]
            at = 0
        else:
            _cut_at_intersection(parts[at], parts[at + 1])
        at += 1
    return parts


def _cut_at_intersection(before: ContourPart, after: ContourPart) -> None:
    if before.centre is not None and after.centre is not None:
        place = _intersect_arcs(before, before.centre, after, after.centre)
    elif before.centre is None and after.centre is None:
        place = _intersect_lines(before, after)
    elif abs(after.start - before.end) < _NEAR:
        return
    elif before.centre is not None:
        place = _intersect_line_and_arc(after, before, before.centre, after.start)
    else:
        assert after.centre is not None
        place = _intersect_line_and_arc(before, after, after.centre, after.start)
    if place is not None:
        before.end = after.start = place


def _compute_direction(line: ContourPart) -> complex:
    way, length = (line.start - line.end).conjugate(), abs(line.start - line.end)
    return complex(way.real / length, way.imag / length)


def _intersect_lines(before: ContourPart, after: ContourPart) -> complex:
    turn = _compute_direction(after)
    start, end = (before.start - after.end) * turn, (before.end - after.end) * turn
    if start.imag - end.imag == 0.0:
        raise ContourError("two consecutive lines of the contour have the same direction; join them")
    share = start.imag / (start.imag - end.imag)
    return (start + share * (end - start)) / turn + after.end


def _intersect_line_and_arc(line: ContourPart, arc: ContourPart, centre: complex, near: complex) -> complex:
    turn = _compute_direction(line)
    radius = (arc.end - line.end) * turn
    middle = (centre - line.end) * turn
    square = abs(middle - radius) ** 2 - middle.imag**2
    half = math.sqrt(max(0.0, square))
    places = [(middle.real + half) / turn + line.end, (middle.real - half) / turn + line.end]
    return min(reversed(places), key=lambda place: abs(near - place))


def _intersect_arcs(before: ContourPart, one: complex, after: ContourPart, two: complex) -> complex | None:
    between = abs(two - one)
    if between == 0.0:
        return None
    a, b = abs(after.start - two), abs(before.start - one)
    if a == 0.0:
        raise ContourError("an arc of the contour has no radius")
    cosine = (between * between + a * a - b * b) / 2.0 / a / between
    turn = complex(cosine, math.sqrt(max(0.0, 1.0 - cosine * cosine)))
    return turn * (one - two) / between * a + two
