"""Move an enabled axis by strokes, inside its room and the drive's software limits."""

import math
from collections.abc import Callable
from typing import NamedTuple

from fdhil.commissioning.axis_motion import move_axes
from fdhil.commissioning.commissioning_record import CommissioningRecord
from fdhil.commissioning.master import Master
from fdhil.commissioning.set_points import AxisBounds, plan_straight_move
from fdhil.commissioning.stroke_planning import GENTLE, Stroke, TravelRoom
from fdhil.errors import DriveFault

SLACK_MM = 0.05  # tolerance of the return to the start
STOOD_MM = 1.0  # an axis that differs by more since its stop was moved, or has lost its position
RETURN_MM_S = 20.0
RETURN_ACCELERATION_MM_S2 = 200.0


class AllowedTravel(NamedTuple):
    """Permitted travel of an axis in machine co-ordinates, and its position at the start and when stopped."""

    low_mm: float
    high_mm: float
    start_mm: float = math.nan
    stopped_mm: float = math.nan

    def is_resumed(self, room: TravelRoom, mm_per_unit: float, here_mm: float) -> bool:
        """Return whether ``room`` gave this travel at the start, and the axis is still where the trial was stopped."""
        low_mm, high_mm = (self.start_mm + way * mm_per_unit for way in (room.back, room.forward))
        same = max(abs(self.low_mm - low_mm), abs(self.high_mm - high_mm)) < SLACK_MM
        return same and abs(here_mm - self.stopped_mm) < STOOD_MM


def get_position_mm(master: Master) -> float:
    """Return the axis' position."""
    return master.config.axis[master.axis].scaling.convert_to_mm(master.feedback.objects[master.profile.position])


def determine_travel(
    master: Master, record: CommissioningRecord, room: TravelRoom, given: AllowedTravel | None = None
) -> AllowedTravel:
    """Return the permitted travel; DriveFault if another limit is nearer or the axis is outside.

    ``given`` is the travel of a stopped trial: the same room means the same travel, if the axis has not moved since.
    Any other room counts from the present position, and must be inside ``given``.
    """
    settings = master.config.axis[master.axis]
    scaling, setpoints, unit = settings.scaling, settings.setpoints, settings.mm_per_unit
    here = get_position_mm(master)
    resumed = given is not None and given.is_resumed(room, unit, here)
    start = given.start_mm if given is not None and resumed else here
    low, high = start + room.back * unit, start + room.forward * unit
    limits: dict[str, AllowedTravel] = {}
    if record.travel is not None:
        limits["its software limits (0x607D)"] = AllowedTravel(
            *sorted(scaling.convert_to_mm(limit) for limit in record.travel)
        )
    if setpoints is not None:
        limits["[axis.*.setpoints]"] = AllowedTravel(*setpoints.travel_mm)
    if given is not None and not resumed:
        limits["the room of the interrupted trial"] = AllowedTravel(given.low_mm - SLACK_MM, given.high_mm + SLACK_MM)
    for by, (least, most, *_) in limits.items():
        if low < least or high > most:
            text = f"its position is {settings.format_in_unit(here, form='.3f')}, limited to {least / unit:g} to "
            text += f"{settings.format_in_unit(most, form='g')} by {by}, but --room is {room} {settings.unit} from here"
            advice = "change --room, or move the axis away from its end; --again begins a new trial"
            raise DriveFault(master.device, f"{text}; {advice}")
    return AllowedTravel(low, high, start)


def plan_return(master: Master, travel_mm: AllowedTravel) -> Stroke | None:
    """Return the slow stroke back to the start of a stopped trial; None if the axis is there."""
    away_mm, settings = travel_mm.start_mm - get_position_mm(master), master.config.axis[master.axis]
    if abs(away_mm) <= SLACK_MM:
        return None
    speed = min(RETURN_MM_S, GENTLE * settings.top_speed_mm_s)
    acceleration = min(RETURN_ACCELERATION_MM_S2, GENTLE * settings.max_acceleration_mm_s2)
    return Stroke(settings, round(away_mm, 3), speed, acceleration, 10 * acceleration)


def run_stroke(
    master: Master,
    travel_mm: AllowedTravel,
    moved: Stroke,
    rest_s: float,
    at: Callable[[float], None] = lambda _mm: None,
) -> None:
    """Move by one stroke and rest. Ends as :func:`move`, also by Ctrl-C: the axis is braked.

    ``at`` is called with the position in mm while the axis moves.
    """
    settings, period_s = master.config.axis[master.axis], master.period_s
    bounds = AxisBounds.create_for_axis(
        master.axis, settings, period_s, travel_mm[:2], moved.speed_mm_s, moved.acceleration_mm_s2
    )
    start = 0 if master.target is None else master.target  # move refuses an axis without a held target
    goal = start + round(settings.scaling.sign * moved.distance_mm * settings.scaling.increments_per_mm)
    rounding = round(moved.acceleration_mm_s2 / moved.jerk_mm_s3 / period_s)
    rows = plan_straight_move((start,), (goal,), (bounds.speed,), (bounds.acceleration,), rounding)
    move_axes([master], [bounds], rows, lambda: at(get_position_mm(master)))
    master.wait_cycles(round(rest_s / period_s))
