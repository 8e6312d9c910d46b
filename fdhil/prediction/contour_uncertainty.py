"""Propagates the parameters' uncertainty to the predicted path, and computes the path's sensitivity to each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from fdhil.config import MachineConfig
from fdhil.model import run_per_axis, simulate_axis
from fdhil.prediction.contour_error import compute_contour_error_um
from fdhil.prediction.model_variants import get_main_term, list_values
from fdhil.prediction.path_prediction import check_axes
from fdhil.records import Float, Parameters, Prediction, Trajectory, get_unit

STEP = 0.005  # relative change of a parameter for its derivative
# friction may be 0: its step is absolute then; a phase is relative to a radian
SMALLEST = {"N.m.s": 1e-4, "N.m": 1e-2, "rad": 1.0}


def _perturb_parameter(parameters: Parameters, name: str) -> tuple[Parameters, float]:
    """Return the parameters with one parameter or term slightly increased, and the step."""
    value = list_values(parameters)[name]
    step = max(abs(value) * STEP, SMALLEST.get(get_unit(name) or "", 0.0) * STEP)
    return parameters.replace_values(**{name: value + step}), step


def _simulate_perturbed(
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    offset_um: Mapping[str, Float] | None,
) -> dict[str, tuple[Float, Float, Float]]:
    """Return per axis positions (k, n) with each value perturbed in turn, the steps (k,), and unperturbed ones (n,)."""
    check_axes(reference, models, config)

    def simulate_varied_axis(axis: str) -> tuple[Float, Float, Float]:
        offset_mm = None if offset_um is None else offset_um[axis] * 1e-3
        path = reference.position_mm[axis]
        changed, steps = zip(
            *(_perturb_parameter(models[axis], name) for name in list_values(models[axis])), strict=True
        )
        here, *moved = (
            simulate_axis(model, config.axis[axis], reference.dt_s, path, offset_mm).table_mm
            for model in (models[axis], *changed)
        )
        return np.array(moved), np.array(steps), here

    return run_per_axis(simulate_varied_axis, reference.axes)


def compute_contour_std_um(
    reference: Trajectory,
    models: Mapping[str, Parameters],
    covariances: Mapping[str, Float],
    config: MachineConfig,
    offset_um: Mapping[str, Float] | None = None,
) -> Float:
    """Return (n,) one standard deviation of the table's distance from the path, propagated from the parameters'.

    ``covariances`` (k, k) per axis, of the six and the first terms of its model; values that it does not cover, and
    NaN, count as known exactly. First order: the position's derivative by each parameter, of which only the part across
    the path counts; at rest all of it does.
    """
    found = _simulate_perturbed(reference, models, config, offset_um)
    variances = []
    for axis in reference.axes:
        moved, steps, here = found[axis]
        covariance = np.nan_to_num(covariances[axis])
        derivative = ((moved - here) / steps[:, None])[: len(covariance)]
        variances.append(np.einsum("in,ij,jn->n", derivative, covariance, derivative))
    across = _compute_normal_share(reference)
    # axes are identified separately, so that their errors are independent
    variance = sum(v * share for v, share in zip(variances, across, strict=True))
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)) * 1e3)


def _compute_normal_share(reference: Trajectory) -> list[Float]:
    """Return per axis (n,) the share of its variance that is across the path: 1 - t^2 of its direction t."""
    path, columns = reference.path_mm, reference.table_axes
    drives = Counter(axis[0] for axis in reference.axes)  # a gantry axis is at the mean of two
    if path.shape[1] == 1:
        return [np.ones(len(path)) / drives[axis[0]] ** 2 for axis in reference.axes]
    velocity = np.gradient(path, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    moving = speed > 1e-9
    direction = np.where(moving[:, None], velocity / np.maximum(speed, 1e-12)[:, None], 0.0)
    return [(1.0 - direction[:, columns.index(axis[0])] ** 2) / drives[axis[0]] ** 2 for axis in reference.axes]


def compute_sensitivity_um(
    prediction: Prediction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    offset_um: Mapping[str, Float] | None = None,
) -> tuple[Mapping[str, Mapping[str, float]], ...]:
    """Return per zone of ``prediction`` how much its largest contour error rises per 1 % of each parameter, um.

    A mapping axis -> parameter or term -> um, in the order of the zones: it shows what drives a zone's error. Parts of
    a term, such as a phase or a speed, are not listed.
    """
    reference = prediction.reference
    found = _simulate_perturbed(reference, models, config, offset_um)
    path = reference.path_mm
    here = {axis: found[axis][2] for axis in reference.axes}
    base = compute_contour_error_um(path, reference.compute_table_mm(here), reference.dt_s)
    result: list[dict[str, dict[str, float]]] = [{axis: {} for axis in reference.axes} for _ in prediction.zones]
    for axis in reference.axes:
        moved, steps, _ = found[axis]
        for k, (name, value) in enumerate(list_values(models[axis]).items()):
            if get_main_term(name) != name:
                continue
            contour = compute_contour_error_um(
                path, reference.compute_table_mm({**here, axis: moved[k]}), reference.dt_s
            )
            per_percent = 0.01 * abs(value) / steps[k]
            for zone, per_axis in zip(prediction.zones, result, strict=True):
                rows = prediction.get_zone_rows(zone)
                per_axis[axis][name] = float(contour[rows].max() - base[rows].max()) * per_percent
    return tuple(result)
