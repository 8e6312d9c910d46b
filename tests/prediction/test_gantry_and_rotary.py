"""The path of a machine with a rotary and a gantry axis: its contour error and its correction."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil import correction
from fdhil.config import MachineConfig, parse_config
from fdhil.prediction import compute_contour_std_um, compute_sensitivity_um, predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import interpret, plan
from fdhil.records import Trajectory
from tests.bench import bench_document, rotary_and_gantry_document, rotary_axis


def make_demand(text: str, config: MachineConfig) -> Trajectory:
    return plan(list(interpret(text.split("|"))), config)


def make_rotary_config(radius_mm: float) -> MachineConfig:
    document = bench_document("X")
    document["axis"]["A"] = rotary_axis(radius_mm)
    document["axis"]["A"].pop("correction")
    return parse_config(document)


def test_rotary_contour_error_grows_with_radius() -> None:
    found = {}
    for radius_mm in (50.0, 200.0):
        config = make_rotary_config(radius_mm)
        predicted = predict_path(make_demand("F2000|G1 A40|A0", config), build_nominal_models(config), config)
        found[radius_mm] = predicted.rms_um, predicted.error_um["A"] / config.axis["A"].mm_per_unit
    (near_um, near_mdeg), (far_um, far_mdeg) = found.values()
    assert far_um == pytest.approx(4.0 * near_um, rel=1e-6)
    assert near_mdeg == pytest.approx(far_mdeg, abs=1e-6)


def test_mixed_move_contour_error_combines_x_and_angle() -> None:
    config = make_rotary_config(100.0)
    reference = make_demand("F1200|G1 X20 A20", config)
    predicted = predict_path(reference, build_nominal_models(config), config)
    way = np.array([20.0, np.radians(20.0) * 100.0])
    across = np.array([-way[1], way[0]]) / np.linalg.norm(way)
    expected = np.abs(np.column_stack([predicted.error_um["X"], predicted.error_um["A"]]) @ across)
    inside = slice(400, 1000)
    assert predicted.contour_um[inside] == pytest.approx(expected[inside], abs=0.01)


def test_equal_gantry_drives_are_predicted_as_one() -> None:
    one, two = parse_config(bench_document("XY")), parse_config(rotary_and_gantry_document())
    text = "F6000|G1 X30 Y20|X0"
    single, double = (predict_path(make_demand(text, c), build_nominal_models(c), c) for c in (one, two))
    assert double.contour_um == pytest.approx(single.contour_um, abs=1e-9)
    assert [zone.where for zone in double.zones] == [f"{zone.where} A 0.0" for zone in single.zones]


def test_unequal_gantry_drives_are_averaged() -> None:
    config = parse_config(rotary_and_gantry_document())
    models = build_nominal_models(config)
    models["Y2"] = models["Y2"].replace_values(Jt=0.1, Cd=8.0)
    reference = make_demand("F3000|G1 Y20|Y0", config)
    predicted = predict_path(reference, models, config)
    mean_um = (predicted.error_um["Y"] + predicted.error_um["Y2"]) / 2
    at_turn = int(np.argmax(reference.position_mm["Y"]))
    beyond = (reference.position_mm["Y"] + mean_um * 1e-3) > reference.position_mm["Y"].max()
    assert beyond[at_turn : at_turn + 400].any()  # the table runs over the end of the path there
    over_um = (reference.position_mm["Y"] + mean_um * 1e-3 - reference.position_mm["Y"].max()) * 1e3
    assert predicted.contour_um[beyond] == pytest.approx(over_um[beyond], abs=1e-6)


def test_gantry_uncertainty_is_shared_between_drives() -> None:
    one, two = parse_config(bench_document("XY")), parse_config(rotary_and_gantry_document())
    std, rise = [], []
    for config in (one, two):
        reference, models = make_demand("F6000|G1 Y20|Y0", config), build_nominal_models(config)
        unsure = np.diag([0.0, 0.0, 0.0, 1e-6, 0.0, 0.0])
        covariances = {axis: unsure if axis[0] == "Y" else 0.0 * unsure for axis in reference.axes}
        std.append(compute_contour_std_um(reference, models, covariances, config).max())
        predicted = predict_path(reference, models, config)
        rise.append(compute_sensitivity_um(predicted, models, config)[0])
    assert std[1] == pytest.approx(std[0] / np.sqrt(2), rel=1e-6)  # two independent halves
    assert rise[1]["Y"]["Jt"] == pytest.approx(rise[0]["Y"]["Jt"] / 2, rel=0.05)
    assert rise[1]["Y2"]["Jt"] == pytest.approx(rise[1]["Y"]["Jt"], rel=1e-6)


@pytest.mark.parametrize(("method", "gain"), [("inverse", 20.0), ("mirror", 3.0)])
def test_rotary_and_gantry_correction_helps_within_limits(method: str, gain: float) -> None:
    config = parse_config(rotary_and_gantry_document())
    models = build_nominal_models(config)
    models["Y2"] = models["Y2"].replace_values(Jt=0.09)
    planned = correction.plan_correction(make_demand("F1500|G1 X20 Y10 A20|X0 A0|Y0", config), models, config, method)
    assert planned.refused == ()
    assert planned.after.rms_um < planned.before.rms_um / gain
    for axis, offset_um in planned.offset_um.items():
        limits = config.axis[axis].correction
        assert limits is not None
        assert 0.0 < np.abs(offset_um).max() <= limits.max_offset_um
    assert not np.array_equal(planned.offset_um["Y"], planned.offset_um["Y2"])  # each drive by its own model
