"""The servo cycles: each one moves the active segment, and during a parabola the next one too."""

from __future__ import annotations

import math
from collections import deque

from fdhil.program.motions import ORIGIN, Point
from fdhil.program.planner.linuxcnc.blends import compute_blend_speeds
from fdhil.program.planner.linuxcnc.path_segments import PARABOLA, TANGENT, PathSegment
from fdhil.program.planner.linuxcnc.path_shapes import add_scaled, subtract_points

_AT_END_MM = 1e-12
_SPEED = 1e-8
_LEAST_S = 1e-12
_RAMP_S = 0.01  # segments up to this duration change their speed linearly


class ServoCycles:
    """Executes the segments of a queue; ``at`` is the commanded X Y Z, ``others`` the commanded A B C U V W."""

    def __init__(self, queue: deque[PathSegment], dt_s: float) -> None:
        self._queue = queue
        self._dt_s = dt_s
        self.at: Point = (0.0, 0.0, 0.0)
        self.others = ORIGIN[3:]
        self._begun: PathSegment | None = None
        self._target = self._target_next = self._end_speed = 0.0
        self._along = self._along_next = 0.0
        self._ramp = False
        self._braking = False
        self._blend_from = 0.0  # speed at which the active blend began, 0 for none
        self._speeds = (0.0, 0.0)
        self._left_s = 0.0  # of the cycle within which the active segment ends
        self._left_over = self._end = 0.0

    def run_cycle(self) -> None:
        queue = self._queue
        here = queue[0]
        if here is not self._begun:
            self._begin_segment(here)
        if self._left_s:
            here = self._leave_segment()
            self._move_segment(here, self._dt_s - self._left_over, self._along)
            self.at, self.others = here.shape.compute_point(here.place), here.compute_others_at(here.place)
        else:
            self._move_segment(here, self._dt_s, self._along)
            self.at, self.others = here.shape.compute_point(here.place), here.compute_others_at(here.place)
            if here.ending == PARABOLA and len(queue) > 1:
                self._blend_next(here, queue[1])
        self._check_end(here)

    def _begin_segment(self, here: PathSegment) -> None:
        self._begun, self._along, self._target = here, here.path_acceleration, here.target_speed
        self._target_next = self._queue[1].target_speed if len(self._queue) > 1 else 0.0
        self._end_speed = min(here.end_speed, self._target, self._target_next) if here.ending == TANGENT else 0.0
        self._blend_from = 0.0
        length = here.shape.length
        self._ramp = False
        if here.ending == TANGENT and not here.rapid:
            mean = here.speed + min(here.end_speed, self._target)
            self._ramp = mean > 0.0 and 2.0 * length / mean < _RAMP_S
        if here.ending == PARABOLA and len(self._queue) > 1:
            after = self._queue[1]
            self._speeds = compute_blend_speeds(here, after)[:2]
            self._along_next = after.path_acceleration

    def _move_segment(self, here: PathSegment, dt: float, along: float) -> None:
        if not (self._ramp and self._ramp_evenly(here, dt, along, self._end_speed)):
            self._braking = _advance_segment(here, dt, along, self._end_speed, self._target)

    def _ramp_evenly(self, here: PathSegment, dt: float, along: float, end: float) -> bool:
        """Change the speed linearly up to the end of the segment; False if that exceeds the acceleration."""
        to_go = here.shape.length - here.place
        mean = (here.speed + end) / 2.0
        if mean <= _SPEED or to_go <= 0.0:
            return False
        rate = (end - here.speed) * mean / to_go
        if abs(rate) > along:
            return False
        speed = here.speed + rate * dt
        here.place = min(here.shape.length, here.place + (here.speed + speed) / 2.0 * dt)
        here.speed = speed
        self._braking = rate < 0.0
        return True

    def _blend_next(self, here: PathSegment, after: PathSegment) -> None:
        """Accelerate the next segment in proportion to the deceleration of this one."""
        if not self._blend_from:
            if not (self._braking and here.speed < self._speeds[0]):
                return
            self._blend_from = max(here.speed, _SPEED)
        done = min(1.0, max(0.0, (self._blend_from - here.speed) / self._blend_from))
        target = done * self._speeds[1] * self._blend_from / self._speeds[0]
        _advance_segment(after, self._dt_s, self._along_next, 0.0, min(target, self._target_next))
        self.at = add_scaled(
            self.at, subtract_points(after.shape.compute_point(after.place), after.shape.compute_point(0.0))
        )
        if after.has_other_axes:
            more = zip(self.others, after.compute_others_at(after.place), after.others, strict=True)
            self.others = tuple(at + here - start for at, here, start in more)

    def _check_end(self, here: PathSegment) -> None:
        to_go = here.shape.length - here.place
        if to_go <= _AT_END_MM:
            self._pass_to_next(here, here.speed)
            return
        if here.ending != TANGENT or len(self._queue) < 2:
            return
        end = self._end_speed
        mean = (here.speed + end) / 2.0
        if mean <= _SPEED:
            return
        left = to_go / mean
        rate = (end - here.speed) / left
        if abs(rate) > self._along:
            rate = math.copysign(self._along, rate)
            root = math.sqrt(max(0.0, (here.speed / rate) ** 2 + 2.0 * to_go / rate))
            left = -here.speed / rate + math.copysign(root, rate)
            end = here.speed + left * rate
        if left < _LEAST_S:
            self._pass_to_next(here, end)
        elif left < self._dt_s:
            self._left_s, self._end = left, end

    def _leave_segment(self) -> PathSegment:
        self._left_over, self._left_s = self._left_s, 0.0
        self._pass_to_next(self._queue[0], self._end)
        here = self._queue[0]
        self._begin_segment(here)
        return here

    def _pass_to_next(self, here: PathSegment, speed: float) -> None:
        self._queue.popleft()
        if self._queue and here.ending == TANGENT:
            self._queue[0].speed = speed


def _advance_segment(here: PathSegment, dt: float, along: float, end: float, target: float) -> bool:
    """Move a segment by one cycle toward ``target``, so that it can still end at ``end``.

    The speed is the highest from which it can brake in whole cycles; return whether it brakes for that.
    """
    speed = here.speed
    to_go = here.shape.length - here.place
    half = along * dt / 2.0
    root = end * end + along * (2.0 * to_go - speed * dt) + half * half
    highest = math.sqrt(root) - half if root > half * half else -half
    wanted = min(highest, target)
    rate = min(along, max(-along, (wanted - speed) / dt))
    new = speed + rate * dt
    if new < 0.0:
        new = 0.0
        if to_go < speed * dt:
            here.place = here.shape.length
    else:
        here.place = min(here.shape.length, here.place + (new + speed) / 2.0 * dt)
    here.speed = new
    return abs(highest - new) < _SPEED and rate < 0.0
