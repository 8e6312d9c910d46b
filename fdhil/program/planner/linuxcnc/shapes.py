"""Shapes of path: a straight line, an arc or helix in any plane, and a line that leads into an arc."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.program.motions import PLANE_AXES, Arc, Point, Swept


def plus(a: Point, b: Point, share: float = 1.0) -> Point:
    """Return a + share b."""
    return (a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2])


def minus(a: Point, b: Point) -> Point:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Point, b: Point) -> Point:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def unit(a: Point) -> Point:
    """Return the vector scaled to length 1; zero stays zero."""
    length = math.sqrt(dot(a, a))
    return (a[0] / length, a[1] / length, a[2] / length) if length > 0.0 else a


@dataclass(slots=True)
class Line:
    """A line of ``length`` mm from ``start`` along the unit vector ``way``; 0 if only other axes move."""

    start: Point
    way: Point
    length: float

    def at(self, distance: float) -> Point:
        """Return the point at a distance from the start."""
        return plus(self.start, self.way, distance)

    def tangent(self, distance: float) -> Point:
        """Return the unit direction at a distance from the start; LinuxCNC uses X for a line without length."""
        return self.way if any(self.way) else (1.0, 0.0, 0.0)

    def cut(self, begin: float, end: float) -> None:
        """Shorten it by ``begin`` and ``end`` mm."""
        self.start = plus(self.start, self.way, begin)
        self.length -= begin + end


@dataclass(slots=True)
class Turn:
    """An arc of ``angle`` rad from ``centre`` + ``radius`` ``u`` to ``v``; total ``growth`` of radius and ``rise``."""

    centre: Point
    u: Point
    v: Point
    radius: float
    growth: float
    angle: float
    rise: Point
    length: float

    @property
    def flat(self) -> bool:
        """Whether it has one radius and lies in one plane."""
        return abs(self.growth) < 1e-9 and dot(self.rise, self.rise) < 1e-18

    def at(self, distance: float) -> Point:
        share = distance / self.length
        radius = self.radius + self.growth * share
        c, s = radius * math.cos(self.angle * share), radius * math.sin(self.angle * share)
        p, u, v, rise = self.centre, self.u, self.v, self.rise
        return (
            p[0] + c * u[0] + s * v[0] + share * rise[0],
            p[1] + c * u[1] + s * v[1] + share * rise[1],
            p[2] + c * u[2] + s * v[2] + share * rise[2],
        )

    def tangent(self, distance: float) -> Point:
        share = distance / self.length
        radius, angle = self.radius + self.growth * share, self.angle * share
        c, s = math.cos(angle), math.sin(angle)
        along_u = self.growth * c - radius * self.angle * s
        along_v = self.growth * s + radius * self.angle * c
        return unit(plus(plus(self.rise, self.u, along_u), self.v, along_v))

    def cut(self, begin: float, end: float) -> None:
        """Shorten a flat arc by ``begin`` and ``end`` mm."""
        turned, left = begin / self.radius, (self.length - begin - end) / self.radius
        c, s = math.cos(turned), math.sin(turned)
        zero = (0.0, 0.0, 0.0)
        self.u, self.v = plus(plus(zero, self.u, c), self.v, s), plus(plus(zero, self.u, -s), self.v, c)
        self.angle, self.length = left, self.length - begin - end


@dataclass(slots=True)
class Led:
    """A line that leads into an arc: the rest of a line that was too short for its own segment."""

    lead: Line
    turn: Turn

    @property
    def length(self) -> float:
        return self.lead.length + self.turn.length

    def at(self, distance: float) -> Point:
        over = distance - self.lead.length
        return self.turn.at(over) if over > 0.0 else self.lead.at(distance)

    def tangent(self, distance: float) -> Point:
        over = distance - self.lead.length
        return self.turn.tangent(over) if over > 0.0 else self.lead.way


Shape = Line | Turn | Led


def line(start: Point, end: Point) -> Line:
    """Return the line between two points."""
    way = minus(end, start)
    return Line(start, unit(way), math.sqrt(dot(way, way)))


def turn(motion: Arc, start: Point) -> Turn:
    """Return the arc or helix of a motion."""
    first, second, normal = PLANE_AXES[motion.plane]
    path = Swept.of(motion, start)
    radius, last = path.radii
    x, y = path.centre.real, path.centre.imag
    c, s = (start[first] - x) / radius, (start[second] - y) / radius
    sense = math.copysign(1.0, path.angle_rad)

    def whole(a: float, b: float, n: float) -> Point:
        place = [0.0, 0.0, 0.0]
        place[first], place[second], place[normal] = a, b, n
        return (place[0], place[1], place[2])

    return Turn(
        centre=whole(x, y, start[normal]), u=whole(c, s, 0.0), v=whole(-s * sense, c * sense, 0.0),
        radius=radius, growth=last - radius, angle=abs(path.angle_rad), rise=whole(0.0, 0.0, path.rise_mm),
        length=path.length_mm,
    )  # fmt: skip
