"""Plans a correction from a reference: method, limits, gate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.correction import correction_gate
from fdhil.correction.correction_method import CorrectionMethod, MethodPlan
from fdhil.correction.plan_limits import fit_all_axes
from fdhil.prediction import predict_corrected_path, predict_path
from fdhil.records import Correction, Float, Parameters, Prediction, Reason, Trajectory, freeze_array

MASK_PASSES = 3


def plan_correction(
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    method: str | None = None,
    held_out_um: float | None = None,
) -> Correction:
    """Plan the correction of ``reference``; refusals are values, with all offsets 0 and ``after`` = ``before``.

    ``held_out_um`` is the models' largest error in moves that they were not identified on, if known. ConfigError if an
    axis has no model; KeyError for an unknown method.
    """
    name = method or tables.DEFAULT_CORRECTION
    factory: CorrectionMethod = tables.load_entry(tables.CORRECTIONS, name)
    before = predict_path(reference, models, config)
    warnings: tuple[Reason, ...] = ()
    refused = correction_gate.check_writing_enabled(reference.axes, config) or correction_gate.check_held_out_error(
        held_out_um
    )
    if not refused:
        refused, warnings = correction_gate.check_drive_demand(reference, models, config, before)
    if not refused:
        wanted = factory(reference, models, config, before)
        refused = wanted.refused
    if not refused:
        offset, after, masked = _mask_worse_zones(reference, models, config, before, wanted)
        refused = correction_gate.check_result(before, after, wanted.untouched)
    if refused:
        zero = dict.fromkeys(reference.axes, freeze_array(np.zeros(before.contour_um.size)))
        also = zero if name == "flatness" else {}
        return Correction(name, before, before, zero, refused, warnings, 0.0, also, also)
    return Correction(
        name,
        before,
        after,
        _freeze_offsets(offset),
        warnings=warnings + masked,
        delay_s=wanted.delay_s,
        speed_offset_rad_s=_freeze_offsets(wanted.speed_offset_rad_s),
        torque_offset_nm=_freeze_offsets(wanted.torque_offset_nm),
    )


def _freeze_offsets(offsets: Mapping[str, Float]) -> dict[str, Float]:
    return {axis: freeze_array(values) for axis, values in offsets.items()}


def _mask_worse_zones(
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    before: Prediction,
    wanted: MethodPlan,
) -> tuple[Mapping[str, Float], Prediction, tuple[Reason, ...]]:
    """Leave zones uncorrected that would get worse; return the offsets, their residual, and a warning.

    An offset that must stay unchanged is not masked: the warning says where it harms. An on-line feed-forward has no
    offsets to mask.
    """
    offset, speed, torque = wanted.offset_um, wanted.speed_offset_rad_s, wanted.torque_offset_nm
    after = predict_corrected_path(reference, models, config, offset, speed, torque)
    if torque:
        return offset, after, ()
    worse = np.zeros(before.contour_um.size, dtype=np.bool_)
    for _ in range(MASK_PASSES):
        now = correction_gate.find_worse_rows(before.contour_um, after.contour_um, reference.dt_s)
        worse |= now
        if wanted.untouched or not now.any():
            break
        factor = correction_gate.make_mask_factor(worse, reference.dt_s)
        offset = fit_all_axes(
            {axis: values * factor for axis, values in wanted.offset_um.items()}, config.axis, reference.dt_s
        )
        after = predict_corrected_path(reference, models, config, offset)
    if not worse.any():
        return offset, after, ()
    first, last = reference.time_s[np.flatnonzero(worse)[[0, -1]]]
    text = f"{worse.sum() * reference.dt_s:.2f} s between {first:.2f} s and {last:.2f} s would get worse"
    if not wanted.untouched:
        text += " and are left uncorrected"
    return offset, after, (Reason("HarmPredicted", text, correction_gate.advise_against_harm(models)),)
