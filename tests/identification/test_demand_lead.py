"""A set-point recorded by the NC whole cycles before the drive's own is delayed and reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.demand_lead import with_demand_on_time
from fdhil.pipeline import analyse
from fdhil.records import Window, freeze_array
from studies.real_plant import Loops
from tests.bench import bench_config
from tests.identification.realistic import rapids

SETTINGS, SYNC_S = Identification(), 1e-3
AXIS = bench_config("X").axis["X"]


def _ahead(window: Window, cycles: int) -> Window:
    later = np.full(cycles, window.demand_mm[-1])
    return replace(window, demand_mm=freeze_array(np.concatenate([window.demand_mm[cycles:], later])))


@pytest.mark.parametrize("cycles", [1, 4, 9])
def test_lead_of_whole_cycles_is_found_and_reported(cycles: int) -> None:
    (window,) = rapids()
    ahead = _ahead(window, cycles)
    on_time, found = with_demand_on_time(ahead, AXIS, SYNC_S)
    assert found == cycles
    np.testing.assert_array_equal(on_time.demand_mm[cycles:-cycles], window.demand_mm[cycles:-cycles])
    outcome = analyse(ahead, SETTINGS, AXIS, SYNC_S)
    assert outcome.verdict.accepted
    assert outcome.window is ahead
    assert any(f"{cycles} cycles ahead" in warning.text for warning in outcome.verdict.warnings)


def test_drive_with_other_loops_has_no_lead() -> None:
    for loops in (Loops(), Loops(speed_filter_s=2e-3), Loops(position_gain_per_s=40.0)):
        (window,) = rapids(loops=loops)
        assert with_demand_on_time(window, AXIS, SYNC_S) == (window, 0)


def test_lag_of_a_drive_without_feed_forward_is_no_lead() -> None:
    (window,) = rapids(loops=Loops(speed_feedforward=0.0))
    regulators = AXIS.regulators.model_copy(update={"speed_feedforward": 0.0})
    slow = AXIS.model_copy(update={"regulators": regulators})
    assert with_demand_on_time(_ahead(window, 3), slow, SYNC_S)[1] == 0
