"""The planner of LinuxCNC (2.8 and later), cycle by cycle: profile ``linuxcnc``.

Modelled on its documentation and on its recorded demand: trapezoidal speeds with the acceleration that corners and arcs
leave, arcs or parabolas at corners within P, short lines joined within Q, and a look-ahead of fifty segments. Parabolas
result from overlapping segments: the next one accelerates while the last one brakes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np

from fdhil.config import MachineConfig
from fdhil.program.motions import ALL_AXES, ORIGIN, Arc, Dwell, Feed, Motion, Rapid, compute_end
from fdhil.program.planner.axis_limits import AxisLimits, check_duration
from fdhil.program.planner.linuxcnc.blends import join_segments
from fdhil.program.planner.linuxcnc.line_joining import join_short_feeds
from fdhil.program.planner.linuxcnc.path_segments import STOP, TANGENT, PathSegment, build_segment
from fdhil.program.planner.linuxcnc.servo_cycles import ServoCycles
from fdhil.records import Float

_DEPTH = 50
_UNSETTLED = 3  # newest segments, whose limits have just changed
_INTERPOLATED_ROWS = 2
Row = tuple[float, ...]  # the positions of ALL_AXES, source line, rapid


class LinuxcncPlanner:
    """Converts motions to rows; ProgramError if they last longer than ``max_rows``."""

    def __init__(self, config: MachineConfig, max_rows: float = math.inf) -> None:
        self._limits = AxisLimits.create_from_config(config)
        self._dt_s = self._limits.dt_s
        self._max_s = max_rows * self._dt_s
        self._stop_always = config.nc.corner == "exact_stop"
        self._settle_rows = self._limits.count_rows(config.nc.settle_s)
        self._end_rows = self._limits.count_rows(config.nc.end_rest_s)
        self._queue: deque[PathSegment] = deque()
        self._cycles = ServoCycles(self._queue, self._dt_s)
        self._at = ORIGIN
        self._line = 0
        self._count = 0

    def plan_parts(self, motions: Iterable[Motion], block_rows: int) -> Iterator[Float]:
        """Yield positions of ``ALL_AXES``, source line and rapid (0 or 1) in blocks (n, 11), beginning at rest."""
        rows: list[Row] = []
        past = np.zeros((2, len(ALL_AXES)))
        for row in self._generate_rows(motions):
            rows.append(row)
            if len(rows) >= block_rows:
                part, past = _interpolate_rows(rows, past)
                yield part
                rows = []
        if rows:
            yield _interpolate_rows(rows, past)[0]

    def _generate_rows(self, motions: Iterable[Motion]) -> Iterator[Row]:
        yield (*self._at, 0, False)
        for motion in join_short_feeds(motions):
            if isinstance(motion, Dwell):
                yield from self._run_cycles(0)
                self._line = motion.line
                yield from self._hold_position(self._limits.count_rows(motion.seconds))
            else:
                self._enqueue_motion(motion)
                yield from self._run_cycles(_DEPTH)
        yield from self._run_cycles(0)
        yield from self._hold_position(self._end_rows + _INTERPOLATED_ROWS)

    def _enqueue_motion(self, motion: Rapid | Feed | Arc) -> None:
        new = build_segment(motion, self._at, self._limits)
        self._at = compute_end(motion, self._at)
        if new is None:
            return
        self._line = motion.line
        self._check_duration(0, new.shape.length / new.free_speed / self._dt_s)
        if self._stop_always:
            new.ending = STOP
        if self._queue:
            for ready in join_segments(self._queue.pop(), new, self._limits):
                ready.settle_length(self._dt_s)
                self._queue.append(ready)
        self._queue.append(new)
        self._look_back()

    def _look_back(self) -> None:
        """Raise the end speeds of the newest segments, since there is one more to brake in."""
        queue = self._queue
        number = len(queue) - 1
        for place in range(number, max(0, number - _DEPTH), -1):
            here, before = queue[place], queue[place - 1]
            if before.ending != TANGENT:
                return
            reach = math.sqrt(here.end_speed**2 + 2.0 * here.path_acceleration * here.assured_length)
            speed = min(reach, here.target_speed, before.target_speed, before.kink_speed)
            if speed == before.end_speed and place < number - _UNSETTLED:
                return
            before.end_speed = speed

    def _run_cycles(self, left: int) -> Iterator[Row]:
        queue, cycles = self._queue, self._cycles
        while len(queue) > left + 1 or (not left and queue):
            here = queue[0]
            self._line = here.line
            cycles.run_cycle()
            self._check_duration()
            yield (*cycles.at, *cycles.others, here.line, here.rapid)
            if self._settle_rows and here.ending == STOP and (not queue or queue[0] is not here):
                yield from self._hold_position(self._settle_rows)

    def _hold_position(self, rows: int) -> Iterator[Row]:
        self._check_duration(rows)
        row = (*self._cycles.at, *self._cycles.others, self._line, False)
        for _ in range(rows):
            yield row

    def _check_duration(self, rows: int = 1, ahead: float = 0.0) -> None:
        self._count += rows
        check_duration(self._line, (self._count + ahead) * self._dt_s, self._max_s)


def _interpolate_rows(rows: list[Row], past: Float) -> tuple[Float, Float]:
    """Return a block of rows and its last two points, for the joints' cubic interpolation over three points."""
    table = np.array(rows, dtype=np.float64)
    points = np.concatenate([past, table[:, :-2]])
    table[:, :-2] = points[1:-1] + (points[:-2] - 2.0 * points[1:-1] + points[2:]) / 6.0
    return table, points[-2:]
