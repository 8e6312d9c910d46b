"""The limits that every planner keeps: the axes' own, the longest program, and the grid of SYNC rows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from fdhil.config import MachineConfig, PositionRange
from fdhil.errors import ProgramError
from fdhil.program.motions import PLANE_AXES, Arc, Dwell, Motion, Point, Rapid

TICK_TOLERANCE = 1e-6  # of a row: an end so little after a row counts as on it
_TINY_MM = 1e-9
_MAX_DWELL_ROWS = 1e9


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """Per axis X, Y, Z: speed (mm/s), acceleration (mm/s2) and jerk (mm/s3), infinite for an axis that is not there."""

    speed: Point
    acceleration: Point
    jerk: Point
    dt_s: float
    ranges: tuple[PositionRange | None, ...]
    axes: frozenset[str]
    path_speed: float  # mm/s along the path

    @staticmethod
    def of(config: MachineConfig) -> AxisLimits:
        """Return the limits of a machine's axes and its SYNC period."""

        def each(name: str) -> Point:
            x, y, z = (getattr(config.axis[axis], name) if axis in config.axis else math.inf for axis in "XYZ")
            return x, y, z

        speed, acceleration = each("rapid_speed_mm_s"), each("max_acceleration_mm_s2")
        dt_s, axes = config.machine.sync_period_s, config.axis
        ranges = tuple(PositionRange.of(axis, axes[axis], dt_s) if axis in axes else None for axis in "XYZ")
        return AxisLimits(
            speed,
            acceleration,
            each("jerk_mm_s3"),
            dt_s,
            ranges,
            frozenset(axes),
            config.nc.max_path_speed_mm_s,
        )

    def check(self, motion: Motion, start: Point) -> None:
        """Raise ProgramError for an endless feed or dwell, an axis that the machine lacks, a place beyond 32 bits."""
        if isinstance(motion, Dwell):
            if motion.seconds / self.dt_s > _MAX_DWELL_ROWS:
                raise ProgramError(motion.line, f"P{motion.seconds:g}", "is too long a dwell to plan")
            return
        if not isinstance(motion, Rapid) and not motion.feed > 0.0:
            raise ProgramError(motion.line, "F", "the feed rate is 0, so the move would never end; give F")
        moved = [abs(b - a) > _TINY_MM for a, b in zip(start, motion.end, strict=True)]
        if isinstance(motion, Arc):
            for axis in PLANE_AXES[motion.plane][:2]:
                moved[axis] = True
        for name, moves, speed in zip("XYZ", moved, self.speed, strict=True):
            if moves and speed == math.inf:
                raise ProgramError(
                    motion.line, name, f"moves axis {name}, which the configuration lacks; add [axis.{name}]"
                )
        for turned in motion.rotary:
            if abs(turned.end - turned.start) > _TINY_MM:
                raise self._not_planned(motion.line, turned.axis)
        for reach, end in zip(self.ranges, motion.end, strict=True):
            if reach is not None and not reach.fits(end):
                raise ProgramError(motion.line, reach.axis, reach.fault(end))

    def _not_planned(self, line: int, axis: str) -> ProgramError:
        lacks = "" if axis in self.axes else f", which the configuration lacks: add [axis.{axis}]"
        also = "; programs are planned in X, Y and Z, so that the path is unknown: record the demand with fdhil record"
        return ProgramError(line, axis, f"moves axis {axis}{lacks}{also}")

    def rows(self, seconds: float) -> int:
        """Return the first SYNC row that is not before a time."""
        return math.ceil(seconds / self.dt_s - TICK_TOLERANCE)


def checked(motions: Iterable[Motion], config: MachineConfig) -> Iterator[Motion]:
    """Yield motions that the machine can be ordered; ProgramError for the first that it cannot."""
    limits, at = AxisLimits.of(config), (0.0, 0.0, 0.0)
    for motion in motions:
        limits.check(motion, at)
        at = at if isinstance(motion, Dwell) else motion.end
        yield motion


def check_duration(line: int, seconds: float, most_s: float) -> None:
    """Raise ProgramError for a program that lasts too long."""
    if seconds > most_s:
        raise ProgramError(line, "", f"by here the program lasts {seconds / 3600:.3g} h; split it")
