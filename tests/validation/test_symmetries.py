"""Results do not depend on direction, units or the order of windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.config import Identification
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import Window, WindowOutcome, freeze_array
from tests.identification.bench_recordings import find_noisy_windows

SETTINGS = Identification()
ELECTRICAL = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # powers of a voltage unit in R, L, K, Jt, ft, Cd
CURRENT = np.array([-1.0, -1.0, 0.0, 1.0, 1.0, 1.0])


def _estimate_values(outcome: WindowOutcome) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert outcome.estimate is not None
    return np.array(outcome.estimate.values)


def _scale_window(window: Window, voltage: float = 1.0, current: float = 1.0) -> Window:
    assert window.voltage_v is not None
    volts, amperes = freeze_array(voltage * window.voltage_v), freeze_array(current * window.current_a)
    return replace(window, voltage_v=volts, current_a=amperes)


@settings(max_examples=6, deadline=None)
@given(voltage=st.floats(0.2, 5.0), current=st.floats(0.2, 5.0))
def test_units_scale_only_parameters(voltage: float, current: float) -> None:
    window = find_noisy_windows(0.003)[0]
    plain, other = (
        _estimate_values(analyse_window(window, SETTINGS)),
        _estimate_values(analyse_window(_scale_window(window, voltage, current), SETTINGS)),
    )
    assert other == pytest.approx(plain * voltage**ELECTRICAL * current**CURRENT, rel=2e-3)


def test_reversed_direction_gives_same_parameters() -> None:
    window = find_noisy_windows(0.003)[0]
    turned = replace(_scale_window(window, -1.0, -1.0), direction=-window.direction)
    speed, position, demand = (freeze_array(-v) for v in (window.speed_rad_s, window.position_mm, window.demand_mm))
    turned = replace(turned, speed_rad_s=speed, position_mm=position, demand_mm=demand)
    assert _estimate_values(analyse_window(turned, SETTINGS)) == pytest.approx(
        _estimate_values(analyse_window(window, SETTINGS)), rel=1e-6
    )


@pytest.mark.usefixtures("long_computation")
@settings(max_examples=4, deadline=None)
@given(order=st.permutations(range(4)))
def test_window_order_does_not_change_pool(order: list[int]) -> None:
    outcomes = [analyse_window(window, SETTINGS) for window in find_noisy_windows(0.003, moves=4)]
    first, _ = pool_windows(outcomes, SETTINGS)
    again, verdict = pool_windows([outcomes[k] for k in order], SETTINGS)
    assert verdict.accepted
    assert first is not None
    assert again is not None
    assert again.values == pytest.approx(first.values, rel=2e-3)
