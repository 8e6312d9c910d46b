"""The contract of every listed correction method."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil import tables
from fdhil.correction import PlanLimits, check, plan
from fdhil.correction.method import Plan
from fdhil.prediction import predict
from fdhil.prediction.models import nominal_models
from fdhil.records import Correction
from tests.bench import bench_config, bench_document
from tests.paths import build_bench_trajectory, build_trajectory, compute_rms

CONFIG = bench_config()
MODELS = nominal_models(CONFIG)
REFERENCE = build_bench_trajectory(10)


@pytest.fixture(scope="module", params=list(tables.CORRECTIONS))
def planned_correction(request: pytest.FixtureRequest) -> tuple[str, Correction]:
    return request.param, plan(REFERENCE, MODELS, CONFIG, request.param)


def test_the_path_is_better_with_it(planned_correction: tuple[str, Correction]) -> None:
    name, correction = planned_correction
    assert correction.method == name
    assert correction.refused == ()
    assert compute_rms(correction.after.contour_um) < 0.2 * compute_rms(correction.before.contour_um)


def test_every_axis_gets_an_offset_per_row_that_the_guard_lets_pass(planned_correction: tuple[str, Correction]) -> None:
    _, correction = planned_correction
    assert list(correction.offset_um) == list(REFERENCE.position_mm)
    for axis, offset in correction.offset_um.items():
        limits = PlanLimits.compute_effective(CONFIG.axis[axis], CONFIG.machine.sync_period_s)
        increments = offset / limits.um_per_increment
        assert offset.shape == REFERENCE.position_mm[axis].shape
        assert np.allclose(increments, np.rint(increments), atol=1e-6)
        assert check(np.rint(increments).astype(np.int64), limits) == []
        assert not offset.flags.writeable


def test_position_offsets_or_an_on_line_feed_forward_never_both(planned_correction: tuple[str, Correction]) -> None:
    _, correction = planned_correction
    sends_positions = any(offset.any() for offset in correction.offset_um.values())
    assert sends_positions != bool(correction.torque_offset_nm)
    assert set(correction.torque_offset_nm) == set(correction.speed_offset_rad_s)


@pytest.mark.parametrize("name", tables.CORRECTIONS)
def test_at_rest_nothing_is_asked_for(name: str) -> None:
    at_rest = build_trajectory(np.zeros((600, 2)))
    before = predict(at_rest, MODELS, CONFIG)
    first, second = (tables.load_entry(tables.CORRECTIONS, name)(at_rest, MODELS, CONFIG, before) for _ in range(2))
    assert isinstance(first, Plan)
    for plan_of in (first, second):
        sent = (plan_of.offset_um, plan_of.speed_offset_rad_s, plan_of.torque_offset_nm)
        assert not any(offset.any() for offsets in sent for offset in offsets.values())


@pytest.mark.parametrize("name", tables.CORRECTIONS)
def test_a_method_keeps_the_limits_by_itself(name: str) -> None:
    wanted = tables.load_entry(tables.CORRECTIONS, name)(REFERENCE, MODELS, CONFIG, predict(REFERENCE, MODELS, CONFIG))
    assert wanted.refused == ()
    for axis, offset in wanted.offset_um.items():
        limits = PlanLimits.compute_effective(CONFIG.axis[axis], CONFIG.machine.sync_period_s)
        increments = offset / limits.um_per_increment
        assert np.allclose(increments, np.rint(increments), atol=1e-6)
        assert check(np.rint(increments).astype(np.int64), limits) == []


@pytest.mark.parametrize("name", tables.CORRECTIONS)
def test_without_its_section_nothing_is_planned(name: str) -> None:
    document = copy.deepcopy(bench_document())
    for axis in document["axis"].values():
        del axis["correction"]
    refused = plan(REFERENCE, MODELS, configuration.parse_config(document), name)
    assert {reason.code for reason in refused.refused} == {"WritingOff"}
    assert not any(offset.any() for offset in refused.offset_um.values())
