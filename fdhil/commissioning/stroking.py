"""Moves an enabled axis by strokes inside its room, and brings it to a stand whatever happens."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

from fdhil.cia402 import State
from fdhil.commissioning.master import Master
from fdhil.commissioning.record import CommissioningRecord
from fdhil.commissioning.set_points import Bounds, SetPoints, straight
from fdhil.commissioning.strokes import Room, Stroke
from fdhil.commissioning.survey import faulted, require_enabled
from fdhil.errors import DeviceError, DriveFault

PATIENCE = 20.0  # times as long as a stroke lasts
BRAKE_TIMEOUT_S = 10.0


def check_room(master: Master, record: CommissioningRecord, room: Room) -> tuple[float, float]:
    """Return the travel that the room leaves, mm; DriveFault where the drive's software limits are nearer."""
    scaling = master.config.axis[master.axis].scaling
    here = scaling.to_mm(master.heard.objects[master.profile.position])
    low, high = here + room.back_mm, here + room.forward_mm
    if record.travel is not None:
        least, most = sorted(scaling.to_mm(limit) for limit in record.travel)
        if low < least or high > most:
            text = (
                f"it stands at {here:.3f} mm and may go from {least:g} to {most:g} mm by its software limits (0x607D), "
                f"not {room} from here; give it less with --room, or move it away from its end"
            )
            raise DriveFault(master.device, text)
    return low, high


class Stroking:
    """Strokes of one enabled axis; each begins where the last one ended."""

    def __init__(self, master: Master, path: SetPoints) -> None:
        self._master, self._path = master, path

    def move(self, stroke: Stroke, rest_s: float) -> None:
        """Move by a stroke and rest; DriveFault when the axis was stopped on its way."""
        master, path = self._master, self._path
        settings, period_s = master.config.axis[master.axis], master.period_s
        per_mm = settings.scaling.increments_per_mm
        start = path.position[0]
        goal = round(start + settings.scaling.sign * stroke.distance_mm * per_mm)
        speed, acceleration = stroke.speed_mm_s * period_s * per_mm, stroke.acceleration_mm_s2 * period_s**2 * per_mm
        rounding = round(stroke.acceleration_mm_s2 / stroke.jerk_mm_s3 / period_s)
        rows = straight((start,), (goal,), (speed,), (acceleration,), rounding)
        path.play(rows)
        patience_s = 5.0 + PATIENCE * len(rows) * period_s
        master.wait(self._over, patience_s, "its set-points were not sent; take load off this computer")
        if path.stopped is not None:
            raise DriveFault(master.device, f"{path.stopped}; it was braked; find out why, and start again")
        require_enabled(master)
        master.wait_cycles(round(rest_s / period_s))

    def _over(self) -> bool:
        if self._master.state() is not State.OPERATION_ENABLED:
            self._path.stop("it is not enabled any more")
            raise faulted(self._master, f"it fell from Operation enabled to {self._master.state().value} on its way")
        return self._path.resting


@contextmanager
def stroking(master: Master, travel_mm: tuple[float, float], fastest: Stroke) -> Iterator[Stroking]:
    """Let an enabled axis be moved, no faster than ``fastest``; at the end it stands, braked if it has to be."""
    settings = master.config.axis[master.axis]
    limits = fastest.speed_mm_s, fastest.acceleration_mm_s2
    bounds = Bounds.of(master.axis, settings, master.period_s, travel_mm, *limits)
    master.hold_here()
    assert master.target is not None
    path = master.loop.path = SetPoints([bounds], [master.target])
    try:
        yield Stroking(master, path)
    finally:
        if not path.resting:
            path.stop("stopped by the operator")
            with suppress(DeviceError):  # a bus that is gone brakes nothing: the drive's own watchdog does
                master.wait(lambda: path.resting, BRAKE_TIMEOUT_S, "")
        master.loop.path = None
