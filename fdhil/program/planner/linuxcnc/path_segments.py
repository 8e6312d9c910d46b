"""Segments: one motion each as LinuxCNC's planner queues it, with its limits and its transition to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.program.motions import ORIGIN, Arc, Feed, Place, Rapid, compute_end
from fdhil.program.planner.axis_limits import AxisLimits
from fdhil.program.planner.linuxcnc import path_shapes
from fdhil.program.planner.linuxcnc.path_shapes import ArcShape, Shape
from fdhil.program.planner.path_pieces import limit_path_speed, measure_length

STOP, EXACT, PARABOLA, TANGENT = range(4)  # how a segment ends
NORMAL_SHARE = math.sqrt(0.75)  # of the acceleration that turning may use
ALONG_SHARE = 0.5  # remaining share along the path then
_SHORTEST_CYCLES = 3.0
_LEAST_RADIUS_MM = 1e-6
_ENDS = {"exact_stop": STOP, "exact_path": EXACT, "blend": PARABOLA}


@dataclass(slots=True)
class PathSegment:
    """A piece of path with its limits: ``wanted`` mm/s as programmed, ``top`` mm/s, ``acceleration`` mm/s2.

    ``bent`` is its radius of curvature, infinite for a line; ``kink_speed`` is the speed at which its end may be passed
    without a blend, which reserves ``kept_back`` and ``kept_back_before`` of the acceleration.
    """

    line: int
    rapid: bool
    shape: Shape
    wanted: float
    top: float
    acceleration: float
    bent: float
    tolerance: float
    ending: int
    nominal: float
    kink_speed: float = math.inf
    kept_back: float = 0.0
    kept_back_before: float = 0.0
    after_parabola: bool = False
    end_speed: float = 0.0
    place: float = 0.0
    speed: float = 0.0
    between: bool = False  # an arc inserted between two motions
    settled: bool = False  # its end is final
    others: Place = ORIGIN[3:]  # A B C U V W at its start
    ways: Place = ORIGIN[3:]  # their distance on it

    @property
    def has_other_axes(self) -> bool:
        """Whether it moves an axis other than X, Y and Z."""
        return any(self.ways)

    def compute_others_at(self, distance: float) -> Place:
        """Return A B C U V W at a distance from the start: they are linear in the length."""
        if not self.has_other_axes:
            return self.others
        share = distance / self.nominal
        return tuple(start + way * share for start, way in zip(self.others, self.ways, strict=True))

    @property
    def free_speed(self) -> float:
        """Speed limit without regard to its neighbours."""
        return min(self.wanted, self.top)

    @property
    def target_speed(self) -> float:
        """Speed limit."""
        speed = self.free_speed
        if self.settled and self.bent < math.inf:
            speed = min(speed, math.sqrt(NORMAL_SHARE * self._available_acceleration * self.bent))
        return speed

    @property
    def _available_acceleration(self) -> float:
        """Total acceleration: halved during a parabola, since both neighbours accelerate there."""
        left = self.acceleration * (1.0 - max(self.kept_back, self.kept_back_before))
        return left * 0.5 if self.ending == PARABOLA or self.after_parabola else left

    @property
    def path_acceleration(self) -> float:
        """Acceleration along the path: what turning at the top speed leaves, at least half."""
        left = self._available_acceleration
        turning = self.top * self.top / self.bent
        if turning <= 0.0:
            return left
        if self.between or turning >= NORMAL_SHARE * left:
            return left * ALONG_SHARE
        return math.sqrt(left * left - turning * turning)

    @property
    def assured_length(self) -> float:
        """Guaranteed length: half of it may still be used by a blend."""
        return self.shape.length if self.settled else self.shape.length / 2.0

    @property
    def reachable_speed(self) -> float:
        """Highest speed from rest to rest."""
        return min(self.target_speed, math.sqrt(self.path_acceleration * self.assured_length))

    def settle_length(self, dt_s: float) -> None:
        """Limit the speed to a duration of three cycles, now that the length is final."""
        self.settled = True
        self.top = min(self.top, self.shape.length / (_SHORTEST_CYCLES * dt_s))


def build_segment(motion: Rapid | Feed | Arc, start: Place, limits: AxisLimits) -> PathSegment | None:
    """Return the segment of a motion, None if it has no length."""
    end = compute_end(motion, start)
    ways = tuple(b - a for a, b in zip(start[3:], end[3:], strict=True))
    x, y, z = start[:3]
    if isinstance(motion, Arc):
        found = _build_arc_segment(motion, path_shapes.build_arc(motion, (x, y, z)), ways, limits)
    else:
        shape = path_shapes.build_line((x, y, z), motion.end)
        shape.length = shape.length or measure_length(start, end)  # if only other axes move
        if shape.length <= 0.0:
            return None
        shares = [*shape.way, *(way / shape.length for way in ways)]
        top, acceleration = (
            min(limit / abs(part) for limit, part in zip(axes, shares, strict=True) if part)
            for axes in (limits.speed, limits.acceleration)
        )
        found = _create_segment(motion, shape, (top, acceleration, math.inf), limit_path_speed(start, end, limits))
    if found is not None:
        found.others, found.ways = start[3:], ways
    return found


def _create_segment(
    motion: Rapid | Feed | Arc, shape: Shape, bounds: tuple[float, float, float], path_speed: float
) -> PathSegment:
    """``bounds`` are top speed, acceleration and radius; ``path_speed`` limits the commanded speed, as a feed does."""
    top, acceleration, bent = bounds
    rapid = isinstance(motion, Rapid)
    corner = motion.corner
    wanted = min(top if isinstance(motion, Rapid) else motion.feed / 60.0, path_speed)
    tolerance = corner.tolerance_mm if math.isfinite(corner.tolerance_mm) else 0.0
    ending = _ENDS[corner.mode]
    return PathSegment(motion.line, rapid, shape, wanted, top, acceleration, bent, tolerance, ending, shape.length)


def _build_arc_segment(motion: Arc, shape: ArcShape, ways: Place, limits: AxisLimits) -> PathSegment | None:
    if shape.length <= 0.0:
        return None
    turning = (shape.radius + shape.growth / 2.0) * shape.angle
    rise = [abs(part) for part in shape.rise]
    plane = [axis for axis in range(3) if shape.u[axis] or shape.v[axis]]
    bounds = []
    for axes in (limits.speed, limits.acceleration):
        longest = turning / min(axes[axis] for axis in plane)
        longest = max([longest, *(way / axes[axis] for axis, way in enumerate([*rise, *map(abs, ways)]) if way)])
        bounds.append(shape.length / longest)
    top, acceleration = bounds
    radius = min(shape.radius, shape.radius + shape.growth)
    steep = shape.length / turning
    top = min(top, math.sqrt(NORMAL_SHARE * acceleration * steep * radius))
    # measured: for a helix the whole rise counts, not that per radian, so more remains along the path
    bent = radius + sum(rise) ** 2 / radius if radius else _LEAST_RADIUS_MM
    return _create_segment(motion, shape, (top, acceleration, bent), limits.path_speed)
