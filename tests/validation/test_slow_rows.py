"""Current and speed recorded with a slow voltage: a steady signal is not stuck, a late one is detected by its rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.identification.estimators.maximum_likelihood import fit_windows
from fdhil.pipeline import analyse
from fdhil.records import Window, freeze_array
from fdhil.validation.slow_voltage_checks import current_late
from fdhil.validation.stuck import stuck_values
from fdhil.validation.window_fit import WindowFit
from fdhil.validation.window_signals import WindowSignals
from studies.slow_sensor import SETTINGS, slow_windows


def _coarse(window: Window) -> Window:
    """Return the window with coarse readings that are often equal: 0.3 A, 0.4 rad/s."""
    current, speed = (np.round(v / s) * s for v, s in ((window.current_a, 0.3), (window.speed_rad_s, 0.4)))
    return replace(window, current_a=freeze_array(current), speed_rad_s=freeze_array(speed))


def _stuck(window: Window, name: str, start: int, rows: int) -> list[str]:
    values = np.array(getattr(window, name))
    values[start : start + rows] = values[start]
    held = freeze_array(values)
    stuck = replace(window, current_a=held) if name == "current_a" else replace(window, speed_rad_s=held)
    fit = fit_windows([stuck], SETTINGS)
    assert fit is not None
    return [reason.text.split(" ")[0] for reason in stuck_values(WindowFit(WindowSignals(stuck, SETTINGS), fit=fit))]


def test_a_steady_signal_that_is_read_coarsely_does_not_stick() -> None:
    (window,) = slow_windows(0.005)
    fit = fit_windows([_coarse(window)], SETTINGS)
    assert fit is not None
    assert list(stuck_values(WindowFit(WindowSignals(_coarse(window), SETTINGS), fit=fit))) == []
    assert _stuck(_coarse(window), "current_a", 500, 60) == []  # at full speed the current stays


@pytest.mark.parametrize("rows", [-3, 2, 4])
def test_a_current_that_is_late_is_named_with_its_delay(rows: int) -> None:
    (window,) = slow_windows(0.005)
    late = replace(window, current_a=freeze_array(np.roll(window.current_a, rows)))
    (reason,) = analyse(late, SETTINGS).verdict.reasons
    assert reason.code == "SampleTiming"
    assert f"current is {abs(rows)} ms {'late' if rows > 0 else 'early'}" in reason.text


def test_a_current_in_time_is_not_late_however_little_is_wanted() -> None:
    for noise in (0.001, 0.005):
        (window,) = slow_windows(0.005, noise=noise)
        fit = fit_windows([window], SETTINGS)
        assert fit is not None
        assert list(current_late(window, fit, 0.0)) == []
