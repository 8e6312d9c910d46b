"""The NC's planner: converts motions to a reference on the SYNC grid, by the configured profile.

``fir``: the NC follows the path at the programmed feed and smooths each axis' demand by causal moving averages, from
rest at the start point. It stops exactly between rapid and feed, after each rapid and at a dwell, and between feeds
only if configured. ``trapezoidal`` and ``jerk_limited`` look ahead and keep each axis' limits; corners follow G61,
G61.1 and G64 P. Sampling is by whole blocks in numpy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from fdhil.config import MachineConfig
from fdhil.errors import ProgramError
from fdhil.program.motions import ALL_AXES, Dwell, Motion, Probe
from fdhil.program.nc_dialect import Dialect
from fdhil.program.planner import linuxcnc
from fdhil.program.planner.axis_limits import check_motions
from fdhil.program.planner.look_ahead import LookAhead
from fdhil.program.planner.smoothing import Smoother
from fdhil.program.planner.timeline import Timeline
from fdhil.program.position_range_check import find_first_out_of_range
from fdhil.program.program_notes import ProgramNotes
from fdhil.records import Float, Int, Trajectory, freeze_array, freeze_integers

MAX_ROWS = 10_000_000
_BLOCK_ROWS = 1 << 16


def plan(motions: Iterable[Motion], config: MachineConfig, max_rows: int = MAX_ROWS) -> Trajectory:
    """Return the reference that the NC plans from ``motions``; row 0 is at rest at machine zero.

    ProgramError for an axis that the machine lacks, a feed of zero, and more than ``max_rows`` SYNC periods.
    """
    notes = ProgramNotes(Dialect.create_from_config(config.nc))
    rows = np.concatenate(list(_plan_parts(notes.watch_motions(motions), config, _BLOCK_ROWS, max_rows)))
    return replace(_build_trajectory(rows, 0, config), notes=notes.notes)


def stream_trajectory(
    motions: Iterable[Motion], config: MachineConfig, block_rows: int, max_rows: float = math.inf
) -> Iterator[Trajectory]:
    """Yield the same reference in blocks of ``count_block_rows`` (the last one shorter), in constant memory.

    A block is yielded as soon as its motions are known; its times continue those of the previous block.
    """
    row = 0
    waiting = np.empty((0, len(ALL_AXES) + 2))
    for part in _plan_parts(motions, config, block_rows, max_rows):
        waiting = np.concatenate([waiting, part])
        while len(waiting) >= block_rows:
            yield _build_trajectory(waiting[:block_rows], row, config)
            waiting = waiting[block_rows:]
            row += block_rows
    if len(waiting):
        yield _build_trajectory(waiting, row, config)


def _plan_parts(motions: Iterable[Motion], config: MachineConfig, block_rows: int, max_rows: float) -> Iterator[Float]:
    """Yield the positions of ``ALL_AXES``, source line and rapid (0 or 1) of the next rows, (n, 11)."""
    motions = _insert_probe_stops(check_motions(motions, config))
    if config.nc.profile == "linuxcnc":
        return linuxcnc.LinuxcncPlanner(config, max_rows).plan_parts(motions, block_rows)
    made = _plan_smoothed if config.nc.profile == "fir" else _plan_with_look_ahead
    return made(motions, config, block_rows, max_rows)


def _insert_probe_stops(motions: Iterable[Motion]) -> Iterator[Motion]:
    for motion in motions:
        if isinstance(motion, Probe):
            yield Dwell(motion.line, 0.0)
            yield motion
            yield Dwell(motion.line, 0.0)
        else:
            yield motion


def _plan_smoothed(
    motions: Iterable[Motion], config: MachineConfig, block_rows: int, max_rows: float
) -> Iterator[Float]:
    dt_s = config.machine.sync_period_s
    smoother = Smoother(config.nc.smoothing_s, dt_s)
    timeline = Timeline(config, smoother.settle_rows, max_rows)
    for segments in timeline.plan_batches(motions):
        for rows in _split_into_spans(segments.first_row, segments.end_row, block_rows):
            part = segments.sample_rows(rows, dt_s)
            part[:, :-2] = smoother(part[:, :-2])
            yield part


def _plan_with_look_ahead(
    motions: Iterable[Motion], config: MachineConfig, block_rows: int, max_rows: float
) -> Iterator[Float]:
    dt_s = config.machine.sync_period_s
    ahead = LookAhead(config, max_rows)
    smoother = Smoother((ahead.filter_rows * dt_s,), dt_s)
    for stretch in ahead.plan_stretches(motions):
        for rows in _split_into_spans(stretch.first_row, stretch.end_row, block_rows):
            sampled = stretch.sample_rows(rows, dt_s)
            path_mm = smoother(sampled[:, :1])[:, 0]
            yield np.column_stack([ahead.curve.compute_points(path_mm), sampled[:, 1:]])
            ahead.curve.drop_before(float(path_mm[-1]))


def _split_into_spans(first_row: int, end_row: int, block_rows: int) -> Iterator[Int]:
    for first in range(first_row, end_row, block_rows):
        yield np.arange(first, min(first + block_rows, end_row))


def _build_trajectory(rows: Float, first_row: int, config: MachineConfig) -> Trajectory:
    n, dt_s = len(rows), config.machine.sync_period_s
    rapid = rows[:, -1].astype(np.bool_)
    rapid.setflags(write=False)
    position_mm = {
        name: freeze_array(rows[:, ALL_AXES.index(name[0])] * axis.mm_per_unit if name[0] in ALL_AXES else np.zeros(n))
        for name, axis in config.axis.items()
    }
    if (beyond := find_first_out_of_range(position_mm, config)) is not None:  # an arc may, between ends in range
        raise ProgramError(int(rows[beyond.row, -2]), beyond.axis, beyond.text)
    return Trajectory(
        dt_s=dt_s,
        time_s=freeze_array((first_row + np.arange(n)) * dt_s),
        position_mm=position_mm,
        rapid=rapid,
        line=freeze_integers(rows[:, -2]),
        mm_per_degree=config.mm_per_degree,
    )
