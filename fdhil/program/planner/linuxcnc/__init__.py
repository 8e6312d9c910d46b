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
from fdhil.program.motions import ALL_AXES, ORIGIN, Arc, Dwell, Feed, Motion, Rapid, reached
from fdhil.program.planner.limits import AxisLimits, check_duration
from fdhil.program.planner.linuxcnc.blends import join
from fdhil.program.planner.linuxcnc.cycles import Cycles
from fdhil.program.planner.linuxcnc.joining import joined
from fdhil.program.planner.linuxcnc.segments import STOP, TANGENT, Segment, segment
from fdhil.records import Float

_DEPTH = 50
_UNSETTLED = 3  # newest segments, whose limits have just changed
_INTERPOLATED_ROWS = 2
Row = tuple[float, ...]  # the positions of ALL_AXES, source line, rapid


class Planner:
    """Converts motions to rows; ProgramError if they last longer than ``max_rows``."""

    def __init__(self, config: MachineConfig, max_rows: float = math.inf) -> None:
        self._limits = AxisLimits.of(config)
        self._dt_s = self._limits.dt_s
        self._max_s = max_rows * self._dt_s
        self._stop_always = config.nc.corner == "exact_stop"
        self._settle_rows = self._limits.rows(config.nc.settle_s)
        self._end_rows = self._limits.rows(config.nc.end_rest_s)
        self._queue: deque[Segment] = deque()
        self._cycles = Cycles(self._queue, self._dt_s)
        self._at = ORIGIN
        self._line = 0
        self._count = 0

    def parts(self, motions: Iterable[Motion], block_rows: int) -> Iterator[Float]:
        """Yield positions of ``ALL_AXES``, source line and rapid (0 or 1) in blocks (n, 11), beginning at rest."""
        rows: list[Row] = []
        past = np.zeros((2, len(ALL_AXES)))
        for row in self._rows(motions):
            rows.append(row)
            if len(rows) >= block_rows:
                part, past = _part(rows, past)
                yield part
                rows = []
        if rows:
            yield _part(rows, past)[0]

    def _rows(self, motions: Iterable[Motion]) -> Iterator[Row]:
        yield (*self._at, 0, False)
        for motion in joined(motions):
            if isinstance(motion, Dwell):
                yield from self._run(0)
                self._line = motion.line
                yield from self._rest(self._limits.rows(motion.seconds))
            else:
                self._take(motion)
                yield from self._run(_DEPTH)
        yield from self._run(0)
        yield from self._rest(self._end_rows + _INTERPOLATED_ROWS)

    def _take(self, motion: Rapid | Feed | Arc) -> None:
        new = segment(motion, self._at, self._limits)
        self._at = reached(motion, self._at)
        if new is None:
            return
        self._line = motion.line
        self._check(0, new.shape.length / new.free / self._dt_s)
        if self._stop_always:
            new.ending = STOP
        if self._queue:
            for ready in join(self._queue.pop(), new, self._limits):
                ready.settle(self._dt_s)
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
            reach = math.sqrt(here.end_speed**2 + 2.0 * here.along * here.sure)
            speed = min(reach, here.target, before.target, before.kink_speed)
            if speed == before.end_speed and place < number - _UNSETTLED:
                return
            before.end_speed = speed

    def _run(self, left: int) -> Iterator[Row]:
        queue, cycles = self._queue, self._cycles
        while len(queue) > left + 1 or (not left and queue):
            here = queue[0]
            self._line = here.line
            cycles.step()
            self._check()
            yield (*cycles.at, *cycles.others, here.line, here.rapid)
            if self._settle_rows and here.ending == STOP and (not queue or queue[0] is not here):
                yield from self._rest(self._settle_rows)

    def _rest(self, rows: int) -> Iterator[Row]:
        self._check(rows)
        row = (*self._cycles.at, *self._cycles.others, self._line, False)
        for _ in range(rows):
            yield row

    def _check(self, rows: int = 1, ahead: float = 0.0) -> None:
        self._count += rows
        check_duration(self._line, (self._count + ahead) * self._dt_s, self._max_s)


def _part(rows: list[Row], past: Float) -> tuple[Float, Float]:
    """Return a block of rows and its last two points, for the joints' cubic interpolation over three points."""
    table = np.array(rows, dtype=np.float64)
    points = np.concatenate([past, table[:, :-2]])
    table[:, :-2] = points[1:-1] + (points[:-2] - 2.0 * points[1:-1] + points[2:]) / 6.0
    return table, points[-2:]
