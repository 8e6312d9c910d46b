"""Streams the inverse correction while the path is still generated: blocks of 2 s with 0.5 s of look-ahead.

A block is available as soon as its look-ahead is, so nothing waits for the end of the program ([DES], conclusion: "an
on-line technique is to be studied"). Each block passes limits and gate alone; the state between blocks is one state per
axis and half a second of path. The axes take turns in one thread: next to a running machine the other core is the
guard's, and two threads that share a core's caches take half as much processor time again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fdhil.config import MachineConfig
from fdhil.correction import correction_gate
from fdhil.correction.block_solver import AxisLoop, BlockSolution
from fdhil.correction.inverse import AxisInversePlanner, compute_common_delay_s, count_block_rows, delay_path
from fdhil.correction.mirror import build_lag_reason
from fdhil.correction.plan_limits import check_offsets
from fdhil.model import Commands, Response, State, create_standstill_state
from fdhil.prediction import WINDOW_S, compute_contour_error_um
from fdhil.records import Float, Parameters, Reason, compute_table_path

LIMITED_S = 0.02  # longer limiting within a block is not settling


@dataclass(frozen=True, slots=True)
class StreamBlock:
    """The settled rows from ``first_row`` on: offsets per axis in um, contour error (n,) without and with them.

    ``refused`` is not empty if the gate rejects the block: its offsets are 0 then, and the stream ends there unless it
    is told to continue. ``at`` holds the row of each refusal in the whole, which may be a row of the look-ahead.
    """

    first_row: int
    offset_um: Mapping[str, Float]
    before_um: Float
    after_um: Float
    final: bool
    refused: tuple[Reason, ...] = ()
    at: tuple[int, ...] = ()


class _BlockRefusal(NamedTuple):
    row: int
    reason: Reason


@dataclass(slots=True)
class _AxisStream:
    """One axis between two blocks; ``free`` is the state without any offset."""

    name: str
    inverse: AxisInversePlanner
    free: State


@dataclass(frozen=True, slots=True)
class _AxisBlock:
    """One block of one axis: offsets (um), positions without and with them, and refusals."""

    offset_um: Float
    before_mm: Float
    after_mm: Float
    refused: tuple[_BlockRefusal, ...]


def stream_blocks(
    pieces: Iterable[Mapping[str, Float]],
    models: Mapping[str, Parameters],
    config: MachineConfig,
    *,
    goes_on: bool = False,
) -> Iterator[StreamBlock]:
    """Correct a reference that arrives in pieces (mm per axis, (m,), in order, of any length); yield blocks of it.

    ``goes_on``: continue after a refused block, to report them all. ValueError if an axis may not be written. The
    result is that of the whole reference planned at once.
    """
    period = config.machine.sync_period_s
    block, ahead = count_block_rows(period)
    window = round(WINDOW_S / period)
    path: dict[str, Float] = {}
    axes: dict[str, _AxisStream] = {}
    delay = 0.0
    kept = row = 0  # rows of ``path`` before the block, and the first row of the block
    source = iter(pieces)
    ended = False
    while not ended:
        piece = next(source, None)
        if piece is not None:
            path = {axis: np.concatenate([path.get(axis, np.empty(0)), values]) for axis, values in piece.items()}
        elif not path:
            return
        if not axes:
            axes = {
                name: _AxisStream(
                    name,
                    AxisInversePlanner.prepare(models[name], config, name, v[0]),
                    create_standstill_state(models[name], config.axis[name], v[0]),
                )
                for name, v in path.items()
            }
            # before any speed is known: as if every axis may run its rapid speed
            delay, _ = compute_common_delay_s(
                {name: config.axis[name].rapid_speed_mm_s for name in path}, models, config
            )
        length = next(iter(path.values())).size - kept
        # one row beyond the look-ahead shows that the path continues
        while (length > block + ahead or piece is None) and not ended:
            ended = length <= block + ahead
            rows = length if ended else block
            until = kept + min(length, block + ahead)
            result = {
                name: _solve_axis_block(axis, path[name][:until], kept, rows, delay / period, ended)
                for name, axis in axes.items()
            }
            gated = _gate_block(result, path, kept, rows, row, ended, config, window)
            yield gated
            if gated.refused and not goes_on:
                return
            drop = max(0, kept + rows - window)
            path = {axis: values[drop:] for axis, values in path.items()}
            kept, row, length = kept + rows - drop, row + rows, length - rows


def _solve_axis_block(
    axis: _AxisStream, path: Float, kept: int, rows: int, delay_rows: float, ends: bool
) -> _AxisBlock:
    """Solve one block of one axis and advance to the next one."""
    reference = np.ascontiguousarray(path[kept:])
    target = np.ascontiguousarray(delay_path(path, delay_rows)[kept:])
    loop = axis.inverse.loop
    free = loop.drive.run(Commands(reference), axis.free, 0, rows)
    axis.free = free.end
    solution = axis.inverse.solve_next_block(reference, target, rows, ends)
    refused = _check_axis_block(axis.name, loop, solution, free, rows)
    offset = solution.offset[:rows] * loop.limits.um_per_increment
    return _AxisBlock(offset, free.table_mm, solution.position_mm[:rows], refused)


def _check_axis_block(
    name: str, loop: AxisLoop, solution: BlockSolution, free: Response, rows: int
) -> tuple[_BlockRefusal, ...]:
    """Return one axis' refusals of a block: lag, a drive at its limit, an offset that violates a limit."""
    um = loop.limits.um_per_increment
    refused = []
    if free.limited_s > LIMITED_S:
        text = f"axis {name} is at its current or voltage limit for {free.limited_s * 1e3:.0f} ms: no offset can help"
        reason = Reason("DemandTooHigh", text, "lower the feed, or increase the smoothing")
        refused.append(_BlockRefusal(int(np.argmax(free.limited > 0.0)), reason))
    elif solution.needed_um > loop.limits.offset * um:
        reason = build_lag_reason(name, solution.needed_um, loop.limits.offset * um, loop.parameters, loop.axis)
        refused.append(_BlockRefusal(solution.needed_at, reason))
    before = float(solution.offset[1]), float(solution.offset[0])
    broken = check_offsets(solution.offset[2:rows].astype(np.int64), loop.limits, before)
    refused += [_BlockRefusal(0, Reason(one.code, f"axis {name}: {one.text}", one.advice)) for one in broken]
    return tuple(refused)


def _gate_block(
    result: Mapping[str, _AxisBlock],
    path: Mapping[str, Float],
    kept: int,
    rows: int,
    row: int,
    ended: bool,
    config: MachineConfig,
    window: int,
) -> StreamBlock:
    low, high = max(0, kept - window), kept + rows + window
    around = compute_table_path((*path,), np.column_stack([values[low:high] for values in path.values()]))
    errors = []
    for which in ("before_mm", "after_mm"):
        actual = compute_table_path((*result,), np.column_stack([getattr(p, which) for p in result.values()]))
        errors.append(compute_contour_error_um(around, actual, config.machine.sync_period_s, kept - low))
    refused = [refusal for piece in result.values() for refusal in piece.refused]
    before_um, after_um = errors
    worse = np.flatnonzero(correction_gate.find_worse_rows(before_um, after_um, config.machine.sync_period_s))
    if worse.size and not refused:  # after a refusal the contour error adds nothing
        at = int(worse[np.argmax(after_um[worse])])
        text = f"the contour error would grow to {after_um[at]:.1f} um; without offsets it is {before_um.max():.1f} um"
        refused.append(_BlockRefusal(at, Reason("HarmPredicted", text, "lower the feed, or identify again")))
    offsets = {axis: np.zeros(rows) if refused else piece.offset_um for axis, piece in result.items()}
    reasons, places = tuple(refusal.reason for refusal in refused), tuple(row + refusal.row for refusal in refused)
    return StreamBlock(row, offsets, before_um, after_um, ended, reasons, places)
