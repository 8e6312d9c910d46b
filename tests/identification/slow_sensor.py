"""Rapids of the simulated bench whose voltage comes from a sensor with a slower grid and clock of its own."""

from __future__ import annotations

from studies.slow_sensor import slow_windows

__all__ = ["slow_windows"]
