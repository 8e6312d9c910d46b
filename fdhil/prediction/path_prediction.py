"""Predicts a reference trajectory from the identified closed loops ([DES] section 5, figure 9)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault
from fdhil.model import Response, simulate_axes, simulate_axis
from fdhil.prediction.contour_error import compute_contour_error_um
from fdhil.prediction.error_zones import find_zones
from fdhil.prediction.model_variants import remove_dry_friction
from fdhil.records import Float, Parameters, Prediction, Trajectory, freeze_array


def check_axes(reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig) -> None:
    """Raise ConfigError where an axis of the reference has no configuration or no model."""
    faults = [
        ConfigFault(f"axis.{axis}", "the demand moves this axis, but the configuration lacks it", "add its section")
        for axis in reference.axes
        if axis not in config.axis
    ]
    faults += [
        ConfigFault(f"model.{axis}", "there is no model of this axis", "identify it from a recorded rapid move")
        for axis in reference.axes
        if axis not in models
    ]
    if faults:
        raise ConfigError("prediction", faults)


def predict_path(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, zones_above_um: float | None = None
) -> Prediction:
    """Predict the path error along ``reference``; ConfigError if an axis has no model or configuration.

    Zones are errors that stand out, or with ``zones_above_um`` all that exceed it.
    """
    smooth = {axis: remove_dry_friction(model) for axis, model in models.items()}
    responses = _simulate_axes(reference, models, config)
    return _build_prediction(
        reference, responses, config, zones_above_um, lambda: predict_contour_um(reference, smooth, config)
    )


def predict_contour_um(reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig) -> Float:
    """Return the contour error (n,) um alone, as predicted above: for searches over many paths."""
    return _compute_contour_um(reference, _simulate_axes(reference, models, config))


def predict_corrected_path(
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    offset_um: Mapping[str, Float] | None,
    speed_offset_rad_s: Mapping[str, Float] | None = None,
    torque_offset_nm: Mapping[str, Float] | None = None,
) -> Prediction:
    """Predict the path with ``offset_um`` (n,) per axis added to the reference; errors stay relative to the path.

    Speed and torque offsets (n,) per axis are those of an on-line feed-forward.
    """
    offset_mm = {axis: values * 1e-3 for axis, values in (offset_um or {}).items()}
    offsets = (offset_mm, speed_offset_rad_s, torque_offset_nm)
    return _build_prediction(reference, _simulate_axes(reference, models, config, *offsets), config)


def compute_table_deflection_mm(
    position_mm: Mapping[str, Float],
    offset_um: Mapping[str, Float],
    models: Mapping[str, Parameters],
    config: MachineConfig,
) -> dict[str, Float]:
    """Return table less motor (n,) in mm of each axis with a resonance: the part that its encoder does not see.

    The axes follow ``position_mm`` (n,) with ``offset_um`` (n,).
    """
    period_s = config.machine.sync_period_s
    found = {}
    for axis, path_mm in position_mm.items():
        if models[axis].get_term("resonance"):
            offset_mm = offset_um[axis] * 1e-3
            response = simulate_axis(models[axis], config.axis[axis], period_s, path_mm, offset_mm)
            found[axis] = response.table_mm - response.position_mm
    return found


def _simulate_axes(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, *offsets: Mapping[str, Float] | None
) -> Mapping[str, Response]:
    check_axes(reference, models, config)
    responses = simulate_axes(models, config.axis, reference.dt_s, reference.position_mm, *offsets)
    faults = [
        ConfigFault(f"model.{axis}", "is not a valid drive: its simulation overflows", "check its values and terms")
        for axis, response in responses.items()
        if not np.isfinite(response.end).all()
    ]
    if faults:
        raise ConfigError("prediction", faults)
    return responses


def _compute_contour_um(reference: Trajectory, responses: Mapping[str, Response]) -> Float:
    actual = reference.compute_table_mm({axis: response.table_mm for axis, response in responses.items()})
    return compute_contour_error_um(reference.path_mm, actual, reference.dt_s)


def _build_prediction(
    reference: Trajectory,
    responses: Mapping[str, Response],
    config: MachineConfig,
    zones_above_um: float | None = None,
    without_friction: Callable[[], Float] | None = None,
) -> Prediction:
    axes = reference.axes
    contour = freeze_array(_compute_contour_um(reference, responses))
    loop_s = max(1.0 / config.axis[axis].regulators.position_gain_per_s for axis in axes)
    limited = np.max([responses[axis].limited for axis in axes], axis=0)
    return Prediction(
        reference=reference,
        predicted_mm={axis: freeze_array(responses[axis].table_mm) for axis in axes},
        error_um={axis: freeze_array((responses[axis].table_mm - reference.position_mm[axis]) * 1e3) for axis in axes},
        contour_um=contour,
        current_a={axis: freeze_array(responses[axis].current_a) for axis in axes},
        limited_s={axis: responses[axis].limited_s for axis in axes},
        zones=find_zones(reference, contour, limited, loop_s, zones_above_um, without_friction),
    )
