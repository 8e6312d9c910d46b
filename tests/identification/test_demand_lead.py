"""A set-point recorded by the NC whole cycles before the drive's own is delayed and reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.demand_lead import align_demand_to_drive
from fdhil.pipeline import analyse_window
from fdhil.records import Window, freeze_array
from studies.real_plant import Loops
from tests.bench import bench_config
from tests.identification.realistic_rapids import simulate_rapids

SETTINGS, SYNC_S = Identification(), 1e-3
AXIS = bench_config("X").axis["X"]


def _shift_demand(window: Window, cycles: int) -> Window:
    later = np.full(cycles, window.demand_mm[-1])
    return replace(window, demand_mm=freeze_array(np.concatenate([window.demand_mm[cycles:], later])))


@pytest.mark.parametrize("cycles", [1, 4, 9])
def test_whole_cycle_lead_is_removed_and_reported(cycles: int) -> None:
    (window,) = simulate_rapids()
    ahead = _shift_demand(window, cycles)
    on_time, found = align_demand_to_drive(ahead, AXIS, SYNC_S)
    assert found == cycles
    np.testing.assert_array_equal(on_time.demand_mm[cycles:-cycles], window.demand_mm[cycles:-cycles])
    outcome = analyse_window(ahead, SETTINGS, AXIS, SYNC_S)
    assert outcome.verdict.accepted
    assert outcome.window is ahead
    assert any(f"{cycles} cycles ahead" in warning.text for warning in outcome.verdict.warnings)


def test_other_loops_do_not_look_like_a_lead() -> None:
    for loops in (Loops(), Loops(speed_filter_s=2e-3), Loops(position_gain_per_s=40.0)):
        (window,) = simulate_rapids(loops=loops)
        assert align_demand_to_drive(window, AXIS, SYNC_S) == (window, 0)


def test_lag_without_feed_forward_is_not_a_lead() -> None:
    (window,) = simulate_rapids(loops=Loops(speed_feedforward=0.0))
    regulators = AXIS.regulators.model_copy(update={"speed_feedforward": 0.0})
    slow = AXIS.model_copy(update={"regulators": regulators})
    assert align_demand_to_drive(_shift_demand(window, 3), slow, SYNC_S)[1] == 0
