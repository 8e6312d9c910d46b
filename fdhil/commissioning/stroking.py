"""Moves an enabled axis by strokes, inside its room and the drive's software limits."""

from typing import NamedTuple

from fdhil.commissioning.master import Master
from fdhil.commissioning.moving import move
from fdhil.commissioning.record import CommissioningRecord
from fdhil.commissioning.set_points import Bounds, straight
from fdhil.commissioning.strokes import Room, Stroke
from fdhil.errors import DriveFault

SLACK_MM = 0.05  # by which an axis that came back may stand beside where it began


class Travel(NamedTuple):
    """From where to where an axis may go."""

    low_mm: float
    high_mm: float


def travel_of(master: Master, record: CommissioningRecord, room: Room, given: Travel | None = None) -> Travel:
    """Return where the axis may go from where it stands; DriveFault where another limit of its travel is nearer.

    ``given`` is the travel of the trial that was stopped: the same words from another place mean another one.
    """
    settings = master.config.axis[master.axis]
    scaling, said, unit = settings.scaling, settings.setpoints, settings.mm_per_unit
    here = scaling.to_mm(master.heard.objects[master.profile.position])
    low, high = here + room.back * unit, here + room.forward * unit
    limits: dict[str, Travel] = {}
    if record.travel is not None:
        limits["its software limits (0x607D)"] = Travel(*sorted(scaling.to_mm(limit) for limit in record.travel))
    if said is not None:
        limits["[axis.*.setpoints]"] = Travel(*said.travel_mm)
    if given is not None:
        limits["the room that the trial began with"] = Travel(given.low_mm - SLACK_MM, given.high_mm + SLACK_MM)
    for by, (least, most) in limits.items():
        if low < least or high > most:
            text = f"it stands at {settings.shown(here, form='.3f')} and may go from {least / unit:g} to "
            text += f"{settings.shown(most, form='g')} by {by}, not {room} {settings.unit} from here"
            advice = "give it another --room, or move it away from its end; --again begins a new trial"
            raise DriveFault(master.device, f"{text}; {advice}")
    return Travel(low, high)


def stroke(master: Master, travel_mm: Travel, moved: Stroke, rest_s: float) -> None:
    """Move by one stroke and rest; as :func:`move` ends, also by Ctrl-C: the axis was braked then."""
    settings, period_s = master.config.axis[master.axis], master.period_s
    bounds = Bounds.of(master.axis, settings, period_s, travel_mm, moved.speed_mm_s, moved.acceleration_mm_s2)
    start = 0 if master.target is None else master.target  # what is not held is refused where it would be moved
    goal = start + round(settings.scaling.sign * moved.distance_mm * settings.scaling.increments_per_mm)
    rounding = round(moved.acceleration_mm_s2 / moved.jerk_mm_s3 / period_s)
    move([master], [bounds], straight((start,), (goal,), (bounds.speed,), (bounds.acceleration,), rounding))
    master.wait_cycles(round(rest_s / period_s))
