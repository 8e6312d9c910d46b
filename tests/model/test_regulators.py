"""The contract of every regulator structure, and what the options of the cascade do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fdhil import config as configuration
from fdhil import tables
from fdhil.config import Axis
from fdhil.correction import plan
from fdhil.errors import ConfigError
from fdhil.model import closed_loop
from fdhil.prediction.models import nominal_models
from fdhil.records import Float, Parameters
from tests.bench import bench_document
from tests.paths import bench_demand, bench_trajectory, rms

PERIOD = 0.001
OPTIONS: list[dict[str, Any]] = [
    {"structure": "cascade"},
    {"structure": "cascade", "position_ki_per_s2": 300.0, "speed_feedforward": 0.0},
    {"structure": "cascade", "speed_kd": 0.0005},
    {"structure": "cascade", "acceleration_feedforward": 1.0},
    {"structure": "cascade", "setpoint_filter_s": 0.002},
    {"structure": "cascade", "current_delay_cycles": 2},
]
STRUCTURES = [{"structure": name} for name in tables.REGULATORS]


def bench(**regulators: Any) -> configuration.MachineConfig:
    """The bench with other regulators."""
    document = bench_document()
    for axis in document["axis"].values():
        axis["regulators"] |= regulators
    return configuration.parse(document)


def run(axis: Axis, demand: Float, **more: Any) -> closed_loop.Response:
    """Simulate the nominal plant."""
    return closed_loop.simulate(Parameters(**axis.nominal.model_dump()), axis, PERIOD, demand, **more)


@pytest.mark.parametrize("regulators", STRUCTURES + OPTIONS[1:])
def test_contract(regulators: dict[str, Any]) -> None:
    """Starts where it is told, follows to rest, keeps its limits, and continues from any row with the same bits."""
    axis = bench(**regulators).axis["X"]
    demand = bench_demand(5)[:, 1]
    whole = run(axis, demand)
    assert whole.position_mm[0] == demand[0]
    assert whole.speed_rad_s[0] == whole.current_a[0] == 0.0
    assert np.abs(whole.position_mm - demand).max() < 3.0
    assert abs(whole.position_mm[-1] - demand[-1]) < 0.06
    assert np.abs(whole.current_a).max() < 1.05 * axis.regulators.current_limit_a
    row = 700
    tail = run(axis, demand, state=whole.state_at(row), first=row)
    assert np.array_equal(tail.position_mm, whole.position_mm[row:])
    assert np.array_equal(tail.end, whole.end)


def test_the_plain_cascade_is_the_default_structure() -> None:
    """Without options both kernels agree."""
    demand = bench_demand(10)[:, 0]
    both = [run(bench(structure=name).axis["X"], demand).position_mm for name in ("p_pi_pi", "cascade")]
    assert np.abs(both[0] - both[1]).max() < 1e-6


def largest(**regulators: Any) -> float:
    """Largest following error of the bench path's Y axis in um."""
    demand = bench_demand(10)[:, 1]
    response = run(bench(structure="cascade", **regulators).axis["Y"], demand)
    return float(np.abs(response.position_mm - demand).max()) * 1e3


def test_options_do_what_they_are_for() -> None:
    """Acceleration fed forward and a position integral make errors smaller; filter and delay make them larger."""
    plain = largest()
    assert largest(acceleration_feedforward=1.0) < 0.5 * plain
    assert largest(setpoint_filter_s=0.002) > 2 * plain
    assert largest(current_delay_cycles=4) != plain
    lagging = largest(speed_feedforward=0.0)
    assert largest(speed_feedforward=0.0, position_ki_per_s2=400.0) < lagging


def test_the_default_structure_refuses_what_it_has_not() -> None:
    """An option of the cascade with structure p_pi_pi would be ignored silently."""
    with pytest.raises(ConfigError, match="cascade"):
        bench(speed_kd=0.01)


@pytest.mark.parametrize("regulators", [o for o in OPTIONS if "position_ki_per_s2" not in o])
def test_the_inverse_works_for_every_structure(regulators: dict[str, Any]) -> None:
    """Its linear part comes from a simulated impulse, whatever the regulators are."""
    config = bench(**regulators)
    correction = plan(bench_trajectory(10), nominal_models(config), config, "inverse")
    assert correction.refused == ()
    assert rms(correction.before.contour_um) > 10 * rms(correction.after.contour_um)
