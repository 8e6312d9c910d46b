"""Adds learned offsets to a checked program (iterative learning control), and learns from the pass that follows.

Off unless ``[correction] learning`` is set. Learns only whole programs, and only from passes in which the NC ordered
every row as planned and on time; a pass with an override or a feed hold, or one that ended early, is not used.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fdhil.arming.arm_plan import ArmRequest
from fdhil.arming.checked_program import CheckedProgram
from fdhil.arming.program_check import encode_rows
from fdhil.arming.whole_plan import store_in_memory
from fdhil.config import MachineConfig
from fdhil.correction import LearnedOffset, compute_common_delay_s, delay_path, fit_all_axes, learn_from_pass
from fdhil.prediction import compute_contour_error_um, compute_table_deflection_mm
from fdhil.records import Float, Parameters, Reason, compute_rms, compute_table_path
from fdhil.store import make_learned_path, read_learned, write_learned

MOST_ROWS = 1_000_000
TOLERANCE_INCREMENTS = 2.5


@dataclass(frozen=True, slots=True)
class IterativeLearner:
    """A program that learns: its planned demand (n,) per axis in mm, its learned offsets, and its models."""

    path: Path
    demand_mm: Mapping[str, Float]
    models: Mapping[str, Parameters]
    config: MachineConfig
    learned: LearnedOffset

    def learn_from_pass(self, demand_mm: Float, position_mm: Float) -> LearnedOffset | None:
        """Learn from the rows (n, axes) of a whole pass; None if it was not as planned. StoreError if not stored."""
        planned = np.column_stack(list(self.demand_mm.values()))
        axes = [self.config.axis[axis] for axis in self.demand_mm]
        tolerance_mm = np.array([TOLERANCE_INCREMENTS / axis.scaling.increments_per_mm for axis in axes])
        if demand_mm.shape != planned.shape or np.any(np.abs(demand_mm - planned) > tolerance_mm):
            return None
        period_s = self.config.machine.sync_period_s
        fastest = {axis: float(np.abs(np.diff(path)).max()) / period_s for axis, path in self.demand_mm.items()}
        tau_s, _ = compute_common_delay_s(fastest, self.models, self.config)
        error_um = {
            axis: (delay_path(path, tau_s / period_s) - position_mm[:, k]) * 1e3
            for k, (axis, path) in enumerate(self.demand_mm.items())
        }
        path, table = (compute_table_path((*self.demand_mm,), rows) for rows in (planned, position_mm))
        left_um = compute_rms(compute_contour_error_um(path, table, period_s))
        learned = learn_from_pass(self.learned, error_um, left_um, self.models, self.config)
        write_learned(self.path, learned)
        return learned


def apply_learned_offsets(
    checked: CheckedProgram, request: ArmRequest, machine: str
) -> tuple[CheckedProgram, IterativeLearner | None]:
    """Return the program with the learned offsets added, within the limits, and the learner of its next pass.

    ``machine`` is the digest of the configuration that the offsets belong to. Raises StoreError if rows cannot be read.
    """
    config = request.config
    if not config.correction.learning or not checked.is_complete or checked.row_count > MOST_ROWS:
        return checked, None
    demand_mm, offset_um = _decode_rows(checked, config)
    path = make_learned_path(config.store.directory / "lessons", request.program_digest, machine)
    learned = read_learned(path)
    if learned is None or any(learned.offset_um.get(axis, np.empty(0)).size != checked.row_count for axis in demand_mm):
        learned = LearnedOffset(dict.fromkeys(demand_mm, np.zeros(checked.row_count)))
    learner = IterativeLearner(path, demand_mm, request.models, config, learned)
    if not any(np.any(offset) for offset in learned.offset_um.values()):
        return checked, learner
    total = {axis: offset + learned.offset_um[axis] for axis, offset in offset_um.items()}
    fitting = fit_all_axes(total, config.axis, config.machine.sync_period_s)
    return _replace_offsets(checked, demand_mm, fitting, learned, config), learner


def compute_axis_deflections_mm(checked: CheckedProgram, request: ArmRequest) -> Float | None:
    """Return table less motor position (n, axes) along a whole program by its models; None without compliance.

    Raises StoreError if the rows cannot be read.
    """
    sprung = any(model.get_term("resonance") for model in request.models.values())
    if not sprung or not checked.is_complete or checked.row_count > MOST_ROWS:
        return None
    demand_mm, offset_um = _decode_rows(checked, request.config)
    ahead = compute_table_deflection_mm(demand_mm, offset_um, request.models, request.config)
    return np.column_stack([ahead.get(axis, np.zeros(checked.row_count)) for axis in checked.axes])


def _decode_rows(checked: CheckedProgram, config: MachineConfig) -> tuple[dict[str, Float], dict[str, Float]]:
    """Return demand in mm and offset in um, (n,) per axis."""
    content = b"".join(checked.read_block(k) for k in range(len(checked.blocks)))
    columns = np.frombuffer(content, "<i4").reshape(checked.row_count, -1).T.astype(np.float64)
    scale = {a: config.axis[a].scaling.sign * config.axis[a].scaling.increments_per_mm for a in checked.axes}
    demand = {axis: columns[k] / scale[axis] for k, axis in enumerate(checked.axes)}
    offset = {axis: columns[len(scale) + k] / scale[axis] * 1e3 for k, axis in enumerate(checked.axes)}
    return demand, offset


def _replace_offsets(
    checked: CheckedProgram,
    demand_mm: Mapping[str, Float],
    offset_um: Mapping[str, Float],
    learned: LearnedOffset,
    config: MachineConfig,
) -> CheckedProgram:
    replaced = store_in_memory(encode_rows(demand_mm, offset_um, config), config, checked.errors)
    text = (
        f"offsets of {len(learned.curve_um)} passes are added; the last residual was {learned.curve_um[-1]:.2f} um RMS"
    )
    replaced.method, replaced.half_um = checked.method, checked.half_um
    replaced.warnings = (*checked.warnings, Reason("Learned", text, "fdhil status shows each pass"))
    largest_um = max(float(np.abs(offset).max(initial=0.0)) for offset in offset_um.values())
    replaced.set_header({**(checked.header or {}), "largest_um": largest_um})
    return replaced
