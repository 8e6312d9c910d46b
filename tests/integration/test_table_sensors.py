"""What a motor's encoder cannot see: an encoder and an accelerometer at the table tell how it swings on its screw."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.pipeline import AxisPipeline
from fdhil.records import ParameterSet, WindowOutcome
from tests.bench import bench_document
from tests.integration.conftest import Bench, digested
from tests.integration.test_loop import recorded, shuttle

TRUE = {"X": (80.0, 0.03), "Y": (60.0, 0.03)}  # Hz, damping


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
    twins = {
        axis: {"reality": {"resonance_hz": hz, "resonance_damping": damping, "position_encoder": "motor"}}
        for axis, (hz, damping) in TRUE.items()
    }
    sim = {"pace": "realtime", "modbus": False, "axis": twins}
    return {"axis": axes, "sim": sim}


def test_the_resonance_is_found_in_rapids(bench: Bench, tmp_path: Path) -> None:
    records, counters = asyncio.run(recorded(bench, shuttle(tmp_path)))
    for axis, (hz, damping) in TRUE.items():
        outcomes = digested(AxisPipeline(axis, bench.config), records)
        for o in outcomes:
            if isinstance(o, WindowOutcome):
                print(o.at_table)
                print(
                    axis,
                    o.verdict.accepted,
                    o.verdict.reasons,
                    o.window.table_mm is not None,
                    o.window.table_m_s2 is not None,
                    o.estimate and o.estimate.terms,
                    o.estimate and [(n, o.estimate.value(n), o.estimate.std(n)) for n in o.estimate.terms],
                )
                np.savez(
                    f"/tmp/eyes/{axis}-{o.window.start_tick}.npz",
                    **{
                        k: getattr(o.window, k)
                        for k in ("speed_rad_s", "position_mm", "table_mm", "table_m_s2", "demand_mm", "current_a")
                        if getattr(o.window, k) is not None
                    },
                )
            if isinstance(o, ParameterSet):
                print(o.parameters)
    print(counters)
