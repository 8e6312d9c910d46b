"""A Modbus sensor at a fifth of the SYNC rate: from its bytes to published parameters; a late one is refused."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.pipeline import AxisPipeline
from fdhil.records import Outcome, ParameterSet, WindowOutcome
from tests.integration.conftest import Bench, digested, take_voltage_from_sensors
from tests.integration.test_loop import TRUE, recorded, shuttle

pytestmark = pytest.mark.usefixtures("long_computation")


@pytest.fixture
def transport() -> str:
    return "virtual"


@pytest.fixture
def sections() -> dict[str, Any]:
    return {"sim": {"pace": "realtime", "modbus": True, "modbus_cycles": 5}}


@pytest.fixture
def bench(bench: Bench) -> Bench:
    return take_voltage_from_sensors(bench)


def outcomes_of(bench: Bench, folder: Path, rounds: int = 2) -> dict[str, list[Outcome]]:
    records, counters = asyncio.run(recorded(bench, shuttle(folder, rounds)))
    assert counters["lost"] == 0, counters
    assert not any(counters[f"modbus.{axis}.lost"] for axis in bench.config.axis)
    return {axis: digested(AxisPipeline(axis, bench.config), records) for axis in bench.config.axis}


def test_published_intervals_cover_the_true_values(bench: Bench, tmp_path: Path) -> None:
    for outcomes in outcomes_of(bench, tmp_path).values():
        windows = [o for o in outcomes if isinstance(o, WindowOutcome)]
        assert [o.verdict.accepted for o in windows] == [True] * 4, [o.verdict for o in windows]
        for outcome in windows:
            slow, estimate = outcome.window.slow_voltage, outcome.estimate
            assert slow is not None
            assert slow.period_s == pytest.approx(0.005, rel=1e-3)
            assert estimate is not None
            assert estimate.delay_s is not None
            assert abs(estimate.delay_s) < slow.period_s
        newest = [o for o in outcomes if isinstance(o, ParameterSet)][-1]
        stds = np.sqrt(np.diag(newest.covariance))
        for k, (name, true) in enumerate(TRUE.items()):
            apart = abs(newest.parameters.as_dict()[name] - true)
            assert apart < 4 * stds[k] < 0.15 * true, name


def test_delay_beyond_a_sample_is_refused_with_its_value(bench: Bench, tmp_path: Path) -> None:
    for axis in bench.config.axis:
        fault = {"command": "fault", "fault": "sensor_delayed", "axis": axis, "value": 2}
        bench.command(json.dumps(fault))
    for outcomes in outcomes_of(bench, tmp_path, rounds=1).values():
        windows = [o for o in outcomes if isinstance(o, WindowOutcome)]
        assert len(windows) == 2
        for outcome in windows:
            (late,) = [r for r in outcome.verdict.reasons if r.code == "SampleTiming"]
            assert " ms late against current and speed, more than a sample of 5" in late.text
            assert float(late.text.split()[2]) == pytest.approx(10.0, abs=1.5)
        assert not [o for o in outcomes if isinstance(o, ParameterSet)]
