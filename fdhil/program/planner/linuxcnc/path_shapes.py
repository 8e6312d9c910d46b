"""Shapes of path: a straight line, an arc or helix in any plane, and a line that leads into an arc."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.program.motions import PLANE_AXES, Arc, Point, SweptArc


def add_scaled(a: Point, b: Point, share: float = 1.0) -> Point:
    """Return a + share b."""
    return (a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2])


def subtract_points(a: Point, b: Point) -> Point:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def compute_dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def compute_cross(a: Point, b: Point) -> Point:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def normalise_vector(a: Point) -> Point:
    """Return the vector scaled to length 1; zero stays zero."""
    length = math.sqrt(compute_dot(a, a))
    return (a[0] / length, a[1] / length, a[2] / length) if length > 0.0 else a


@dataclass(slots=True)
class LineShape:
    """A line of ``length`` mm from ``start`` along the unit vector ``way``; 0 if only other axes move."""

    start: Point
    way: Point
    length: float

    def compute_point(self, distance: float) -> Point:
        """Return the point at a distance from the start."""
        return add_scaled(self.start, self.way, distance)

    def compute_tangent(self, distance: float) -> Point:
        """Return the unit direction at a distance from the start; LinuxCNC uses X for a line without length."""
        return self.way if any(self.way) else (1.0, 0.0, 0.0)

    def trim_ends(self, begin: float, end: float) -> None:
        """Shorten it by ``begin`` and ``end`` mm."""
        self.start = add_scaled(self.start, self.way, begin)
        self.length -= begin + end


@dataclass(slots=True)
class ArcShape:
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
    def is_flat(self) -> bool:
        """Whether it has one radius and lies in one plane."""
        return abs(self.growth) < 1e-9 and compute_dot(self.rise, self.rise) < 1e-18

    def compute_point(self, distance: float) -> Point:
        share = distance / self.length
        radius = self.radius + self.growth * share
        c, s = radius * math.cos(self.angle * share), radius * math.sin(self.angle * share)
        p, u, v, rise = self.centre, self.u, self.v, self.rise
        return (
            p[0] + c * u[0] + s * v[0] + share * rise[0],
            p[1] + c * u[1] + s * v[1] + share * rise[1],
            p[2] + c * u[2] + s * v[2] + share * rise[2],
        )

    def compute_tangent(self, distance: float) -> Point:
        share = distance / self.length
        radius, angle = self.radius + self.growth * share, self.angle * share
        c, s = math.cos(angle), math.sin(angle)
        along_u = self.growth * c - radius * self.angle * s
        along_v = self.growth * s + radius * self.angle * c
        return normalise_vector(add_scaled(add_scaled(self.rise, self.u, along_u), self.v, along_v))

    def trim_ends(self, begin: float, end: float) -> None:
        """Shorten a flat arc by ``begin`` and ``end`` mm."""
        turned, left = begin / self.radius, (self.length - begin - end) / self.radius
        c, s = math.cos(turned), math.sin(turned)
        zero = (0.0, 0.0, 0.0)
        self.u, self.v = (
            add_scaled(add_scaled(zero, self.u, c), self.v, s),
            add_scaled(add_scaled(zero, self.u, -s), self.v, c),
        )
        self.angle, self.length = left, self.length - begin - end


@dataclass(slots=True)
class LedArcShape:
    """A line that leads into an arc: the rest of a line that was too short for its own segment."""

    lead: LineShape
    turn: ArcShape

    @property
    def length(self) -> float:
        return self.lead.length + self.turn.length

    def compute_point(self, distance: float) -> Point:
        over = distance - self.lead.length
        return self.turn.compute_point(over) if over > 0.0 else self.lead.compute_point(distance)

    def compute_tangent(self, distance: float) -> Point:
        over = distance - self.lead.length
        return self.turn.compute_tangent(over) if over > 0.0 else self.lead.way


Shape = LineShape | ArcShape | LedArcShape


def build_line(start: Point, end: Point) -> LineShape:
    """Return the line between two points."""
    way = subtract_points(end, start)
    return LineShape(start, normalise_vector(way), math.sqrt(compute_dot(way, way)))


def build_arc(motion: Arc, start: Point) -> ArcShape:
    """Return the arc or helix of a motion."""
    first, second, normal = PLANE_AXES[motion.plane]
    path = SweptArc.create_from_arc(motion, start)
    radius, last = path.radii
    x, y = path.centre.real, path.centre.imag
    c, s = (start[first] - x) / radius, (start[second] - y) / radius
    sense = math.copysign(1.0, path.angle_rad)

    def place_in_axes(a: float, b: float, n: float) -> Point:
        place = [0.0, 0.0, 0.0]
        place[first], place[second], place[normal] = a, b, n
        return (place[0], place[1], place[2])

    return ArcShape(
        centre=place_in_axes(x, y, start[normal]), u=place_in_axes(c, s, 0.0),
        v=place_in_axes(-s * sense, c * sense, 0.0), radius=radius, growth=last - radius, angle=abs(path.angle_rad),
        rise=place_in_axes(0.0, 0.0, path.rise_mm), length=path.length_mm,
    )  # fmt: skip
