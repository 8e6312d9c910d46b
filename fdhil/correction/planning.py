"""From a reference to a correction: method, limits, gate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.correction import gate
from fdhil.correction.limits import fit_all
from fdhil.correction.method import Plan
from fdhil.prediction.predict import predict, predict_corrected
from fdhil.records import (
    Correction,
    Float,
    Parameters,
    Prediction,
    Reason,
    Trajectory,
    frozen,
)

MASK_PASSES = 3


def default_method() -> str:
    """The best method there is: the last of the table."""
    return list(tables.CORRECTIONS)[-1]


def plan(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, method: str | None = None
) -> Correction:
    """Plan the correction of ``reference``; refusals are values, with all offsets 0 and ``after`` = ``before``.

    ConfigError when an axis has no model; KeyError for an unknown method.
    """
    name = method or default_method()
    factory = tables.load(tables.CORRECTIONS, name)
    before = predict(reference, models, config)
    refused = gate.writing_off(reference.axes, config)
    if refused:
        return _refuse(name, before, refused, ())
    refused, warnings = gate.demand(reference, models, config, before)
    if refused:
        return _refuse(name, before, refused, warnings)
    wanted: Plan = factory(reference, models, config, before)
    if wanted.refused:
        return _refuse(name, before, wanted.refused, warnings)
    if wanted.torque_offset_nm:
        speed, torque = wanted.speed_offset_rad_s, wanted.torque_offset_nm
        after = predict_corrected(reference, models, config, None, speed, torque)
        offset, masked = wanted.offset_um, tuple[Reason, ...]()
    else:
        offset, after, masked = _mask_harm(reference, models, config, before, wanted)
    refused = gate.result(before, after, wanted.untouched)
    if refused:
        return _refuse(name, before, refused, warnings)
    return Correction(
        method=name,
        before=before,
        after=after,
        offset_um={axis: frozen(values) for axis, values in offset.items()},
        warnings=warnings + masked,
        delay_s=wanted.delay_s,
        speed_offset_rad_s={axis: frozen(values) for axis, values in wanted.speed_offset_rad_s.items()},
        torque_offset_nm={axis: frozen(values) for axis, values in wanted.torque_offset_nm.items()},
    )


def _mask_harm(
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    before: Prediction,
    wanted: Plan,
) -> tuple[Mapping[str, Float], Prediction, tuple[Reason, ...]]:
    """Leave alone the zones that would get worse; return the offsets, what they leave, and a warning.

    What a method wants untouched stays as it is, and the warning says where it harms.
    """
    offset = wanted.offset_um
    after = predict_corrected(reference, models, config, offset)
    worse = np.zeros(before.contour_um.size, dtype=np.bool_)
    if wanted.untouched:
        worse = gate.worse_rows(before.contour_um, after.contour_um, reference.dt_s)
    for _ in range(0 if wanted.untouched else MASK_PASSES):
        now = gate.worse_rows(before.contour_um, after.contour_um, reference.dt_s)
        if not now.any():
            break
        worse |= now
        factor = gate.fade(worse, reference.dt_s)
        offset = fit_all(
            {axis: values * factor for axis, values in wanted.offset_um.items()}, config.axis, reference.dt_s
        )
        after = predict_corrected(reference, models, config, offset)
    if not worse.any():
        return offset, after, ()
    first, last = reference.time_s[np.flatnonzero(worse)[[0, -1]]]
    text = f"{worse.sum() * reference.dt_s:.2f} s between {first:.2f} s and {last:.2f} s would get worse"
    if not wanted.untouched:
        text += " and are left as they are"
    return offset, after, (Reason("HarmPredicted", text, "try the method inverse, or lower the feed there"),)


def _refuse(method: str, before: Prediction, refused: tuple[Reason, ...], warnings: tuple[Reason, ...]) -> Correction:
    zero = dict.fromkeys(before.reference.axes, frozen(np.zeros(before.contour_um.size)))
    also = zero if method == "flatness" else {}
    return Correction(method, before, before, zero, refused, warnings, speed_offset_rad_s=also, torque_offset_nm=also)
