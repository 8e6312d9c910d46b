"""Plans a program at once, if it is short or its method needs all of it; the checked rows stay in memory."""

import hashlib
import os
from collections.abc import Mapping

import numpy as np

from fdhil import correction
from fdhil.arming.arm_plan import ArmRequest, Refusal, compute_largest_um
from fdhil.arming.checked_program import CheckedBlock, CheckedProgram
from fdhil.arming.model_tracker import AxisModelState
from fdhil.arming.program_check import encode_rows
from fdhil.config import MachineConfig
from fdhil.errors import StoreError
from fdhil.prediction import find_moving_axes, find_worst_rms_um, predict_gain
from fdhil.program import load_trajectory
from fdhil.records import Correction, Float, Reason, compute_rms

BLOCK_S = 2.0


def plan_whole_program(request: ArmRequest, known: Mapping[str, AxisModelState]) -> CheckedProgram | Refusal:
    """Return the rows of the planned correction, or why there is none.

    Raises ProgramError, RecordingError or ConfigError if the program cannot be used, StoreError if memory is short.
    """
    config = request.config
    reference = load_trajectory(request.program, config, request.program_digest)
    held_out_um = compute_largest_um(known, find_moving_axes(reference))
    planned = correction.plan_correction(reference, request.models, config, request.method, held_out_um)
    if planned.refused:
        return Refusal(planned.refused)
    if not any(np.any(offset) for offset in planned.offset_um.values()):
        text = f"the method {planned.method} plans no position offset"
        return Refusal((Reason("HarmPredicted", text, "use inverse or mirror; flatness is armed without a program"),))
    errors = {
        "before": _summarise_errors(planned.before.contour_um),
        "after": _summarise_errors(planned.after.contour_um),
    }
    checked = store_in_memory(encode_rows(reference.position_mm, planned.offset_um, config), config, errors)
    _add_plan_figures(checked, planned, request, known)
    return checked


def store_in_memory(rows: bytes, config: MachineConfig, errors: Mapping[str, Mapping[str, float]]) -> CheckedProgram:
    """Return encoded rows as a checked program; ``errors`` without and with their offsets."""
    checked = CheckedProgram(_write_memory_file(rows), tuple(config.axis))
    size = 8 * len(config.axis)
    total, block_rows = len(rows) // size, round(BLOCK_S / config.machine.sync_period_s)
    for first in range(0, total, block_rows):
        end = min(total, first + block_rows)
        checked.add_block(
            CheckedBlock(end, hashlib.sha256(rows[size * first : size * end]).hexdigest(), end == total), errors
        )
    return checked


def _add_plan_figures(
    checked: CheckedProgram,
    planned: Correction,
    request: ArmRequest,
    known: Mapping[str, AxisModelState],
) -> None:
    covariances = {axis: found.published.covariance for axis, found in known.items() if found.published is not None}
    held_out_um = find_worst_rms_um({axis: found.skills for axis, found in known.items()})
    checked.half_um = predict_gain(planned, request.models, request.config, covariances, held_out_um).half_um
    checked.method, checked.warnings = planned.method, planned.warnings + planned.before.reference.notes
    largest_um = max(float(np.abs(offset).max()) for offset in planned.offset_um.values())
    checked.set_header({**checked.errors, "largest_um": largest_um})


def _summarise_errors(contour_um: Float) -> dict[str, float]:
    return {"rms_um": compute_rms(contour_um), "max_um": float(contour_um.max())}


def _write_memory_file(rows: bytes) -> int:
    try:
        descriptor = os.memfd_create("fdhil-rows")
    except OSError as error:
        raise StoreError(f"the planned rows cannot be stored ({error.strerror}); free memory, then arm again") from None
    with os.fdopen(os.dup(descriptor), "wb") as file:
        file.write(rows)
    return descriptor
