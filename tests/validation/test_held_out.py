"""A model is validated by moves that it was not identified on, and its presliding is identified from them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.model import closed_loop
from fdhil.records import PARAMETERS, Estimate, Float, Parameters, Result, Window, freeze_array
from fdhil.validation.held_out_moves import (
    TERM,
    check_held_out_limit,
    fit_presliding,
    is_predicted,
    predict_held_out,
    summarise_worst,
)
from fdhil.validation.move_replay import replay_setpoints
from studies.bench import make_shuttle_demand
from tests.bench import bench_config
from tests.validation.test_table_error_budget import AXIS, PERIOD_S, record_rapids

TRUE = Parameters(**AXIS.nominal.model_dump())
SETTINGS = Identification()


@lru_cache(maxsize=4)
def make_moves(presliding_um: float) -> list[Window]:
    demand_mm = 1e3 * make_shuttle_demand(moves=2)
    drive = TRUE.replace_values(**{TERM: presliding_um}) if presliding_um else TRUE
    response = closed_loop.simulate_axis(drive, AXIS, PERIOD_S, demand_mm)
    noise = 0.05e-3 * np.random.default_rng(1).standard_normal(demand_mm.size)
    return [_replace_position(window, response.position_mm + noise, demand_mm) for window in record_rapids()]


def _replace_position(window: Window, position_mm: Float, demand_mm: Float) -> Window:
    first = round(window.start_s / PERIOD_S)
    rows = slice(first, first + window.n)
    return replace(window, position_mm=freeze_array(position_mm[rows]), demand_mm=freeze_array(demand_mm[rows]))


def make_estimate(**changes: float) -> Estimate:
    values = TRUE.replace_values(**changes).as_dict()
    covariance = np.diag([(1e-3 * value) ** 2 for value in values.values()])
    return Estimate(
        "maximum_likelihood", PARAMETERS, freeze_array(list(values.values())), freeze_array(covariance), {}, Result.OK
    )


@pytest.mark.usefixtures("long_computation")
def test_presliding_is_identified_only_if_present() -> None:
    found = fit_presliding(make_estimate(), make_moves(8.0), AXIS, PERIOD_S)
    assert found.get_value(TERM) == pytest.approx(8.0, abs=max(0.4, 3 * found.get_std(TERM)))
    assert fit_presliding(make_estimate(), make_moves(0.0), AXIS, PERIOD_S).names == PARAMETERS


def test_move_is_not_replayed_while_its_axis_still_settles() -> None:
    window = make_moves(0.0)[0]
    decaying_mm = 20e-3 * np.exp(-np.arange(window.n) * PERIOD_S / 0.035)
    settling = replace(window, position_mm=freeze_array(window.position_mm + decaying_mm))
    assert replay_setpoints(window, TRUE, AXIS, PERIOD_S) is not None
    assert replay_setpoints(settling, TRUE, AXIS, PERIOD_S) is None


@pytest.mark.usefixtures("long_computation")
def test_pool_is_refused_if_it_mispredicts_held_out_move() -> None:
    windows = make_moves(0.0)
    right, wrong = ([(window, make_estimate(Jt=jt)) for window in windows] for jt in (TRUE.Jt, 1.3 * TRUE.Jt))
    good, bad = (predict_held_out(made, made[0][1], AXIS, PERIOD_S) for made in (right, wrong))
    assert all(is_predicted(one, SETTINGS) for one in good)
    assert not any(is_predicted(one, SETTINGS) for one in bad)
    kept, left = summarise_worst(good), summarise_worst(bad)
    assert kept is not None
    assert left is not None
    assert check_held_out_limit(kept, SETTINGS) is None
    reason = check_held_out_limit(left, SETTINGS)
    assert reason is not None
    assert "does not predict moves that it was not identified on" in reason.text
    assert left.moves == 2
    assert left.max_um > left.rms_um > kept.rms_um


def test_presliding_friction_lets_table_creep() -> None:
    axis = bench_config().axis["X"]
    demand_mm = np.linspace(0.0, 0.5e-3, 200)
    sharp, soft = (
        closed_loop.simulate_axis(model, axis, PERIOD_S, demand_mm).position_mm[-1]
        for model in (TRUE, TRUE.replace_values(**{TERM: 10.0}))
    )
    assert abs(sharp) < 1e-6
    assert 1e-5 < soft < demand_mm[-1]
