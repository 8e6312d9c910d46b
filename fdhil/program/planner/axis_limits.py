"""Limits that every planner keeps: the axes', the longest program, and the grid of SYNC rows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from fdhil.config import MachineConfig, PositionRange
from fdhil.errors import ProgramError
from fdhil.program.motions import ALL_AXES, ORIGIN, PLANE_AXES, Arc, Dwell, Motion, Place, Rapid, compute_end

TICK_TOLERANCE = 1e-6  # of a row: an end this close after a row counts as on it
_TINY_MM = 1e-9
_MAX_DWELL_ROWS = 1e9


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """Per axis of ``ALL_AXES``: speed (mm/s), acceleration (mm/s2) and jerk (mm/s3), infinite for a missing axis.

    Those of a rotary axis are in degrees.
    """

    speed: Place
    acceleration: Place
    jerk: Place
    dt_s: float
    ranges: tuple[PositionRange | None, ...]
    path_speed: float  # mm/s along the path
    linear: frozenset[str]  # axes A, B, C configured in mm

    @staticmethod
    def create_from_config(config: MachineConfig) -> AxisLimits:
        """Return the limits of a machine's axes and its SYNC period."""

        dt_s, linear = config.machine.sync_period_s, frozenset(a for a in "ABC" if a in config.axis)
        linear = frozenset(name for name in linear if config.axis[name].unit == "mm")
        axes = [config.axis.get(name) if name not in linear else None for name in ALL_AXES]

        def read_limit(key: str) -> Place:
            return tuple(math.inf if axis is None else getattr(axis, key) / axis.mm_per_unit for axis in axes)

        found = zip(ALL_AXES, axes, strict=True)
        ranges = tuple(None if axis is None else PositionRange.build_for_axis(name, axis, dt_s) for name, axis in found)
        return AxisLimits(
            read_limit("rapid_speed_mm_s"),
            read_limit("max_acceleration_mm_s2"),
            read_limit("jerk_mm_s3"),
            dt_s,
            ranges,
            config.nc.max_path_speed_mm_s,
            linear,
        )

    def check_motion(self, motion: Motion, start: Place) -> None:
        """Raise ProgramError for an endless feed or dwell, an axis the machine lacks, a position beyond 32 bits."""
        if isinstance(motion, Dwell):
            if motion.seconds / self.dt_s > _MAX_DWELL_ROWS:
                raise ProgramError(motion.line, f"P{motion.seconds:g}", "is too long a dwell")
            return
        if not isinstance(motion, Rapid) and not motion.feed > 0.0:
            raise ProgramError(motion.line, "F", "the feed rate is 0, so the move would never end; add F")
        end = compute_end(motion, start)
        moved = [abs(b - a) > _TINY_MM for a, b in zip(start, end, strict=True)]
        if isinstance(motion, Arc):
            for axis in PLANE_AXES[motion.plane][:2]:
                moved[axis] = True
        for name, moves, speed in zip(ALL_AXES, moved, self.speed, strict=True):
            if moves and speed == math.inf:
                raise ProgramError(motion.line, name, f"moves axis {name}, {self._describe_missing_axis(name)}")
        for reach, at in zip(self.ranges, end, strict=True):
            if reach is not None and not reach.can_reach(at * reach.mm_per_unit):
                raise ProgramError(motion.line, reach.axis, reach.describe_fault(at * reach.mm_per_unit))

    def _describe_missing_axis(self, axis: str) -> str:
        if axis in self.linear:
            return f'which is rotary, but the configuration has it in mm; set unit = "deg" in [axis.{axis}]'
        rotary = ' with unit = "deg" and radius_mm' if axis in "ABC" else ""
        return f"which the configuration lacks; add [axis.{axis}]{rotary}"

    def count_rows(self, seconds: float) -> int:
        """Return the first SYNC row at or after a time."""
        return math.ceil(seconds / self.dt_s - TICK_TOLERANCE)


def check_motions(motions: Iterable[Motion], config: MachineConfig) -> Iterator[Motion]:
    """Yield the motions that the machine can execute; ProgramError for the first that it cannot."""
    limits, at = AxisLimits.create_from_config(config), ORIGIN
    for motion in motions:
        limits.check_motion(motion, at)
        at = at if isinstance(motion, Dwell) else compute_end(motion, at)
        yield motion


def check_duration(line: int, seconds: float, most_s: float) -> None:
    """Raise ProgramError for a program that lasts too long."""
    if seconds > most_s:
        raise ProgramError(line, "", f"by here the program lasts {seconds / 3600:.3g} h; split it")
