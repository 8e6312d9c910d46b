"""Begins a correction from what the drives hold at rest: the first rows are found anew when a program is armed.

A check of a program knows nothing of the current at which an axis will stand when it starts: that is somewhere in the
band of its dry friction, wherever the last move has left it, and up to the first corner it is most of the error that
the check's own rows leave. Once the axes stand at the start it is heard on the bus. The rows that are found from it go
over into the checked ones, and take their place only where the model says that they are better.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fdhil.arming.checked_program import Piece
from fdhil.arming.program_check import reference_blocks
from fdhil.arming.standstill import AtRest
from fdhil.config import Axis, MachineConfig
from fdhil.correction.inverse import AxisInverse, block_rows, common_delay_s
from fdhil.correction.limits import check
from fdhil.model import closed_loop, kernels
from fdhil.model.closed_loop import State
from fdhil.prediction.contour import contour_error_um
from fdhil.records import Float, Parameters, rms

ALONE_S, JOINED_S = 1.2, 1.7  # from where on rows go over into the checked ones, and where they are those
AT_START_INCREMENTS = 1.5


@dataclass(frozen=True, slots=True)
class _Axis:
    """One axis on its first rows: offsets (n,) found anew, in increments, the positions with the checked ones and with
    these, and whether the limits allow them."""

    anew: Float
    checked_mm: Float
    anew_mm: Float
    allowed: bool


def from_rest(
    begin: Piece, program: Path, models: Mapping[str, Parameters], config: MachineConfig, rest: Mapping[str, AtRest]
) -> Piece:
    """Return the first rows of the inverse correction with offsets that begin where the axes stand.

    They stay as they are where an axis does not stand at the program's start, or where nothing is gained.
    """
    path = _first_rows(program, config)
    axes = tuple(begin.offset)
    if not set(axes) <= set(path) or not all(_stands(rest.get(axis), path[axis], config.axis[axis]) for axis in axes):
        return begin
    # rows that lag on purpose lag by what the whole path asks for
    if common_delay_s({axis: config.axis[axis].rapid_speed_mm_s for axis in axes}, models, config)[0] != 0.0:
        return begin
    found = {
        axis: _solved(axis, path[axis], rest[axis], np.array(begin.offset[axis], dtype=np.float64), models, config)
        for axis in axes
    }
    if not all(one.allowed for one in found.values()) or not _better(found, path, config.machine.sync_period_s):
        return begin
    signs = {axis: config.axis[axis].scaling.sign for axis in axes}
    rows = {axis: (signs[axis] * one.anew).astype(np.int64).tolist() for axis, one in found.items()}
    return begin._replace(offset={axis: rows[axis] + begin.offset[axis][len(rows[axis]) :] for axis in axes})


def _first_rows(program: Path, config: MachineConfig) -> dict[str, Float]:
    """Return the path's first block, what is looked at behind it, and a row that tells whether it goes on."""
    block, ahead = block_rows(config.machine.sync_period_s)
    pieces: list[Mapping[str, Float]] = []
    source: Iterator[Mapping[str, Float]] = (part.position_mm for part in reference_blocks(program, config))
    rows = 0
    for piece in source:
        pieces.append(piece)
        rows += next(iter(piece.values())).size
        if rows > block + ahead:
            break
    return {axis: np.concatenate([piece[axis] for piece in pieces])[: block + ahead + 1] for axis in pieces[0]}


def _stands(rest: AtRest | None, path_mm: Float, axis: Axis) -> bool:
    room_mm = AT_START_INCREMENTS / axis.scaling.increments_per_mm
    return rest is not None and abs(rest.demand_mm - path_mm[0]) <= room_mm


def rest_state(rest: AtRest, start_mm: float, parameters: Parameters, axis: Axis) -> State:
    """Return the state of an axis that stands at a program's start, as far off it as it stands off its demand."""
    off_mm = rest.position_mm - rest.demand_mm
    if abs(off_mm) * axis.scaling.increments_per_mm < 1.0:  # the drive itself sees none
        off_mm = 0.0
    state = closed_loop.start(start_mm + off_mm)
    state[[kernels.CURRENT, kernels.SPEED_INTEGRAL, kernels.CURRENT_DEMAND]] = rest.current_a
    state[kernels.CURRENT_INTEGRAL] = parameters.R * rest.current_a
    return state


def _solved(
    name: str, path_mm: Float, rest: AtRest, checked: Float, models: Mapping[str, Parameters], config: MachineConfig
) -> _Axis:
    """Find the offsets of one axis' first rows."""
    period, axis, model = config.machine.sync_period_s, config.axis[name], models[name]
    block, ahead = block_rows(period)
    ends = path_mm.size <= block + ahead
    path_mm = np.ascontiguousarray(path_mm[: block + ahead])
    rows = path_mm.size if ends else block
    walk = AxisInverse.of(model, config, name, float(path_mm[0]))
    loop, state = walk.loop, rest_state(rest, float(path_mm[0]), model, axis)
    walk.carry = replace(walk.carry, state=state)
    solved = walk.block(path_mm, path_mm, rows, ends).offset[:rows]
    checked = axis.scaling.sign * checked
    old = checked[: rows + 2]  # a cycle looks two rows ahead
    anew = old.copy()
    anew[:rows] = solved if ends else np.rint(old[:rows] + (solved - old[:rows]) * _share(rows, period))
    allowed = not check(anew[2:].astype(np.int64), loop.limits, (float(anew[1]), float(anew[0])))
    path_mm = path_mm[: old.size]
    old_mm, anew_mm = (loop.run(path_mm, offset, state, 0, rows).position_mm for offset in (old, anew))
    return _Axis(anew[:rows], old_mm, anew_mm, allowed)


def _share(rows: int, period_s: float) -> Float:
    """Return (rows,) the share of the rows found anew: 1, then smoothly down to 0."""
    gone = np.clip((np.arange(rows) * period_s - ALONE_S) / (JOINED_S - ALONE_S), 0.0, 1.0)
    return np.asarray(1.0 - gone**3 * (10 - 15 * gone + 6 * gone**2))


def _better(found: Mapping[str, _Axis], path: Mapping[str, Float], period_s: float) -> bool:
    """Whether the contour error is smaller with the rows found anew."""
    around = np.column_stack([path[axis] for axis in found])
    checked_um, anew_um = (
        rms(contour_error_um(around, np.column_stack(positions), period_s, 0))
        for positions in ([one.checked_mm for one in found.values()], [one.anew_mm for one in found.values()])
    )
    return anew_um < checked_um
