"""Current and speed recorded with a slow voltage: a steady signal is not stuck, a late one is detected by its rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.identification.estimators.maximum_likelihood import fit_windows
from fdhil.pipeline import analyse_window
from fdhil.records import Window, freeze_array
from fdhil.validation.slow_voltage_checks import check_slow_current_delay
from fdhil.validation.stuck_signal import find_stuck_sensors
from fdhil.validation.window_fit import WindowFit
from fdhil.validation.window_signals import WindowSignals
from studies.slow_sensor import SETTINGS, record_slow_windows


def _quantise_window(window: Window) -> Window:
    """Return the window with coarse readings that are often equal: 0.3 A, 0.4 rad/s."""
    current, speed = (np.round(v / s) * s for v, s in ((window.current_a, 0.3), (window.speed_rad_s, 0.4)))
    return replace(window, current_a=freeze_array(current), speed_rad_s=freeze_array(speed))


def _find_stuck_signals(window: Window, name: str, start: int, rows: int) -> list[str]:
    values = np.array(getattr(window, name))
    values[start : start + rows] = values[start]
    held = freeze_array(values)
    stuck = replace(window, current_a=held) if name == "current_a" else replace(window, speed_rad_s=held)
    fit = fit_windows([stuck], SETTINGS)
    assert fit is not None
    return [
        reason.text.split(" ")[0] for reason in find_stuck_sensors(WindowFit(WindowSignals(stuck, SETTINGS), fit=fit))
    ]


def test_steady_coarse_signal_is_not_stuck() -> None:
    (window,) = record_slow_windows(0.005)
    fit = fit_windows([_quantise_window(window)], SETTINGS)
    assert fit is not None
    assert list(find_stuck_sensors(WindowFit(WindowSignals(_quantise_window(window), SETTINGS), fit=fit))) == []
    assert _find_stuck_signals(_quantise_window(window), "current_a", 500, 60) == []  # at full speed the current stays


@pytest.mark.parametrize("rows", [-3, 2, 4])
def test_late_current_is_named_with_delay(rows: int) -> None:
    (window,) = record_slow_windows(0.005)
    late = replace(window, current_a=freeze_array(np.roll(window.current_a, rows)))
    (reason,) = analyse_window(late, SETTINGS).verdict.reasons
    assert reason.code == "SampleTiming"
    assert f"current is {abs(rows)} ms {'late' if rows > 0 else 'early'}" in reason.text


def test_synchronous_current_is_never_late() -> None:
    for noise in (0.001, 0.005):
        (window,) = record_slow_windows(0.005, noise=noise)
        fit = fit_windows([window], SETTINGS)
        assert fit is not None
        assert list(check_slow_current_delay(window, fit, 0.0)) == []
