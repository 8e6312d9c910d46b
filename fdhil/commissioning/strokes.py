"""Plans how a commissioning moves an axis, inside the room that the operator gave: a jog, and rapids. Pure.

What the set-points of a stroke are is the business of ``set_points``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.config import Axis
from fdhil.errors import DriveFault
from fdhil.identification.windows import PLATEAU_S, RAPID_SHARE

JOG_MM = 5.0
LEAST_JOG_MM = 0.5
JOG_MM_S = 5.0
JOG_ACCELERATION_MM_S2 = 50.0
GENTLE = 0.1  # of the axis' own speed and acceleration: what a jog stays below
CRUISE_S = 2 * PLATEAU_S
USED = 0.98  # of the room: the rest is what a stop from within a cycle may take
SLOWEST = RAPID_SHARE + 0.05  # of the rapid speed: what is slower counts as a feed


@dataclass(frozen=True, slots=True)
class Room:
    """How far an axis may go from where it stands, mm: back (0 or less) and forward (0 or more)."""

    back_mm: float
    forward_mm: float

    @property
    def farthest_mm(self) -> float:
        """The side with more room, with its sign."""
        return self.forward_mm if self.forward_mm >= -self.back_mm else self.back_mm

    def __str__(self) -> str:
        return f"{self.back_mm:+g} to {self.forward_mm:+g} mm"


@dataclass(frozen=True, slots=True)
class Stroke:
    """One move from rest to rest: signed distance, and the largest speed, acceleration and jerk."""

    distance_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float
    jerk_mm_s3: float

    def back(self) -> Stroke:
        """Return the same move the other way."""
        return Stroke(-self.distance_mm, self.speed_mm_s, self.acceleration_mm_s2, self.jerk_mm_s3)

    def __str__(self) -> str:
        toward = "plus" if self.distance_mm > 0 else "minus"
        return f"{abs(self.distance_mm):g} mm toward {toward} at {self.speed_mm_s:.3g} mm/s"


def plan_jog(axis: str, settings: Axis, room: Room) -> Stroke:
    """Return the jog, toward the side with more room; DriveFault where there is too little."""
    side = USED * room.farthest_mm
    if abs(side) < LEAST_JOG_MM:
        text = f"there is room from {room} for the jog, which needs {LEAST_JOG_MM:g} mm to one side"
        raise DriveFault(f"drive {axis}", f"{text}; give it more with --room, or leave --room out to move nothing")
    acceleration = min(JOG_ACCELERATION_MM_S2, GENTLE * settings.max_acceleration_mm_s2)
    speed = min(JOG_MM_S, GENTLE * settings.top_speed_mm_s)
    return Stroke(math.copysign(min(JOG_MM, abs(side)), side), speed, acceleration, 10 * acceleration)


def plan_rapid(axis: str, settings: Axis, room: Room) -> Stroke:
    """Return a rapid with a plateau that identification can use, toward the side with more room.

    As fast as G0, or as the room allows; DriveFault where that would be no rapid any more.
    """
    side, top = USED * room.farthest_mm, settings.rapid_speed_mm_s
    limits = settings.setpoints
    fastest = (limits.max_speed_mm_s if limits else None) or top
    steepest = (limits.max_acceleration_mm_s2 if limits else None) or settings.max_acceleration_mm_s2
    acceleration, jerk = min(steepest, settings.max_acceleration_mm_s2), settings.jerk_mm_s3
    # v^2 / a + v (a / j + cruise) is the way of a rapid of speed v
    spent_s = acceleration / jerk + CRUISE_S
    fits = acceleration / 2 * (math.sqrt(spent_s**2 + 4 * abs(side) / acceleration) - spent_s)
    if fastest < SLOWEST * top:
        text = f"[axis.{axis}.setpoints] allows {fastest:g} mm/s where G0 is {top:g}, so that no rapid can be tried"
        raise DriveFault(f"drive {axis}", f"{text}; raise its max_speed_mm_s, or leave --room out")
    if fits < SLOWEST * top:
        least = SLOWEST * top * (SLOWEST * top / acceleration + spent_s)
        text = f"there is room from {room} for test rapids, which need {math.ceil(least / USED)} mm to one side"
        raise DriveFault(f"drive {axis}", f"{text}; move the axis away from its end, and give it more with --room")
    speed = min(top, fits, fastest)
    way = min(abs(side), speed * (speed / acceleration + spent_s))
    return Stroke(math.copysign(way, side), speed, acceleration, jerk)
