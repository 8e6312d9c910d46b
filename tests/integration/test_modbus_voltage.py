"""Drives without a voltage object: the voltage comes from Modbus sensors.

How well the sensor's counter is aligned with SYNC depends on the host that stamps both. On any host, a voltage that is
off by more than a sample is refused for its timing, and accepted results are right.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from fdhil.pipeline import AxisPipeline
from fdhil.records import VoltageSamples, WindowOutcome
from tests.integration.conftest import Bench, digested, take_voltage_from_sensors
from tests.integration.test_loop import TRUE, recorded, shuttle

pytestmark = pytest.mark.usefixtures("long_computation")


@pytest.fixture(params=["hub", pytest.param("socketcan", marks=pytest.mark.socketcan)])
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def sections() -> dict[str, Any]:
    return {"machine": {"name": "bench", "sync_period_s": 0.002}, "sim": {"pace": "realtime", "modbus": True}}


@pytest.fixture
def bench(bench: Bench) -> Bench:
    return take_voltage_from_sensors(bench)


def test_accepted_parameters_cover_the_true_values(bench: Bench, tmp_path: Path) -> None:
    records, counters = asyncio.run(recorded(bench, shuttle(tmp_path)))
    held_up = counters["lost"] > 0  # this host, for longer than a machine in real time waits for it: the windows say so
    assert any(isinstance(r, VoltageSamples) for r in records)
    for axis in bench.config.axis:
        pipeline = AxisPipeline(axis, bench.config)
        outcomes = digested(pipeline, records)
        windows = [o for o in outcomes if isinstance(o, WindowOutcome)]
        refused = [reason.code for o in windows for reason in o.verdict.reasons]
        # a host that is held up for longer than the sensor's buffer lasts loses samples, and says so
        lost = {"NotFinite"} if counters[f"modbus.{axis}.lost"] else set()
        assert held_up or (len(windows) == 4 and set(refused) <= {"SampleTiming"} | lost), refused
        for accepted in (o.estimate for o in windows if o.verdict.accepted):
            assert accepted is not None
            for name, true in TRUE.items():
                within = 0.01 if name not in ("ft", "Cd") else 0.05
                assert accepted.get_value(name) == pytest.approx(true, rel=within), name
