"""Plan the moves of a commissioning inside the operator's room: a jog, and rapids. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from fdhil.config import Axis, MachineConfig
from fdhil.errors import DriveFault
from fdhil.identification import PLATEAU_S, RAPID_SHARE

JOG_MM = 5.0
LEAST_JOG_MM = 0.5
JOG_MM_S = 5.0
JOG_ACCELERATION_MM_S2 = 50.0
GENTLE = 0.1  # of the axis' speed and acceleration: limit of a jog
CRUISE_S = 2 * PLATEAU_S
USED = 0.98  # of the room: the rest is reserved for a stop within a cycle
SLOWEST = RAPID_SHARE + 0.05  # of the rapid speed: a slower move counts as a feed


@dataclass(frozen=True, slots=True)
class TravelRoom:
    """Distance that an axis may move from its position, in its unit: back (0 or less) and forward (0 or more)."""

    back: float
    forward: float

    @property
    def farthest(self) -> float:
        """The side with more room, with its sign."""
        return self.forward if self.forward >= -self.back else self.back

    def __str__(self) -> str:
        return f"{self.back:+g} to {self.forward:+g}"


@dataclass(frozen=True, slots=True)
class Stroke:
    """One move of an axis from rest to rest: signed distance, and the largest speed, acceleration and jerk."""

    axis: Axis
    distance_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float
    jerk_mm_s3: float

    def reverse_direction(self) -> Stroke:
        """Return the same move in the opposite direction."""
        return replace(self, distance_mm=-self.distance_mm)

    def __str__(self) -> str:
        toward = "plus" if self.distance_mm > 0 else "minus"
        way, speed = (
            self.axis.format_in_unit(abs(self.distance_mm), form="g"),
            self.axis.format_in_unit(self.speed_mm_s, "/s", ".3g"),
        )
        return f"{way} toward {toward} at {speed}"


def require_single_drive(config: MachineConfig, axis: str) -> None:
    """Raise DriveFault for a drive of a gantry axis, which must not move without the other."""
    both = [name for name in config.axis if name[0] == axis[0]]
    if len(both) > 1:
        text = f"{' and '.join(both)} move one beam, which one alone would skew; nothing was moved"
        raise DriveFault(f"drive {axis}", f"{text}: omit --room, and let the NC make rapids")


def plan_jog(axis: str, settings: Axis, room: TravelRoom) -> Stroke:
    """Return the jog toward the side with more room; DriveFault if there is too little."""
    side = USED * room.farthest * settings.mm_per_unit
    if abs(side) < LEAST_JOG_MM:
        least = settings.format_in_unit(LEAST_JOG_MM, form=".3g")
        text = f"the room is {room} {settings.unit}, but the jog needs {least} to one side"
        raise DriveFault(f"drive {axis}", f"{text}; enlarge --room, or omit --room to move nothing")
    acceleration = min(JOG_ACCELERATION_MM_S2, GENTLE * settings.max_acceleration_mm_s2)
    speed = min(JOG_MM_S, GENTLE * settings.top_speed_mm_s)
    return Stroke(settings, math.copysign(min(JOG_MM, abs(side)), side), speed, acceleration, 10 * acceleration)


def plan_rapid(axis: str, settings: Axis, room: TravelRoom) -> Stroke:
    """Return a rapid with a plateau for identification, toward the side with more room.

    As fast as G0, or as the room allows; DriveFault if it would not be a rapid.
    """
    side, top = USED * room.farthest * settings.mm_per_unit, settings.rapid_speed_mm_s
    limits = settings.setpoints
    fastest = (limits.max_speed_mm_s if limits else None) or top
    steepest = (limits.max_acceleration_mm_s2 if limits else None) or settings.max_acceleration_mm_s2
    acceleration, jerk = min(steepest, settings.max_acceleration_mm_s2), settings.jerk_mm_s3
    # distance of a rapid of speed v: v^2 / a + v (a / j + cruise)
    spent_s = acceleration / jerk + CRUISE_S
    fits = acceleration / 2 * (math.sqrt(spent_s**2 + 4 * abs(side) / acceleration) - spent_s)
    if fastest < SLOWEST * top:
        most, rapid = settings.format_in_unit(fastest, "/s", "g"), settings.format_in_unit(top, "/s", "g")
        text = f"[axis.{axis}.setpoints] allows {most}, but G0 is {rapid}, so no rapid can be tested"
        key = settings.format_key("max_speed_mm_s")
        raise DriveFault(f"drive {axis}", f"{text}; raise its {key}, or omit --room")
    if fits < SLOWEST * top:
        least = SLOWEST * top * (SLOWEST * top / acceleration + spent_s)
        needed = f"{math.ceil(least / USED / settings.mm_per_unit)} {settings.unit}"
        text = f"the room is {room} {settings.unit}, but test rapids need {needed} to one side"
        raise DriveFault(f"drive {axis}", f"{text}; move the axis away from its end, and enlarge --room")
    speed = min(top, fits, fastest)
    way = min(abs(side), speed * (speed / acceleration + spent_s))
    return Stroke(settings, math.copysign(way, side), speed, acceleration, jerk)
