"""A slow voltage sensor's own samples: stuck and clipped ones are reported, steady coarse ones are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.config import Identification
from fdhil.pipeline import analyse_window
from fdhil.records import Float, Stages, Window, freeze_array
from fdhil.validation.slow_voltage_checks import check_slow_voltage_readings
from studies.slow_sensor import record_slow_windows


def _list_codes(window: Window, volts: Float) -> list[str]:
    assert window.slow_voltage is not None
    changed = replace(window, slow_voltage=replace(window.slow_voltage, voltage_v=freeze_array(volts)))
    return [reason.code for reason in check_slow_voltage_readings(changed)]


def _make_voltage(window: Window) -> Float:
    assert window.slow_voltage is not None
    return np.array(window.slow_voltage.voltage_v)


def test_repeated_sample_on_ramp_or_under_noise_is_stuck() -> None:
    window = record_slow_windows(0.005)[0]
    for start in (25, 80):  # on the ramp, and at full speed
        volts = _make_voltage(window)
        volts[start : start + 8] = volts[start]
        assert _list_codes(window, volts) == ["StuckValue"]


def test_clipped_ramp_is_saturated() -> None:
    window = record_slow_windows(0.005)[0]
    volts = _make_voltage(window)
    assert _list_codes(window, np.minimum(volts, 0.8 * volts.max())) == ["Saturated"]


def test_coarse_valid_samples_yield_no_fault() -> None:
    for period in (0.002, 0.005, 0.010):
        window = record_slow_windows(period)[0]
        for step in (0.001, 0.3, 1.0):
            assert _list_codes(window, np.round(_make_voltage(window) / step) * step) == []


def test_zero_only_sensor_is_named() -> None:
    window = record_slow_windows(0.005)[0]
    begin, end = 80, 980  # the move alone: a run over standstill would be no finding
    names = ("demand_mm", "position_mm", "speed_rad_s", "current_a")
    for rows, codes in ((slice(begin, end), ["StuckValue"]), (slice(0), [])):
        cut = replace(window, stages=Stages(None, None, None), **{n: getattr(window, n)[rows] for n in names})
        assert _list_codes(cut, np.zeros(int((end - begin) / 5) - 12)) == codes
        assert not analyse_window(cut, Identification()).verdict.accepted
