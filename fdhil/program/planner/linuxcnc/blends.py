"""Decide how two segments meet: straight through, with a stop, by a parabola, or by an arc tangent to both.

As LinuxCNC's planner does according to its demand: a kink whose step needs less than a tenth of the axes' acceleration
is passed; under G64 the better of an arc and a parabola is chosen, a parabola counting half, since both of its
neighbours accelerate at half there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.program.motions import Place, Point
from fdhil.program.planner.limits import AxisLimits
from fdhil.program.planner.linuxcnc.segments import ALONG_SHARE, EXACT, NORMAL_SHARE, PARABOLA, STOP, TANGENT, Segment
from fdhil.program.planner.linuxcnc.shapes import Led, Line, Turn, cross, dot, minus, plus, unit

_KINK_SHARE = 0.1
_KINK_SHARE_OF_ARC = 0.5
_TOLERANCE_SHARE = 0.25  # of a segment's length, if the program gives none
_LENGTH_SHARE = 0.5  # of a segment's length that one blend may use
_GAP_CYCLES = 4.0
_LEAST_ANGLE_RAD = 1e-6
_REVERSAL = -1.0 + 1e-9
_LEAST_RADIUS_MM = 1e-6
_ROUNDING_MM = 1e-9
_ARC_SHARE, _ARC_SHARE_AT_END = 1.0 / 3.0, 2.0 / 3.0  # of an arc's angle that one blend may use
_LEAST_HALF_OF_ARCS_RAD = math.pi / 12.0  # sharper corners of two arcs get no arc


def join(before: Segment, after: Segment, limits: AxisLimits) -> tuple[Segment, ...]:
    """Decide the transition from ``before`` to ``after``; return what replaces ``before``.

    That is ``before`` itself, followed by an arc if one is inserted, or the arc alone if it absorbs ``before``.
    """
    if before.rapid != after.rapid:
        before.ending = STOP
    if before.turns or after.turns:  # measured: no arc is inserted, and no kink is passed
        after.after_parabola = before.ending == PARABOLA
        return (before,)
    if before.ending == STOP or _passed(before, after, limits) or before.ending == EXACT:
        return (before,)
    arc = _arc(before, after, limits)
    parabola = blend_speeds(before, after, probing=True)[2] / 2.0
    if arc is not None and arc.segment.top >= max(parabola, before.kink_speed):
        _forget_kink(before, after)
        before.ending = TANGENT
        return arc.put_between(before, after, limits.dt_s)
    if before.kink_speed > parabola:
        before.ending = TANGENT
    else:
        _forget_kink(before, after)
        after.after_parabola = True
    return (before,)


def _forget_kink(before: Segment, after: Segment) -> None:
    before.kink_speed, before.kept_back, after.kept_back_before = math.inf, 0.0, 0.0


def _passed(before: Segment, after: Segment, limits: AxisLimits) -> bool:
    t1, t2 = before.shape.tangent(before.shape.length), after.shape.tangent(0.0)
    if dot(t1, t2) < _REVERSAL:
        before.ending = EXACT  # measured: a stop, without a reserve for it
        return False
    speed = min(before.free, after.free)
    step = speed / limits.dt_s + after.acceleration
    share = max(abs(b - a) * step / limit for a, b, limit in zip(t1, t2, limits.acceleration[:3], strict=True))
    if isinstance(before.shape, Turn) or isinstance(after.shape, Turn):
        share /= _KINK_SHARE_OF_ARC
    kept = min(share, _KINK_SHARE)
    before.kink_speed = speed if share < _KINK_SHARE else speed * _KINK_SHARE / share
    before.kept_back = after.kept_back_before = kept
    if share < _KINK_SHARE:
        before.ending = TANGENT
    return share < _KINK_SHARE


def blend_speeds(before: Segment, after: Segment, probing: bool = False) -> tuple[float, float, float]:
    """Return the speeds at which a parabola begins in ``before`` and ends in ``after``, and that across the corner.

    ``probing`` assumes a parabola that is not decided yet.
    """
    t1, t2 = before.shape.tangent(before.shape.length), after.shape.tangent(0.0)
    kept = after.after_parabola
    after.after_parabola = kept or probing
    a1, a2, v1, v2 = before.along, after.along, before.reachable, after.reachable
    after.after_parabola = kept
    l1, l2 = before.shape.length, after.shape.length
    span = min(l1 / v1, l2 / v2, max(v1 / a1, v2 / a2))
    v1, v2 = min(v1, span * a1), min(v2, span * a2)
    half = math.acos(max(-1.0, min(1.0, -dot(t1, t2)))) / 2.0  # pi / 2 where the path goes straight on
    if before.tolerance > 0.0 and math.cos(half) > 1e-4:
        within = 2.0 * math.sqrt(a1 * before.tolerance / math.cos(half))
        v1, v2 = min(v1, within), min(v2, within)
    # measured: the next segment accelerates fully while this one brakes
    return v1, v1 / a1 * a2, math.sin(half) * (v1 + v2) / 2.0


@dataclass(slots=True)
class _Arc:
    segment: Segment
    taken: tuple[float, float]  # mm off the end of the one before and off the start of the one after

    def put_between(self, before: Segment, after: Segment, dt_s: float) -> tuple[Segment, ...]:
        """Shorten both neighbours; a line shorter than four cycles is merged with the arc."""
        one, two, arc = before.shape, after.shape, self.segment
        assert not isinstance(one, Led)
        assert not isinstance(two, Led)
        assert isinstance(arc.shape, Turn)
        one.cut(0.0, self.taken[0])
        two.cut(self.taken[1], 0.0)
        if not isinstance(one, Line) or one.length >= _GAP_CYCLES * dt_s * arc.top:
            return before, arc
        if one.length > 0.0:
            arc.shape = Led(one, arc.shape)
        arc.nominal = arc.shape.length
        arc.after_parabola, arc.kept_back_before = before.after_parabola, before.kept_back_before
        return (arc,)


def _arc(before: Segment, after: Segment, limits: AxisLimits) -> _Arc | None:
    one, two = before.shape, after.shape
    if isinstance(one, Led) or isinstance(two, Led):
        return None
    t1, t2 = one.tangent(one.length), two.tangent(0.0)
    normal = unit(cross(t1, t2))
    half = math.acos(max(-1.0, min(1.0, -dot(t1, t2)))) / 2.0
    if dot(normal, normal) == 0.0 or half < _LEAST_ANGLE_RAD or half > math.pi / 2.0 - _LEAST_ANGLE_RAD:
        return None
    if not (_in_plane(one, normal) and _in_plane(two, normal)):
        return None
    limit = _within_plane(limits.acceleration, normal)
    tolerance = min(_tolerance(before), _tolerance(after))
    room1, room2 = _room(before, t2, half, True), _room(after, t1, half, False)
    half_taken = half - max(room1.steeper, room2.steeper)
    if isinstance(one, Turn) and isinstance(two, Turn) and half_taken < _LEAST_HALF_OF_ARCS_RAD:
        return None
    reach = min(room1.reach, room2.reach, math.cos(half_taken) * tolerance / (1.0 - math.sin(half_taken)))
    goal = min(max(before.free, after.free), _fastest(before, after, half, limits, normal))
    widest = math.tan(half_taken) * reach
    speed = min(math.sqrt(NORMAL_SHARE * limit * widest), goal)
    # measured: if there is room, the arc lasts as long as half of the acceleration needs for its speed
    longest = speed * speed / (ALONG_SHARE * limit) / (math.pi - 2.0 * half_taken)
    radius = min(widest, max(speed * speed / (NORMAL_SHARE * limit), longest))
    found = _touching(one, two, radius, normal, math.tan(half))
    if found is None or found[1] > room1.most + _ROUNDING_MM or found[2] > room2.most + _ROUNDING_MM:
        return None
    off = minus(found[0].centre, two.at(0.0))
    if math.sqrt(dot(off, off)) - radius > tolerance + _ROUNDING_MM:
        return None
    speed = min(speed, math.sqrt(NORMAL_SHARE * limit * radius))
    turn, taken = found[0], (min(found[1], one.length), min(found[2], two.length))
    wanted = max(before.wanted, after.wanted)
    segment = Segment(before.line, before.rapid, turn, wanted, speed, limit, turn.radius,
                      before.tolerance, TANGENT, turn.length, between=True)  # fmt: skip
    return _Arc(segment, taken)


@dataclass(frozen=True, slots=True)
class _Room:
    """The length that a blend may use of a segment.

    ``reach`` mm as if it were straight, ``most`` mm along it, ``steeper``: angle (rad) by which half the corner counts
    as steeper.
    """

    reach: float
    most: float
    steeper: float = 0.0


def _room(segment: Segment, other: Point, half: float, at_end: bool) -> _Room:
    """Return the room of a corner with a segment of direction ``other``: on an arc less if it lies inside."""
    shape = segment.shape
    if not isinstance(shape, Turn):
        reach = min(shape.length, segment.nominal * _LENGTH_SHARE) if at_end else shape.length * _LENGTH_SHARE
        return _Room(reach, reach)
    out = minus(shape.at(shape.length if at_end else 0.0), shape.centre)
    inside = (dot(out, other) < 0.0) == at_end
    angle = min(shape.angle * (_ARC_SHARE_AT_END if at_end else _ARC_SHARE), half if inside else math.pi / 2.0)
    if inside:
        return _Room(math.sin(angle / 4.0) * shape.radius, angle * shape.radius, angle / 4.0)
    return _Room(angle * shape.radius, angle * shape.radius)


def _tolerance(segment: Segment) -> float:
    return segment.tolerance or segment.nominal * _TOLERANCE_SHARE


def _in_plane(shape: Line | Turn, normal: Point) -> bool:
    if isinstance(shape, Line):
        return True
    return shape.flat and abs(abs(dot(cross(shape.u, shape.v), normal)) - 1.0) < 1e-6


def _within_plane(limits: Place, normal: Point) -> float:
    scales = [math.sqrt(max(0.0, 1.0 - n * n)) for n in normal]
    return min(limit / scale for limit, scale in zip(limits[:3], scales, strict=True) if scale > 1e-9)


def _fastest(before: Segment, after: Segment, half: float, limits: AxisLimits, normal: Point) -> float:
    """Return the speed that keeps the axes' limits along the whole of an arc between both directions."""
    plane = _within_plane(limits.speed, normal)
    if isinstance(before.shape, Turn) or isinstance(after.shape, Turn):
        return plane
    turned = min(math.pi - 2.0 * half, 0.49 * math.pi)
    most = plane / math.cos(turned)
    v1, v2 = min(most, before.top), min(most, after.top)
    base = math.sqrt(v1 * v1 + v2 * v2 - 2.0 * v1 * v2 * math.cos(turned))
    altitude = v1 * v2 * math.sin(turned) / base if base > 0.0 else v1
    return altitude if altitude > 0.0 else min(v1, v2)


def _touching(
    one: Line | Turn, two: Line | Turn, radius: float, normal: Point, steep: float
) -> tuple[Turn, float, float] | None:
    corner = two.at(0.0)
    t1 = one.tangent(one.length)
    reach = radius / steep
    centre = plus(plus(corner, t1, -reach), cross(normal, t1), radius)
    for _ in range(30):  # Newton steps from the centre between the tangents until its distance from both is the radius
        (way1, d1, p1), (way2, d2, p2) = _nearest(one, centre), _nearest(two, centre)
        off1, off2 = radius - d1, radius - d2
        if abs(off1) + abs(off2) < 1e-10:
            break
        across = dot(cross(way1, way2), normal)
        if abs(across) < 1e-9:
            return None
        shift1, shift2 = cross(way2, normal), cross(normal, way1)
        centre = plus(plus(centre, shift1, off1 / across), shift2, off2 / across)
    else:
        return None
    u = unit(minus(p1, centre))
    v = cross(normal, u)
    last = unit(minus(p2, centre))
    angle = math.atan2(dot(last, v), dot(last, u)) % (2.0 * math.pi)
    if not 0.0 < angle < math.pi:
        return None
    taken1, taken2 = _length_to(one, p1, True), _length_to(two, p2, False)
    if taken1 < 0.0 or taken2 < 0.0:
        return None
    return Turn(centre, u, v, radius, 0.0, angle, (0.0, 0.0, 0.0), radius * angle), taken1, taken2


def _nearest(shape: Line | Turn, place: Point) -> tuple[Point, float, Point]:
    """Return direction and distance from the nearest point of a shape to a point, and that nearest point."""
    if isinstance(shape, Line):
        foot = plus(shape.start, shape.way, dot(minus(place, shape.start), shape.way))
    else:
        foot = plus(shape.centre, unit(minus(place, shape.centre)), shape.radius)
    way = minus(place, foot)
    return unit(way), math.sqrt(dot(way, way)), foot


def _length_to(shape: Line | Turn, point: Point, at_end: bool) -> float:
    """Return the length from a point on a shape to its end, or from its start to the point; negative beyond."""
    if isinstance(shape, Line):
        along = dot(minus(point, shape.start), shape.way)
    else:
        out = minus(point, shape.centre)
        turned = math.atan2(dot(out, shape.v), dot(out, shape.u))
        if turned < -math.pi / 2.0 or (at_end and turned < 0.0):
            turned += 2.0 * math.pi
        if at_end:
            turned += 2.0 * math.pi * round((shape.angle - turned) / (2.0 * math.pi))
        along = turned * shape.radius
    return shape.length - along if at_end else along
