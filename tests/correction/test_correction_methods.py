"""The contract of every listed correction method."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil import tables
from fdhil.correction import PlanLimits, check_offsets, plan_correction
from fdhil.correction.correction_method import MethodPlan
from fdhil.prediction import predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.records import Correction
from tests.bench import bench_config, bench_document
from tests.paths import build_bench_trajectory, build_trajectory, compute_rms

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)
REFERENCE = build_bench_trajectory(10)


@pytest.fixture(scope="module", params=list(tables.CORRECTIONS))
def planned_correction(request: pytest.FixtureRequest) -> tuple[str, Correction]:
    return request.param, plan_correction(REFERENCE, MODELS, CONFIG, request.param)


def test_correction_improves_path(planned_correction: tuple[str, Correction]) -> None:
    name, correction = planned_correction
    assert correction.method == name
    assert correction.refused == ()
    assert compute_rms(correction.after.contour_um) < 0.2 * compute_rms(correction.before.contour_um)


def test_every_axis_gets_offsets_within_guard_limits(planned_correction: tuple[str, Correction]) -> None:
    _, correction = planned_correction
    assert list(correction.offset_um) == list(REFERENCE.position_mm)
    for axis, offset in correction.offset_um.items():
        limits = PlanLimits.derive(CONFIG.axis[axis], CONFIG.machine.sync_period_s)
        increments = offset / limits.um_per_increment
        assert offset.shape == REFERENCE.position_mm[axis].shape
        assert np.allclose(increments, np.rint(increments), atol=1e-6)
        assert check_offsets(np.rint(increments).astype(np.int64), limits) == []
        assert not offset.flags.writeable


def test_method_gives_position_offsets_or_feedforward(planned_correction: tuple[str, Correction]) -> None:
    _, correction = planned_correction
    sends_positions = any(offset.any() for offset in correction.offset_um.values())
    assert sends_positions != bool(correction.torque_offset_nm)
    assert set(correction.torque_offset_nm) == set(correction.speed_offset_rad_s)


@pytest.mark.parametrize("name", tables.CORRECTIONS)
def test_offset_is_zero_at_rest(name: str) -> None:
    at_rest = build_trajectory(np.zeros((600, 2)))
    before = predict_path(at_rest, MODELS, CONFIG)
    first, second = (tables.load_entry(tables.CORRECTIONS, name)(at_rest, MODELS, CONFIG, before) for _ in range(2))
    assert isinstance(first, MethodPlan)
    for plan_of in (first, second):
        sent = (plan_of.offset_um, plan_of.speed_offset_rad_s, plan_of.torque_offset_nm)
        assert not any(offset.any() for offsets in sent for offset in offsets.values())


@pytest.mark.parametrize("name", tables.CORRECTIONS)
def test_method_keeps_limits(name: str) -> None:
    wanted = tables.load_entry(tables.CORRECTIONS, name)(
        REFERENCE, MODELS, CONFIG, predict_path(REFERENCE, MODELS, CONFIG)
    )
    assert wanted.refused == ()
    for axis, offset in wanted.offset_um.items():
        limits = PlanLimits.derive(CONFIG.axis[axis], CONFIG.machine.sync_period_s)
        increments = offset / limits.um_per_increment
        assert np.allclose(increments, np.rint(increments), atol=1e-6)
        assert check_offsets(np.rint(increments).astype(np.int64), limits) == []


@pytest.mark.parametrize("name", tables.CORRECTIONS)
def test_axis_without_correction_section_is_refused(name: str) -> None:
    document = copy.deepcopy(bench_document())
    for axis in document["axis"].values():
        del axis["correction"]
    refused = plan_correction(REFERENCE, MODELS, configuration.parse_config(document), name)
    assert {reason.code for reason in refused.refused} == {"WritingOff"}
    assert not any(offset.any() for offset in refused.offset_um.values())
