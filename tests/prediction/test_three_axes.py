"""X, Y and Z end to end: a program, its prediction, and its correction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.correction import plan_correction as plan_correction
from fdhil.prediction import compute_contour_error_um, compute_contour_std_um, compute_sensitivity_um, predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import Budget, interpret
from fdhil.program import plan as plan_program
from fdhil.records import Correction, Trajectory
from tests.bench import bench_config
from tests.paths import compute_rms

CONFIG = bench_config("XYZ")
MODELS = build_nominal_models(CONFIG)
# a ramp into the work, a helix, a corner in space, and the way up
PROGRAM = """
G21 G17 G90 G64 F8000
G1 X30 Y10 Z-5
G1 X60 Y40 Z-5
G2 X60 Y80 I0 J20 Z-25
G1 X20 Y80 Z-10
G1 Z10
M2
""".splitlines()


@pytest.fixture(scope="module")
def three_axis_reference() -> Trajectory:
    return plan_program(interpret(PROGRAM, Budget.create_from_config(CONFIG.nc)), CONFIG)


@pytest.fixture(scope="module")
def three_axis_correction(three_axis_reference: Trajectory) -> Correction:
    return plan_correction(three_axis_reference, MODELS, CONFIG)


def test_all_three_axes_affect_contour(three_axis_reference: Trajectory, three_axis_correction: Correction) -> None:
    assert three_axis_reference.axes == ("X", "Y", "Z")
    before = three_axis_correction.before
    space = np.column_stack([before.predicted_mm[axis] for axis in "XYZ"])
    path = np.column_stack([three_axis_reference.position_mm[axis] for axis in "XYZ"])
    plane = compute_contour_error_um(path[:, :2], space[:, :2], 0.001)
    together = np.sqrt(sum(before.error_um[axis] ** 2 for axis in "XYZ"))
    assert (before.contour_um <= together + 1e-6).all()
    assert before.contour_um.max() > 1.05 * plane.max()
    assert {zone.cause for zone in before.zones} >= {"corner", "circular lag"}
    assert all("Z " in zone.where for zone in before.zones)


def test_correction_improves_all_three_axes(three_axis_correction: Correction) -> None:
    """60 times smaller on the model, within the limits on all three axes, also if only Z drifted."""
    assert three_axis_correction.refused == ()
    assert all(np.abs(three_axis_correction.offset_um[axis]).max() > 5 for axis in "XYZ")
    assert compute_rms(three_axis_correction.before.contour_um) > 60 * compute_rms(
        three_axis_correction.after.contour_um
    )
    reference = three_axis_correction.before.reference
    drifted = MODELS | {"Z": replace(MODELS["Z"], Jt=0.085)}
    again = plan_correction(reference, drifted, CONFIG)
    assert again.before.contour_um.max() > three_axis_correction.before.contour_um.max()
    assert compute_rms(again.before.contour_um) > 60 * compute_rms(again.after.contour_um)


def test_uncertainty_includes_third_axis(three_axis_reference: Trajectory, three_axis_correction: Correction) -> None:
    values = np.array(list(MODELS["Z"].as_dict().values()))
    known = np.zeros((6, 6))
    std = compute_contour_std_um(
        three_axis_reference, MODELS, {"X": known, "Y": known, "Z": np.diag((0.01 * values) ** 2)}, CONFIG
    )
    assert std.max() > 0.3
    reported = compute_sensitivity_um(three_axis_correction.before, MODELS, CONFIG)
    assert max(abs(per_axis["Z"]["Jt"]) for per_axis in reported) > 0.2


def test_prediction_is_invariant_to_axis_order(three_axis_reference: Trajectory) -> None:
    turned = replace(
        three_axis_reference,
        position_mm={a: three_axis_reference.position_mm[b] for a, b in zip("XYZ", "YZX", strict=True)},
    )
    one, other = predict_path(three_axis_reference, MODELS, CONFIG), predict_path(turned, MODELS, CONFIG)
    assert np.array_equal(one.error_um["Y"], other.error_um["X"])
    assert np.allclose(one.contour_um, other.contour_um, atol=1e-9)
