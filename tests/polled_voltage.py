"""Windows whose voltage comes from a polled meter: each value has its own time, near the sampling instant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.records import SlowVoltage, Window, freeze_array
from studies.slow_sensor import record_slow_windows

FINE_S, FINE_IN_PERIOD, REACH = 0.002, 5, 2


def build_polled_windows(*, noise: float = 0.005, timely: bool = False) -> list[Window]:
    """Return rapids polled every 10 ms: ``timely`` at the instants, else up to 4 ms off in either direction."""
    rng = np.random.default_rng(5)
    return [_poll_window(window, rng, timely) for window in record_slow_windows(FINE_S, "instant", noise=noise)]


def _poll_window(window: Window, rng: np.random.Generator, timely: bool) -> Window:
    fine = window.slow_voltage
    assert fine is not None
    places = np.arange(FINE_IN_PERIOD, fine.voltage_v.size - FINE_IN_PERIOD, FINE_IN_PERIOD)
    off = rng.integers(-REACH, REACH + 1, places.size) * (not timely)
    slow = SlowVoltage(
        fine.begin_s + FINE_S * FINE_IN_PERIOD,
        FINE_S * FINE_IN_PERIOD,
        fine.error_s,
        freeze_array(fine.voltage_v[places + off]),
        freeze_array(FINE_S * off),
    )
    return replace(window, slow_voltage=slow)
