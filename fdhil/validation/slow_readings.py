"""Refuses a slow voltage sensor whose own samples, before any fit, stay constant while the axis moves.

A steady voltage that is read coarsely repeats itself, and that is no fault. So a run of equal samples is refused if the
speed changes over it by more than such a reading hides, or if the sensor's noise would have changed it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fdhil.identification.motion import resolution
from fdhil.identification.windows import carried, noise_of, runs_of, smooth
from fdhil.records import Float, Reason, Window
from fdhil.validation.repeated_readings import alike
from fdhil.validation.significance import BUDGET

LEAST_SAMPLES = 3
MOVED_SAMPLES = 4  # equal while the speed changes: shorter runs may lie where current and speed balance
SPEED_CHANGE = 0.05  # of the rapid speed
READ_STEPS = 4.0  # change of a voltage beyond which equal readings are implausible
MOVING = 0.05  # of the rapid speed
LEAST_NOISE = 0.2  # of a step: noise hidden by the resolution
LEAST_NOISE_SAMPLES = 20


def slow_voltage_faults(window: Window) -> Iterator[Reason]:
    """Yield a reason if the samples of a slow voltage sensor repeat themselves, or stay at the sensor's limit."""
    slow = window.slow_voltage
    if slow is None or window.n == 0 or np.count_nonzero(np.isfinite(slow.voltage_v)) < LEAST_NOISE_SAMPLES:
        return
    volts, begins = slow.voltage_v, slow.begin_s + slow.period_s * np.arange(slow.voltage_v.size)
    speed = np.interp(
        begins + slow.period_s / 2, np.arange(window.n) * window.dt_s, smooth(window.speed_rad_s, window.dt_s)
    )
    rails = (float(np.nanmax(volts)), float(np.nanmin(volts)))
    step = max(resolution(volts[np.isfinite(volts)]), 1e-12)
    same = likely_same(volts, step)
    for start, end in runs(volts):
        moving = np.abs(speed[start:end]) > MOVING * window.rapid_speed_rad_s
        if not moving.all() or not _strange(window, volts, speed, (start, end), step, same):
            continue
        at, lasts = window.start_s + begins[start], 1e3 * (end - start) * slow.period_s
        if volts[start] in rails and rails[0] > rails[1]:
            text = f"voltage stays at its extreme {volts[start]:.6g} V for {end - start} samples from {at:.3f} s"
            yield Reason("Saturated", text, "use a larger measuring range")
        else:
            text = f"voltage repeats {volts[start]:.6g} V for {lasts:.0f} ms from {at:.3f} s while the axis moves"
            yield Reason("StuckValue", text, "check the sensor or the object's mapping")
        return


def runs(volts: Float) -> list[tuple[int, int]]:
    """Return the half-open runs of equal samples, the longest first."""
    return [(start, end + 1) for start, end in runs_of(np.diff(volts) == 0.0, LEAST_SAMPLES - 1)]


def _strange(window: Window, volts: Float, speed: Float, run: tuple[int, int], step: float, same: float) -> bool:
    start, end = run
    peak = float(np.nanmax(np.abs(volts)))
    read = READ_STEPS * step / peak if peak else 0.0  # a sensor that only reads 0 shows no step
    hidden = max(SPEED_CHANGE, read) * window.rapid_speed_rad_s
    # the first sample of a run may still be correct, and the last one correct again
    inner = speed[start + 1 : end - 1]
    if end - start >= MOVED_SAMPLES and float(np.ptp(inner)) > hidden:
        return True
    return volts.size * same ** (end - start - 1) < BUDGET["slow voltage"].chance


def likely_same(volts: Float, step: float) -> float:
    """Return the probability that a constant mid-step is read there, by the noise of third differences."""
    noise = math.sqrt(max(noise_of(carried(volts)) ** 2 - step**2 / 12.0, (LEAST_NOISE * step) ** 2))
    return alike(noise / step)
