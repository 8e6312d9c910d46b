"""The NC's planner: motions -> reference on the SYNC grid, by the profile that the configuration names.

``fir``: the NC runs along the path at the programmed feed and smooths each axis' demand by causal moving averages,
from rest at the start point. It stops exactly between rapid and feed, after each rapid and at a dwell, and between
feeds only when the machine's configuration says so. ``trapezoidal`` and ``jerk_limited`` look ahead and keep each axis'
limits; corners follow G61, G61.1 and G64 P. All sampling is by whole blocks of numpy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from fdhil.config import MachineConfig
from fdhil.program.motions import Motion
from fdhil.program.planner import linuxcnc
from fdhil.program.planner.look_ahead import LookAhead
from fdhil.program.planner.smoothing import Smoother
from fdhil.program.planner.timeline import Timeline
from fdhil.records import Float, Int, Trajectory, frozen, frozen_ints

MAX_ROWS = 10_000_000
_BLOCK_ROWS = 1 << 16
Part = tuple[Float, Int, Int]  # position (n, 3) in mm, source line (n,), rapid (n,) 0 or 1


def plan(motions: Iterable[Motion], config: MachineConfig) -> Trajectory:
    """Return the reference that the NC makes of ``motions``; row 0 is the rest at machine zero.

    ProgramError for an axis that the machine does not have, a feed of nothing, and a duration of more than
    ``MAX_ROWS`` SYNC periods.
    """
    blocks = list(stream(motions, config, _BLOCK_ROWS, MAX_ROWS))
    rapid = np.concatenate([block.rapid for block in blocks])
    rapid.setflags(write=False)
    return Trajectory(
        dt_s=config.machine.sync_period_s,
        time_s=frozen(np.concatenate([block.time_s for block in blocks])),
        position_mm={axis: frozen(np.concatenate([b.position_mm[axis] for b in blocks])) for axis in config.axis},
        rapid=rapid,
        line=frozen_ints(np.concatenate([block.line for block in blocks])),
    )


def stream(
    motions: Iterable[Motion], config: MachineConfig, block_rows: int, max_rows: float = math.inf
) -> Iterator[Trajectory]:
    """Yield the same reference in blocks of ``block_rows`` (the last one shorter), in flat memory.

    A block is there as soon as the motions that reach into it were read; its times go on from the block before.
    """
    row = 0
    kept: list[Part] = []
    waiting = 0
    parts = {"fir": _smoothed, "linuxcnc": _cycle_by_cycle}.get(config.nc.profile, _looked_ahead)
    for part in parts(motions, config, block_rows, max_rows):
        kept.append(part)
        waiting += part[1].size
        while waiting >= block_rows:
            block, kept = _cut(kept, block_rows)
            yield _trajectory(block, row, config)
            row += block_rows
            waiting -= block_rows
    if waiting:
        block, _ = _cut(kept, waiting)
        yield _trajectory(block, row, config)


def _smoothed(motions: Iterable[Motion], config: MachineConfig, block_rows: int, max_rows: float) -> Iterator[Part]:
    dt_s = config.machine.sync_period_s
    smoother = Smoother(config.nc.smoothing_s, dt_s)
    timeline = Timeline(config, smoother.settle_rows, max_rows)
    for segments in timeline.batches(motions):
        for rows in _spans(segments.first_row, segments.end_row, block_rows):
            raw, line, rapid = segments.sample(rows, dt_s)
            yield smoother(raw), line, rapid


def _looked_ahead(motions: Iterable[Motion], config: MachineConfig, block_rows: int, max_rows: float) -> Iterator[Part]:
    dt_s = config.machine.sync_period_s
    ahead = LookAhead(config, max_rows)
    smoother = Smoother((ahead.filter_rows * dt_s,), dt_s)
    for stretch in ahead.stretches(motions):
        for rows in _spans(stretch.first_row, stretch.end_row, block_rows):
            path, line, rapid = stretch.sample(rows, dt_s)
            smooth = smoother(path[:, None])[:, 0]
            yield ahead.curve.at(smooth), line, rapid
            ahead.curve.forget(float(smooth[-1]))


def _cycle_by_cycle(
    motions: Iterable[Motion], config: MachineConfig, block_rows: int, max_rows: float
) -> Iterator[Part]:
    return linuxcnc.Planner(config, max_rows).parts(motions, block_rows)


def _spans(first_row: int, end_row: int, block_rows: int) -> Iterator[Int]:
    for first in range(first_row, end_row, block_rows):
        yield np.arange(first, min(first + block_rows, end_row))


def _cut(kept: list[Part], rows: int) -> tuple[Part, list[Part]]:
    position = np.concatenate([part[0] for part in kept])
    line = np.concatenate([part[1] for part in kept])
    rapid = np.concatenate([part[2] for part in kept])
    rest = [(position[rows:], line[rows:], rapid[rows:])] if line.size > rows else []
    return (position[:rows], line[:rows], rapid[:rows]), rest


def _trajectory(block: Part, first_row: int, config: MachineConfig) -> Trajectory:
    position, line, rapid_rows = block
    n = line.size
    rapid = rapid_rows.astype(np.bool_)
    rapid.setflags(write=False)
    columns = {axis: position[:, "XYZ".index(axis)] if axis in "XYZ" else np.zeros(n) for axis in config.axis}
    return Trajectory(
        dt_s=config.machine.sync_period_s,
        time_s=frozen((first_row + np.arange(n)) * config.machine.sync_period_s),
        position_mm={axis: frozen(column) for axis, column in columns.items()},
        rapid=rapid,
        line=frozen_ints(line),
    )
