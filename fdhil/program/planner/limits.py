"""What the axes can do, and the motions that no planner takes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdhil.config import MachineConfig
from fdhil.errors import ProgramError
from fdhil.program.motions import PLANE_AXES, Arc, Dwell, Feed, Point, Rapid

_TINY_MM = 1e-9
_MAX_DWELL_ROWS = 1e9


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """Per axis X, Y, Z: whether it is there, and its speed (mm/s), acceleration (mm/s2) and jerk (mm/s3), else inf."""

    present: tuple[bool, bool, bool]
    speed: Point
    acceleration: Point
    jerk: Point

    @staticmethod
    def of(config: MachineConfig) -> AxisLimits:
        """Return the limits of a machine's axes."""
        x, y, z = (config.axis.get(name) for name in "XYZ")
        axes = (x, y, z)
        speed = [axis.rapid_speed_mm_s if axis else math.inf for axis in axes]
        acceleration = [axis.max_acceleration_mm_s2 if axis else math.inf for axis in axes]
        jerk = [axis.jerk_mm_s3 if axis else math.inf for axis in axes]
        return AxisLimits(
            (x is not None, y is not None, z is not None),
            (speed[0], speed[1], speed[2]),
            (acceleration[0], acceleration[1], acceleration[2]),
            (jerk[0], jerk[1], jerk[2]),
        )

    def check(self, motion: Rapid | Feed | Arc, start: Point) -> None:
        """Raise ProgramError for a feed of nothing, and for a motion of an axis that the machine lacks."""
        if not isinstance(motion, Rapid) and not motion.feed > 0.0:
            raise ProgramError(motion.line, "F", "the feed rate is 0, so the move would never end; give F")
        moved = [abs(b - a) > _TINY_MM for a, b in zip(start, motion.end, strict=True)]
        if isinstance(motion, Arc):
            for axis in PLANE_AXES[motion.plane][:2]:
                moved[axis] = True
        for name, moves, present in zip("XYZ", moved, self.present, strict=True):
            if moves and not present:
                raise ProgramError(
                    motion.line, name, f"moves axis {name}, which the configuration lacks; add [axis.{name}]"
                )


def check_dwell(motion: Dwell, dt_s: float) -> None:
    """Raise ProgramError for a dwell that cannot be counted."""
    if motion.seconds / dt_s > _MAX_DWELL_ROWS:
        raise ProgramError(motion.line, f"P{motion.seconds:g}", "is too long a dwell to plan")
