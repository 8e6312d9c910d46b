"""Standstill reveals the sensors' zeros, and samples lost at the end of the move."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.rapid_windows import find_moving_range, find_windows
from fdhil.pipeline import analyse_window
from fdhil.records import Float, Reason, Window, freeze_array
from fdhil.validation.standstill_checks import check_sensor_offsets
from fdhil.validation.window_fit import WindowFit
from fdhil.validation.window_signals import WindowSignals
from studies import faults
from tests.identification.bench_recordings import find_noisy_windows

SETTINGS = Identification()


def _list_standstill_faults(window: Window) -> Sequence[Reason]:
    fit = maximum_likelihood.fit_windows([window], SETTINGS)
    assert fit is not None
    return [
        reason
        for reason in check_sensor_offsets(WindowFit(WindowSignals(window, SETTINGS), fit=fit))
        if "at standstill the current" in reason.text
    ]


@pytest.mark.parametrize("share", [-0.02, 0.02])
def test_current_offset_at_standstill_is_refused(share: float) -> None:
    window = find_noisy_windows(0.003)[0]
    off = share * float(np.abs(window.current_a).max())
    (reason,) = _list_standstill_faults(replace(window, current_a=freeze_array(window.current_a + off)))
    assert reason.code == "CalibrationSuspect"
    reported = re.search(r"reads (\S+) A", reason.text)
    assert reported is not None
    assert float(reported[1]) == pytest.approx(off, rel=0.1)


@pytest.mark.parametrize("noise", [0.001, 0.003, 0.005])
def test_correct_sensor_zeros_are_accepted(noise: float) -> None:
    assert [_list_standstill_faults(window) for window in find_noisy_windows(noise, moves=2)] == [[], []]


@pytest.mark.parametrize("rows_before_its_end", [5, 20, 60])
def test_samples_lost_in_motion_are_refused(rows_before_its_end: int) -> None:
    window = find_noisy_windows(0.003)[0]
    end = find_moving_range(window)[1] - rows_before_its_end
    assert "StaleData" in {r.code for r in analyse_window(_drop_samples(window, end, 30), SETTINGS).verdict.reasons}


def test_samples_lost_at_standstill_are_tolerated() -> None:
    outcome = analyse_window(_drop_samples(find_noisy_windows(0.003)[0], 10, 20), SETTINGS)
    assert "StaleData" not in {r.code for r in outcome.verdict.reasons}


def _drop_samples(window: Window, begin: int, rows: int) -> Window:
    end = min(begin + rows, window.n)
    assert window.voltage_v is not None

    def drop(values: Float) -> Float:
        values = values.copy()
        values[begin:end] = np.nan
        return freeze_array(values)

    return replace(
        window,
        gaps=((begin, end),),
        voltage_v=drop(window.voltage_v),
        current_a=drop(window.current_a),
        speed_rad_s=drop(window.speed_rad_s),
        position_mm=drop(window.position_mm),
    )


@pytest.mark.parametrize(("seed", "told"), [(322, False), (2602, True)])
def test_stribeck_friction_is_accepted_if_rest_position_is_known(seed: int, told: bool) -> None:
    sticking = faults.KINDS["Stribeck friction"].make(np.random.default_rng([1, 2, seed]))
    (window,) = find_windows(sticking.recording)
    verdict = analyse_window(window, SETTINGS).verdict
    assert verdict.accepted == told
    assert ["the axis may slip" in reason.text for reason in verdict.reasons] == ([] if told else [True])
