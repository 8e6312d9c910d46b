"""Publishers are small processes: up to four of them run next to an NC."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.usefixtures("processes")

HEAVY = ("numba", "scipy", "pyarrow", "can", "canopen", "pymodbus")


@pytest.mark.parametrize("module", ["mqtt_publisher", "mtconnect_adapter", "prometheus_endpoint"])
def test_publisher_imports_no_numerics_and_no_bus_drivers(module: str) -> None:
    asked = f"import sys, fdhil.shopfloor.{module}; print(*[name for name in {HEAVY} if name in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", asked], check=True, capture_output=True, text=True, timeout=120)
    assert loaded.stdout.split() == []
