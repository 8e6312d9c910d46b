"""A slow voltage sensor's own samples: stuck and clipped ones are reported, steady coarse ones are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.config import Identification
from fdhil.pipeline import analyse
from fdhil.records import Float, Stages, Window, freeze_array
from fdhil.validation.slow_voltage_checks import slow_voltage_faults
from studies.slow_sensor import slow_windows


def _told(window: Window, volts: Float) -> list[str]:
    assert window.slow_voltage is not None
    changed = replace(window, slow_voltage=replace(window.slow_voltage, voltage_v=freeze_array(volts)))
    return [reason.code for reason in slow_voltage_faults(changed)]


def _volts(window: Window) -> Float:
    assert window.slow_voltage is not None
    return np.array(window.slow_voltage.voltage_v)


def test_a_sample_that_repeats_on_a_ramp_or_where_noise_would_change_it_is_stuck() -> None:
    window = slow_windows(0.005)[0]
    for start in (25, 80):  # on the ramp, and at full speed
        volts = _volts(window)
        volts[start : start + 8] = volts[start]
        assert _told(window, volts) == ["StuckValue"]


def test_a_clipped_ramp_is_saturated() -> None:
    window = slow_windows(0.005)[0]
    volts = _volts(window)
    assert _told(window, np.minimum(volts, 0.8 * volts.max())) == ["Saturated"]


def test_good_samples_are_nothing_however_coarse() -> None:
    for period in (0.002, 0.005, 0.010):
        window = slow_windows(period)[0]
        for step in (0.001, 0.3, 1.0):
            assert _told(window, np.round(_volts(window) / step) * step) == []


def test_a_sensor_that_reads_nothing_but_zero_is_named_and_no_rows_are_answered() -> None:
    window = slow_windows(0.005)[0]
    begin, end = 80, 980  # the move alone: a run over standstill would be no finding
    names = ("demand_mm", "position_mm", "speed_rad_s", "current_a")
    for rows, codes in ((slice(begin, end), ["StuckValue"]), (slice(0), [])):
        cut = replace(window, stages=Stages(None, None, None), **{n: getattr(window, n)[rows] for n in names})
        assert _told(cut, np.zeros(int((end - begin) / 5) - 12)) == codes
        assert not analyse(cut, Identification()).verdict.accepted
