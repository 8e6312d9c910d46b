"""Recomputes the first rows of a correction from the current that the axes hold at standstill.

The check of a program cannot know the current at which an axis will stand when the program starts: it lies in the band
of dry friction, depending on the last move, and causes most of the residual error up to the first corner. Once the axes
stand at the start, the current is measured on the bus. The recomputed rows blend into the checked ones and replace them
only if the model predicts an improvement. Until then the current that the move to the start will leave is predicted.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fdhil.arming.checked_program import TablePiece
from fdhil.arming.program_check import plan_reference_blocks
from fdhil.arming.standstill_monitor import StandstillState
from fdhil.config import Axis, MachineConfig
from fdhil.correction import AxisInversePlanner, check_offsets, compute_common_delay_s, count_block_rows
from fdhil.model import CURRENT, State, create_standstill_state, run_per_axis
from fdhil.prediction import FrictionBand, compute_contour_error_um, compute_friction_band
from fdhil.records import Float, Parameters, compute_rms, compute_table_path

ALONE_S, JOINED_S = 0.9, 1.4  # begin and end of the blend into the checked rows
AT_START_INCREMENTS = 1.5
CHANGED_SHARE = 0.05  # of the dry friction: smaller changes of the current are ignored


@dataclass(frozen=True, slots=True)
class _AxisSolution:
    """The solution of one axis: its offsets (n,) in increments, and whether the limits allow them.

    ``old_mm`` and ``new_mm`` (n,) are the positions predicted with the offsets in force and with these.
    """

    offset: Float
    old_mm: Float
    new_mm: Float
    allowed: bool


class FirstBlock:
    """The first rows of an inverse correction that are in force, and what is needed to recompute them."""

    def __init__(
        self,
        begin: TablePiece,
        program: Path,
        models: Mapping[str, Parameters],
        config: MachineConfig,
        sha256: str | None = None,
    ) -> None:
        """Prepare for a checked program that begins with ``begin``.

        Raises ProgramError if it can no longer be read, or does not have the digest ``sha256``.
        """
        self.begin = self._checked = begin
        self._models, self._config, self._period_s = models, config, config.machine.sync_period_s
        self._path = _read_first_rows(program, config, sha256)
        rapid = {axis: config.axis[axis].rapid_speed_mm_s for axis in begin.offset}
        # the lag of rows that lag on purpose depends on the whole path
        self._fits = set(begin.offset) <= set(self._path) and compute_common_delay_s(rapid, models, config)[0] == 0.0
        self._walks = {}
        if self._fits:
            starts = {axis: float(self._path[axis][0]) for axis in begin.offset}
            self._walks = {
                axis: AxisInversePlanner.prepare(models[axis], config, axis, start) for axis, start in starts.items()
            }
        self._used_a = {axis: float(walk.carry.state[CURRENT]) for axis, walk in self._walks.items()}
        self._own: dict[str, Float] = {}

    def recompute(self, rest: Mapping[str, StandstillState]) -> TablePiece | None:
        """Return rows that begin where the axes stand; None if the rows in force are to stay.

        They stay if an axis does not stand at the program's start, if no current has changed, or if nothing is gained.
        """
        axes = tuple(self.begin.offset)
        if not self._fits or not all(self._is_at_start(axis, rest.get(axis)) for axis in axes):
            return None
        if not any(self._has_changed(axis, rest[axis]) for axis in axes):
            return None
        self._used_a = {axis: rest[axis].current_a for axis in axes}
        found = run_per_axis(lambda axis: self._solve_axis(axis, rest[axis]), axes)
        if not all(one.allowed for one in found.values()) or not self._is_improvement(found):
            return None
        signs = {axis: self._config.axis[axis].scaling.sign for axis in axes}
        offset = {axis: (signs[axis] * one.offset).astype(np.int64).tolist() for axis, one in found.items()}
        rows = len(next(iter(offset.values())))
        return TablePiece(
            0, {axis: values[:rows] for axis, values in self.begin.demand.items()}, offset, self.begin.final
        )

    def apply_rows(self, rows: TablePiece) -> None:
        """Note that these rows are in force."""
        behind = {axis: values[len(rows.offset[axis]) :] for axis, values in self.begin.offset.items()}
        self.begin = self.begin._replace(offset={axis: rows.offset[axis] + behind[axis] for axis in rows.offset})

    def predict_rows(self, rest: Mapping[str, StandstillState]) -> TablePiece | None:
        """Return rows for a machine that will move to the start from where its axes ``rest``, like :meth:`renew`.

        An axis that has to move will stop with its regulators' integral at the edge of the dry friction's band, on the
        side of its last motion.
        """
        return self.recompute(
            {axis: self._predict_standstill(axis, there) for axis, there in rest.items() if axis in self._walks}
        )

    def _predict_standstill(self, axis: str, rest: StandstillState) -> StandstillState:
        if self._is_at_start(axis, rest):
            return rest
        start_mm = float(self._path[axis][0])
        held, model = self._compute_friction_band(axis, start_mm), self._models[axis]
        torque_nm = held.high if start_mm > rest.demand_mm else held.low
        return StandstillState(start_mm, start_mm, torque_nm / model.K)

    def _compute_friction_band(self, axis: str, position_mm: float) -> FrictionBand:
        return compute_friction_band(
            self._models[axis], position_mm * 2 * np.pi / self._config.axis[axis].screw_pitch_mm
        )

    def _is_at_start(self, axis: str, rest: StandstillState | None) -> bool:
        room_mm = AT_START_INCREMENTS / self._config.axis[axis].scaling.increments_per_mm
        return rest is not None and abs(rest.demand_mm - self._path[axis][0]) <= room_mm

    def _has_changed(self, axis: str, rest: StandstillState) -> bool:
        held, change_a = self._compute_friction_band(axis, rest.position_mm), rest.current_a - self._used_a[axis]
        return abs(change_a) * self._models[axis].K > CHANGED_SHARE * 0.5 * (held.high - held.low)

    def _solve_axis(self, name: str, rest: StandstillState) -> _AxisSolution:
        """Compute the offsets of one axis' first rows: the checked ones plus the change for another initial state."""
        walk, axis, path_mm = self._walks[name], self._config.axis[name], self._path[name]
        loop, state = walk.loop, make_initial_state(rest, float(path_mm[0]), self._models[name], axis)
        if name not in self._own:
            self._own[name] = self._compute_offsets(name, walk.carry.state)
        own, ends = self._own[name], path_mm.size <= sum(count_block_rows(self._period_s))
        rows = own.size if ends else round(JOINED_S / self._period_s)
        share = 1.0 if ends else _compute_blend(rows, self._period_s)
        more = np.rint((self._compute_offsets(name, state)[:rows] - own[:rows]) * share)
        checked, begin = (
            axis.scaling.sign * np.array(piece.offset[name][: rows + 2], dtype=np.float64)  # a cycle looks two ahead
            for piece in (self._checked, self.begin)
        )
        new = checked.copy()
        new[:rows] += more
        allowed = not check_offsets(new[2:].astype(np.int64), loop.limits, (float(new[1]), float(new[0])))
        own = own[: new.size]
        old_mm, new_mm = (
            loop.simulate_rows(path_mm[: new.size], own + offset - checked, state, 0, rows).table_mm
            for offset in (begin, new)
        )
        return _AxisSolution(new[:rows], old_mm, new_mm, allowed)

    def _compute_offsets(self, name: str, state: State) -> Float:
        walk, path_mm = self._walks[name], self._path[name]
        block, ahead = count_block_rows(self._period_s)
        ends = path_mm.size <= block + ahead
        path_mm = np.ascontiguousarray(path_mm[: block + ahead])
        rows = path_mm.size if ends else block
        return (
            AxisInversePlanner(walk.loop, replace(walk.carry, state=state))
            .solve_next_block(path_mm, path_mm, rows, ends)
            .offset[:rows]
        )

    def _is_improvement(self, found: Mapping[str, _AxisSolution]) -> bool:
        around = compute_table_path((*found,), np.column_stack([self._path[axis] for axis in found]))
        old_um, new_um = (
            compute_rms(
                compute_contour_error_um(
                    around, compute_table_path((*found,), np.column_stack(positions)), self._period_s, 0
                )
            )
            for positions in ([one.old_mm for one in found.values()], [one.new_mm for one in found.values()])
        )
        return new_um < old_um


def _read_first_rows(program: Path, config: MachineConfig, sha256: str | None) -> dict[str, Float]:
    block, ahead = count_block_rows(config.machine.sync_period_s)
    pieces: list[Mapping[str, Float]] = []
    rows = 0
    for part in plan_reference_blocks(program, config, sha256):
        pieces.append(part.position_mm)
        rows += part.time_s.size
        if rows > block + ahead:
            break
    return {axis: np.concatenate([piece[axis] for piece in pieces])[: block + ahead + 1] for axis in pieces[0]}


def make_initial_state(rest: StandstillState, start_mm: float, parameters: Parameters, axis: Axis) -> State:
    """Return the state of an axis at a program's start, with the following error that it has at standstill."""
    off_mm = rest.position_mm - rest.demand_mm
    if abs(off_mm) * axis.scaling.increments_per_mm < 1.0:  # the drive itself sees none
        off_mm = 0.0
    return create_standstill_state(parameters, axis, start_mm + off_mm, rest.current_a, start_mm)


def _compute_blend(rows: int, period_s: float) -> Float:
    """Return (rows,) the share of the recomputed rows: 1, then smoothly down to 0."""
    gone = np.clip((np.arange(rows) * period_s - ALONE_S) / (JOINED_S - ALONE_S), 0.0, 1.0)
    return np.asarray(1.0 - gone**3 * (10 - 15 * gone + 6 * gone**2))
