"""The path of a machine with a rotary and a gantry axis: its contour error and its correction."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil import correction
from fdhil.config import MachineConfig, parse_config
from fdhil.prediction import contour_std_um, predict, sensitivity_um
from fdhil.prediction.models import nominal_models
from fdhil.program import interpret, plan
from fdhil.records import Trajectory
from tests.bench import bench_document, rotary_and_gantry_document, rotary_axis


def demand(text: str, config: MachineConfig) -> Trajectory:
    return plan(list(interpret(text.split("|"))), config)


def rotary(radius_mm: float) -> MachineConfig:
    document = bench_document("X")
    document["axis"]["A"] = rotary_axis(radius_mm)
    document["axis"]["A"].pop("correction")
    return parse_config(document)


def test_contour_error_of_a_table_that_turns_alone_grows_with_the_radius() -> None:
    found = {}
    for radius_mm in (50.0, 200.0):
        config = rotary(radius_mm)
        predicted = predict(demand("F2000|G1 A40|A0", config), nominal_models(config), config)
        found[radius_mm] = predicted.rms_um, predicted.error_um["A"] / config.axis["A"].mm_per_unit
    (near_um, near_mdeg), (far_um, far_mdeg) = found.values()
    assert far_um == pytest.approx(4.0 * near_um, rel=1e-6)
    assert near_mdeg == pytest.approx(far_mdeg, abs=1e-6)


def test_contour_error_of_a_mixed_move_is_that_of_x_and_of_the_angle_times_the_radius() -> None:
    config = rotary(100.0)
    reference = demand("F1200|G1 X20 A20", config)
    predicted = predict(reference, nominal_models(config), config)
    way = np.array([20.0, np.radians(20.0) * 100.0])
    across = np.array([-way[1], way[0]]) / np.linalg.norm(way)
    expected = np.abs(np.column_stack([predicted.error_um["X"], predicted.error_um["A"]]) @ across)
    inside = slice(400, 1000)
    assert predicted.contour_um[inside] == pytest.approx(expected[inside], abs=0.01)


def test_gantry_axis_with_equal_drives_is_predicted_as_one_drive() -> None:
    one, two = parse_config(bench_document("XY")), parse_config(rotary_and_gantry_document())
    text = "F6000|G1 X30 Y20|X0"
    single, double = (predict(demand(text, c), nominal_models(c), c) for c in (one, two))
    assert double.contour_um == pytest.approx(single.contour_um, abs=1e-9)
    assert [zone.where for zone in double.zones] == [f"{zone.where} A 0.0" for zone in single.zones]


def test_gantry_axis_with_unequal_drives_is_at_their_mean() -> None:
    config = parse_config(rotary_and_gantry_document())
    models = nominal_models(config)
    models["Y2"] = models["Y2"].replace_values(Jt=0.1, Cd=8.0)
    reference = demand("F3000|G1 Y20|Y0", config)
    predicted = predict(reference, models, config)
    mean_um = (predicted.error_um["Y"] + predicted.error_um["Y2"]) / 2
    at_turn = int(np.argmax(reference.position_mm["Y"]))
    beyond = (reference.position_mm["Y"] + mean_um * 1e-3) > reference.position_mm["Y"].max()
    assert beyond[at_turn : at_turn + 400].any()  # the table runs over the end of the path there
    over_um = (reference.position_mm["Y"] + mean_um * 1e-3 - reference.position_mm["Y"].max()) * 1e3
    assert predicted.contour_um[beyond] == pytest.approx(over_um[beyond], abs=1e-6)


def test_deviation_and_sensitivity_share_a_gantry_axis_between_its_drives() -> None:
    one, two = parse_config(bench_document("XY")), parse_config(rotary_and_gantry_document())
    std, rise = [], []
    for config in (one, two):
        reference, models = demand("F6000|G1 Y20|Y0", config), nominal_models(config)
        unsure = np.diag([0.0, 0.0, 0.0, 1e-6, 0.0, 0.0])
        covariances = {axis: unsure if axis[0] == "Y" else 0.0 * unsure for axis in reference.axes}
        std.append(contour_std_um(reference, models, covariances, config).max())
        predicted = predict(reference, models, config)
        rise.append(sensitivity_um(predicted, models, config)[0])
    assert std[1] == pytest.approx(std[0] / np.sqrt(2), rel=1e-6)  # two independent halves
    assert rise[1]["Y"]["Jt"] == pytest.approx(rise[0]["Y"]["Jt"] / 2, rel=0.05)
    assert rise[1]["Y2"]["Jt"] == pytest.approx(rise[1]["Y"]["Jt"], rel=1e-6)


@pytest.mark.parametrize(("method", "gain"), [("inverse", 20.0), ("mirror", 3.0)])
def test_correction_of_a_rotary_and_a_gantry_axis_helps_and_keeps_its_limits(method: str, gain: float) -> None:
    config = parse_config(rotary_and_gantry_document())
    models = nominal_models(config)
    models["Y2"] = models["Y2"].replace_values(Jt=0.09)
    planned = correction.plan(demand("F1500|G1 X20 Y10 A20|X0 A0|Y0", config), models, config, method)
    assert planned.refused == ()
    assert planned.after.rms_um < planned.before.rms_um / gain
    for axis, offset_um in planned.offset_um.items():
        limits = config.axis[axis].correction
        assert limits is not None
        assert 0.0 < np.abs(offset_um).max() <= limits.max_offset_um
    assert not np.array_equal(planned.offset_um["Y"], planned.offset_um["Y2"])  # each drive by its own model
