"""Cascade and PID with the same sum and product of gains are reported as equivalent."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.api.loop_comparison import list_equivalent_loops
from fdhil.config.regulators import Regulators
from fdhil.model import closed_loop
from fdhil.records import LoopEstimate, Parameters, Verdict, freeze_array
from studies.bench import make_shuttle_demand
from tests.bench import bench_config

NAMES = ("position_gain_per_s", "speed_feedforward", "speed_kp", "position_ki_per_s2")


def make_loops(structure: str, names: tuple[str, ...], values: tuple[float, ...]) -> LoopEstimate:
    covariance = freeze_array(np.zeros((len(names), len(names))))
    return LoopEstimate("X", structure, names, freeze_array(values), covariance, Verdict(True, None, ()), None)


def test_pid_is_reported_with_two_equivalent_cascades() -> None:
    same = list_equivalent_loops(make_loops("pid", NAMES, (84.0, 1.0, 20.0, 1760.0)))
    assert [each["position_gain_per_s"] for each in same] == pytest.approx([40.0, 44.0])
    assert [each["speed_ki"] for each in same] == pytest.approx([880.0, 800.0])


def test_no_equivalent_cascade_for_complex_gains_or_partial_feedforward() -> None:
    assert list_equivalent_loops(make_loops("pid", NAMES, (40.0, 1.0, 20.0, 1760.0))) == []
    assert list_equivalent_loops(make_loops("pid", NAMES, (84.0, 0.5, 20.0, 1760.0))) == []


@pytest.mark.usefixtures("long_computation")
def test_equivalent_cascade_follows_rapid_identically() -> None:
    axis = bench_config().axis["X"]
    model, demand_mm = Parameters(**axis.nominal.model_dump()), 1e3 * make_shuttle_demand()
    g = axis.regulators
    names = ("position_gain_per_s", "speed_feedforward", "speed_kp", "speed_ki")
    cascade = make_loops("p_pi_pi", names, (g.position_gain_per_s, 1.0, g.speed_kp, g.speed_ki))
    pid, exchanged = list_equivalent_loops(cascade)
    assert (pid["structure"], exchanged["structure"]) == ("pid", "p_pi_pi")
    other = axis.model_copy(update={"regulators": Regulators.model_validate(g.model_dump() | dict(exchanged))})
    places = [closed_loop.simulate_axis(model, each, 0.001, demand_mm).position_mm for each in (axis, other)]
    assert 1e3 * np.abs(places[1] - places[0]).max() < 0.02 * 1e3 * np.abs(places[0] - demand_mm).max()
