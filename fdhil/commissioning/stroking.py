"""Moves an enabled axis by strokes, inside its room and the drive's software limits."""

from __future__ import annotations

from fdhil.commissioning.master import Master
from fdhil.commissioning.moving import move
from fdhil.commissioning.record import CommissioningRecord
from fdhil.commissioning.set_points import Bounds, straight
from fdhil.commissioning.strokes import Room, Stroke
from fdhil.errors import DriveFault

Travel = tuple[float, float]
"""From where to where an axis may go, mm."""


def travel_of(master: Master, record: CommissioningRecord, room: Room) -> Travel:
    """Return where the axis may go from where it stands; DriveFault where other limits of its travel are nearer."""
    scaling = master.config.axis[master.axis].scaling
    here = scaling.to_mm(master.heard.objects[master.profile.position])
    low, high = here + room.back_mm, here + room.forward_mm
    limits = {}
    if record.travel is not None:
        limits["its software limits (0x607D)"] = sorted(scaling.to_mm(limit) for limit in record.travel)
    if (said := master.config.axis[master.axis].setpoints) is not None:
        limits["[axis.*.setpoints]"] = sorted(said.travel_mm)
    for by, (least, most) in limits.items():
        if low < least or high > most:
            text = f"it stands at {here:.3f} mm and may go from {least:g} to {most:g} mm by {by}, not {room} from here"
            raise DriveFault(master.device, f"{text}; give it less with --room, or move it away from its end")
    return low, high


def stroke(master: Master, travel_mm: Travel, moved: Stroke, rest_s: float) -> None:
    """Move by one stroke and rest; as :func:`move` ends, also by Ctrl-C: the axis was braked then."""
    settings, period_s = master.config.axis[master.axis], master.period_s
    bounds = Bounds.of(master.axis, settings, period_s, travel_mm, moved.speed_mm_s, moved.acceleration_mm_s2)
    start = 0 if master.target is None else master.target  # what is not held is refused where it would be moved
    goal = start + round(settings.scaling.sign * moved.distance_mm * settings.scaling.increments_per_mm)
    rounding = round(moved.acceleration_mm_s2 / moved.jerk_mm_s3 / period_s)
    move([master], [bounds], straight((start,), (goal,), (bounds.speed,), (bounds.acceleration,), rounding))
    master.wait_cycles(round(rest_s / period_s))
