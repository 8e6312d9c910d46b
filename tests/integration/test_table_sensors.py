"""What a motor's encoder cannot see: an encoder and an accelerometer at the table tell how it swings on its screw."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from fdhil.pipeline import AxisPipeline
from fdhil.records import WindowOutcome
from tests.bench import bench_document
from tests.integration.conftest import Bench, digested
from tests.integration.test_loop import recorded, shuttle

TRUE = {"X": 80.0, "Y": 60.0}  # Hz


@pytest.fixture(params=["virtual"])
def transport(request: pytest.FixtureRequest) -> str:
    """The bus within the process: what is asked here is not the bus."""
    return str(request.param)


@pytest.fixture
def sections(tmp_path: Path) -> dict[str, Any]:
    """A screw that gives under either table, with an encoder at the one and an accelerometer at the other."""
    axes = bench_document()["axis"]
    axes["X"]["table"] = {"source": "canopen", "cob_id": 0x1A0, "byte": 2, "scale": 1e-4}
    axes["Y"]["accelerometer"] = {"device": str(tmp_path / "accelerometer"), "rate_hz": 800.0}
    twins = {axis: {"reality": {"resonance_hz": hz, "position_encoder": "motor"}} for axis, hz in TRUE.items()}
    sim = {"pace": "lockstep", "modbus": False, "axis": twins}
    return {"axis": axes, "sim": sim, "nc": {"smoothing_s": [0.02, 0.01]}}


def test_the_resonance_is_found_in_rapids(bench: Bench, tmp_path: Path) -> None:
    records, counters = asyncio.run(recorded(bench, shuttle(tmp_path)))
    assert counters["serial.Y.acceleration.samples"] > 3000
    for axis, hertz in TRUE.items():
        pipeline = AxisPipeline(axis, bench.config)
        windows = [o for o in digested(pipeline, records) if isinstance(o, WindowOutcome)]
        assert len(windows) == 4
        found = [o.estimate for o in windows if o.estimate is not None and "resonance" in o.estimate.terms]
        assert len(found) >= 3, axis
        for estimate in found:
            assert abs(estimate.value("resonance") - hertz) < 4 * estimate.std("resonance")
            assert estimate.value("resonance") == pytest.approx(hertz, rel=0.15)
        seen = [o.at_table for o in windows if o.at_table is not None]
        assert len(seen) == (4 if axis == "X" else 0)  # the other has no encoder
        for told in seen:  # the model with its resonance knows most of what the motor's encoder does not see
            assert told.unseen_rms_um > 15.0
            assert told.left_rms_um is not None
            assert told.left_rms_um < told.unseen_rms_um / 3
