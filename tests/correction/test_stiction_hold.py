"""Offsets of a resting axis: the current settles, whatever the length of the rest."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.correction.stiction_hold import StictionHold
from fdhil.model import closed_loop
from fdhil.model.closed_loop_kernels import CURRENT_DEMAND
from fdhil.prediction.axis_models import build_nominal_models
from tests.bench import bench_config

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)
INCREMENT_MM = 20.0 / 65536


@pytest.mark.parametrize("rows", [3, 4, 5, 12, 100, 299, 300, 301, 302, 303, 360, 900])
def test_rest_of_any_length_is_held(rows: int) -> None:
    resting = StictionHold(MODELS["X"], CONFIG.axis["X"], 0.001, INCREMENT_MM)
    state = closed_loop.create_zero_state(0.0)
    offset = resting.compute_hold_offset(np.zeros(rows), np.array([3.0, 2.0]), state)
    assert offset.size == rows
    assert offset[:2].tolist() == [3.0, 2.0]
    assert np.array_equal(offset, np.rint(offset))
    assert np.abs(offset).max() < 30


def test_current_settles_during_rest() -> None:
    axis, model = CONFIG.axis["X"], MODELS["X"]
    moved = closed_loop.simulate_axis(
        model, axis, 0.001, np.concatenate([np.linspace(0.0, 0.02, 40), np.full(62, 0.02)])
    )
    state = moved.end
    resting = StictionHold(model, axis, 0.001, INCREMENT_MM)
    rest = np.full(900, 0.02)
    offset = resting.compute_hold_offset(rest, np.zeros(2), state)
    led = closed_loop.simulate_axis(model, axis, 0.001, rest + offset * INCREMENT_MM, state=state)
    left = closed_loop.simulate_axis(model, axis, 0.001, rest, state=state)
    assert np.ptp(led.position_mm[2:]) == 0.0
    band = model.Cd / model.K
    assert np.abs(led.states[CURRENT_DEMAND, 400:]).max() < 0.4 * band
    assert np.abs(left.states[CURRENT_DEMAND, 400:]).max() > 2 * np.abs(led.states[CURRENT_DEMAND, 400:]).max()
