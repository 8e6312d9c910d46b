"""Decide how two segments meet: straight through, with a stop, by a parabola, or by an arc tangent to both.

As LinuxCNC's planner does according to its demand: a kink whose step needs less than a tenth of the axes' acceleration
is passed; under G64 the better of an arc and a parabola is chosen, a parabola counting half, since both of its
neighbours accelerate at half there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.program.motions import Place, Point
from fdhil.program.planner.axis_limits import AxisLimits
from fdhil.program.planner.linuxcnc.path_segments import (
    ALONG_SHARE,
    EXACT,
    NORMAL_SHARE,
    PARABOLA,
    STOP,
    TANGENT,
    PathSegment,
)
from fdhil.program.planner.linuxcnc.path_shapes import (
    ArcShape,
    LedArcShape,
    LineShape,
    add_scaled,
    compute_cross,
    compute_dot,
    normalise_vector,
    subtract_points,
)

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


def join_segments(before: PathSegment, after: PathSegment, limits: AxisLimits) -> tuple[PathSegment, ...]:
    """Decide the transition from ``before`` to ``after``; return what replaces ``before``.

    That is ``before`` itself, followed by an arc if one is inserted, or the arc alone if it absorbs ``before``.
    """
    if before.rapid != after.rapid:
        before.ending = STOP
    if before.has_other_axes or after.has_other_axes:  # measured: no arc is inserted, and no kink is passed
        after.after_parabola = before.ending == PARABOLA
        return (before,)
    if before.ending == STOP or _is_kink_passable(before, after, limits) or before.ending == EXACT:
        return (before,)
    arc = _fit_blend_arc(before, after, limits)
    parabola = compute_blend_speeds(before, after, probing=True)[2] / 2.0
    if arc is not None and arc.segment.top >= max(parabola, before.kink_speed):
        _forget_kink(before, after)
        before.ending = TANGENT
        return arc.insert_between(before, after, limits.dt_s)
    if before.kink_speed > parabola:
        before.ending = TANGENT
    else:
        _forget_kink(before, after)
        after.after_parabola = True
    return (before,)


def _forget_kink(before: PathSegment, after: PathSegment) -> None:
    before.kink_speed, before.kept_back, after.kept_back_before = math.inf, 0.0, 0.0


def _is_kink_passable(before: PathSegment, after: PathSegment, limits: AxisLimits) -> bool:
    t1, t2 = before.shape.compute_tangent(before.shape.length), after.shape.compute_tangent(0.0)
    if compute_dot(t1, t2) < _REVERSAL:
        before.ending = EXACT  # measured: a stop, without a reserve for it
        return False
    speed = min(before.free_speed, after.free_speed)
    step = speed / limits.dt_s + after.acceleration
    share = max(abs(b - a) * step / limit for a, b, limit in zip(t1, t2, limits.acceleration[:3], strict=True))
    if isinstance(before.shape, ArcShape) or isinstance(after.shape, ArcShape):
        share /= _KINK_SHARE_OF_ARC
    kept = min(share, _KINK_SHARE)
    before.kink_speed = speed if share < _KINK_SHARE else speed * _KINK_SHARE / share
    before.kept_back = after.kept_back_before = kept
    if share < _KINK_SHARE:
        before.ending = TANGENT
    return share < _KINK_SHARE


def compute_blend_speeds(before: PathSegment, after: PathSegment, probing: bool = False) -> tuple[float, float, float]:
    """Return the speeds at which a parabola begins in ``before`` and ends in ``after``, and that across the corner.

    ``probing`` assumes a parabola that is not decided yet.
    """
    t1, t2 = before.shape.compute_tangent(before.shape.length), after.shape.compute_tangent(0.0)
    kept = after.after_parabola
    after.after_parabola = kept or probing
    a1, a2, v1, v2 = before.path_acceleration, after.path_acceleration, before.reachable_speed, after.reachable_speed
    after.after_parabola = kept
    l1, l2 = before.shape.length, after.shape.length
    span = min(l1 / v1, l2 / v2, max(v1 / a1, v2 / a2))
    v1, v2 = min(v1, span * a1), min(v2, span * a2)
    half = math.acos(max(-1.0, min(1.0, -compute_dot(t1, t2)))) / 2.0  # pi / 2 where the path goes straight on
    if before.tolerance > 0.0 and math.cos(half) > 1e-4:
        within = 2.0 * math.sqrt(a1 * before.tolerance / math.cos(half))
        v1, v2 = min(v1, within), min(v2, within)
    # measured: the next segment accelerates fully while this one brakes
    return v1, v1 / a1 * a2, math.sin(half) * (v1 + v2) / 2.0


@dataclass(slots=True)
class _BlendArc:
    segment: PathSegment
    taken: tuple[float, float]  # mm off the end of the one before and off the start of the one after

    def insert_between(self, before: PathSegment, after: PathSegment, dt_s: float) -> tuple[PathSegment, ...]:
        """Shorten both neighbours; a line shorter than four cycles is merged with the arc."""
        one, two, arc = before.shape, after.shape, self.segment
        assert not isinstance(one, LedArcShape)
        assert not isinstance(two, LedArcShape)
        assert isinstance(arc.shape, ArcShape)
        one.trim_ends(0.0, self.taken[0])
        two.trim_ends(self.taken[1], 0.0)
        if not isinstance(one, LineShape) or one.length >= _GAP_CYCLES * dt_s * arc.top:
            return before, arc
        if one.length > 0.0:
            arc.shape = LedArcShape(one, arc.shape)
        arc.nominal = arc.shape.length
        arc.after_parabola, arc.kept_back_before = before.after_parabola, before.kept_back_before
        return (arc,)


def _fit_blend_arc(before: PathSegment, after: PathSegment, limits: AxisLimits) -> _BlendArc | None:
    one, two = before.shape, after.shape
    if isinstance(one, LedArcShape) or isinstance(two, LedArcShape):
        return None
    t1, t2 = one.compute_tangent(one.length), two.compute_tangent(0.0)
    normal = normalise_vector(compute_cross(t1, t2))
    half = math.acos(max(-1.0, min(1.0, -compute_dot(t1, t2)))) / 2.0
    if compute_dot(normal, normal) == 0.0 or half < _LEAST_ANGLE_RAD or half > math.pi / 2.0 - _LEAST_ANGLE_RAD:
        return None
    if not (_is_in_plane(one, normal) and _is_in_plane(two, normal)):
        return None
    limit = _limit_within_plane(limits.acceleration, normal)
    tolerance = min(_determine_tolerance(before), _determine_tolerance(after))
    room1, room2 = _measure_room(before, t2, half, True), _measure_room(after, t1, half, False)
    half_taken = half - max(room1.steeper, room2.steeper)
    if isinstance(one, ArcShape) and isinstance(two, ArcShape) and half_taken < _LEAST_HALF_OF_ARCS_RAD:
        return None
    reach = min(room1.reach, room2.reach, math.cos(half_taken) * tolerance / (1.0 - math.sin(half_taken)))
    goal = min(max(before.free_speed, after.free_speed), _compute_fastest_speed(before, after, half, limits, normal))
    widest = math.tan(half_taken) * reach
    speed = min(math.sqrt(NORMAL_SHARE * limit * widest), goal)
    # measured: if there is room, the arc lasts as long as half of the acceleration needs for its speed
    longest = speed * speed / (ALONG_SHARE * limit) / (math.pi - 2.0 * half_taken)
    radius = min(widest, max(speed * speed / (NORMAL_SHARE * limit), longest))
    found = _fit_tangent_arc(one, two, radius, normal, math.tan(half))
    if found is None or found[1] > room1.most + _ROUNDING_MM or found[2] > room2.most + _ROUNDING_MM:
        return None
    off = subtract_points(found[0].centre, two.compute_point(0.0))
    if math.sqrt(compute_dot(off, off)) - radius > tolerance + _ROUNDING_MM:
        return None
    speed = min(speed, math.sqrt(NORMAL_SHARE * limit * radius))
    turn, taken = found[0], (min(found[1], one.length), min(found[2], two.length))
    wanted = max(before.wanted, after.wanted)
    segment = PathSegment(before.line, before.rapid, turn, wanted, speed, limit, turn.radius,
                      before.tolerance, TANGENT, turn.length, between=True)  # fmt: skip
    return _BlendArc(segment, taken)


@dataclass(frozen=True, slots=True)
class _BlendRoom:
    """The length that a blend may use of a segment.

    ``reach`` mm as if it were straight, ``most`` mm along it, ``steeper``: angle (rad) by which half the corner counts
    as steeper.
    """

    reach: float
    most: float
    steeper: float = 0.0


def _measure_room(segment: PathSegment, other: Point, half: float, at_end: bool) -> _BlendRoom:
    """Return the room of a corner with a segment of direction ``other``: on an arc less if it lies inside."""
    shape = segment.shape
    if not isinstance(shape, ArcShape):
        reach = min(shape.length, segment.nominal * _LENGTH_SHARE) if at_end else shape.length * _LENGTH_SHARE
        return _BlendRoom(reach, reach)
    out = subtract_points(shape.compute_point(shape.length if at_end else 0.0), shape.centre)
    inside = (compute_dot(out, other) < 0.0) == at_end
    angle = min(shape.angle * (_ARC_SHARE_AT_END if at_end else _ARC_SHARE), half if inside else math.pi / 2.0)
    if inside:
        return _BlendRoom(math.sin(angle / 4.0) * shape.radius, angle * shape.radius, angle / 4.0)
    return _BlendRoom(angle * shape.radius, angle * shape.radius)


def _determine_tolerance(segment: PathSegment) -> float:
    return segment.tolerance or segment.nominal * _TOLERANCE_SHARE


def _is_in_plane(shape: LineShape | ArcShape, normal: Point) -> bool:
    if isinstance(shape, LineShape):
        return True
    return shape.is_flat and abs(abs(compute_dot(compute_cross(shape.u, shape.v), normal)) - 1.0) < 1e-6


def _limit_within_plane(limits: Place, normal: Point) -> float:
    scales = [math.sqrt(max(0.0, 1.0 - n * n)) for n in normal]
    return min(limit / scale for limit, scale in zip(limits[:3], scales, strict=True) if scale > 1e-9)


def _compute_fastest_speed(
    before: PathSegment, after: PathSegment, half: float, limits: AxisLimits, normal: Point
) -> float:
    """Return the speed that keeps the axes' limits along the whole of an arc between both directions."""
    plane = _limit_within_plane(limits.speed, normal)
    if isinstance(before.shape, ArcShape) or isinstance(after.shape, ArcShape):
        return plane
    turned = min(math.pi - 2.0 * half, 0.49 * math.pi)
    most = plane / math.cos(turned)
    v1, v2 = min(most, before.top), min(most, after.top)
    base = math.sqrt(v1 * v1 + v2 * v2 - 2.0 * v1 * v2 * math.cos(turned))
    altitude = v1 * v2 * math.sin(turned) / base if base > 0.0 else v1
    return altitude if altitude > 0.0 else min(v1, v2)


def _fit_tangent_arc(
    one: LineShape | ArcShape, two: LineShape | ArcShape, radius: float, normal: Point, steep: float
) -> tuple[ArcShape, float, float] | None:
    corner = two.compute_point(0.0)
    t1 = one.compute_tangent(one.length)
    reach = radius / steep
    centre = add_scaled(add_scaled(corner, t1, -reach), compute_cross(normal, t1), radius)
    for _ in range(30):  # Newton steps from the centre between the tangents until its distance from both is the radius
        (way1, d1, p1), (way2, d2, p2) = _find_nearest_point(one, centre), _find_nearest_point(two, centre)
        off1, off2 = radius - d1, radius - d2
        if abs(off1) + abs(off2) < 1e-10:
            break
        across = compute_dot(compute_cross(way1, way2), normal)
        if abs(across) < 1e-9:
            return None
        shift1, shift2 = compute_cross(way2, normal), compute_cross(normal, way1)
        centre = add_scaled(add_scaled(centre, shift1, off1 / across), shift2, off2 / across)
    else:
        return None
    u = normalise_vector(subtract_points(p1, centre))
    v = compute_cross(normal, u)
    last = normalise_vector(subtract_points(p2, centre))
    angle = math.atan2(compute_dot(last, v), compute_dot(last, u)) % (2.0 * math.pi)
    if not 0.0 < angle < math.pi:
        return None
    taken1, taken2 = _measure_length_to(one, p1, True), _measure_length_to(two, p2, False)
    if taken1 < 0.0 or taken2 < 0.0:
        return None
    return ArcShape(centre, u, v, radius, 0.0, angle, (0.0, 0.0, 0.0), radius * angle), taken1, taken2


def _find_nearest_point(shape: LineShape | ArcShape, place: Point) -> tuple[Point, float, Point]:
    """Return direction and distance from the nearest point of a shape to a point, and that nearest point."""
    if isinstance(shape, LineShape):
        foot = add_scaled(shape.start, shape.way, compute_dot(subtract_points(place, shape.start), shape.way))
    else:
        foot = add_scaled(shape.centre, normalise_vector(subtract_points(place, shape.centre)), shape.radius)
    way = subtract_points(place, foot)
    return normalise_vector(way), math.sqrt(compute_dot(way, way)), foot


def _measure_length_to(shape: LineShape | ArcShape, point: Point, at_end: bool) -> float:
    """Return the length from a point on a shape to its end, or from its start to the point; negative beyond."""
    if isinstance(shape, LineShape):
        along = compute_dot(subtract_points(point, shape.start), shape.way)
    else:
        out = subtract_points(point, shape.centre)
        turned = math.atan2(compute_dot(out, shape.v), compute_dot(out, shape.u))
        if turned < -math.pi / 2.0 or (at_end and turned < 0.0):
            turned += 2.0 * math.pi
        if at_end:
            turned += 2.0 * math.pi * round((shape.angle - turned) / (2.0 * math.pi))
        along = turned * shape.radius
    return shape.length - along if at_end else along
