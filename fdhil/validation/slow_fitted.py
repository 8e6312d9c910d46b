"""Checks a slow voltage sensor's samples against the fitted model: that none sticks or is off at standstill.

The filter predicts each sample from current and speed, with its standard deviation. A working sensor repeats its
reading where its noise and resolution allow it, and where the voltage stays; a stuck one repeats it whatever the
voltage does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fdhil.identification.motion import resolution
from fdhil.identification.normal import inverse_of
from fdhil.identification.slow_start import sample_rows
from fdhil.identification.slow_voltage import innovations_of
from fdhil.records import Reason, SlowVoltage
from fdhil.validation.sensor_reconstruction import log_beyond
from fdhil.validation.significance import BUDGET
from fdhil.validation.slow_readings import LEAST_NOISE_SAMPLES, likely_same, runs
from fdhil.validation.window_fit import WindowFit

LEAST_OFFSET = 0.01  # of the peak of voltage or current
LEAST_AT_REST = 12  # samples: with fewer, their own scatter is not known


def slow_faults_beside(fitted: WindowFit) -> Iterator[Reason]:
    """Yield the contradictions between the samples of a slow voltage and the model fitted to the window."""
    slow, fit = fitted.window.slow_voltage, fitted.required_fit
    if slow is None or np.count_nonzero(np.isfinite(slow.voltage_v)) < LEAST_NOISE_SAMPLES:
        return
    if not (np.isfinite(fit.theta).all() and (fit.theta[:4] > 0).all()):
        return
    yield from _stuck(fitted, slow)
    yield from _off_at_rest(fitted, slow)


def _stuck(fitted: WindowFit, slow: SlowVoltage) -> Iterator[Reason]:
    """Yield a reason for a run of equal samples that neither the sensor's noise nor the model explains by chance.

    A working sensor needs both: its noise leaves the reading of a constant equal, and the model deviates from it by
    chance.
    """
    fit, volts = fitted.required_fit, slow.voltage_v
    motion = fit.problem.motions[0]
    noise = fit.problem.noises[0].vector() ** 2
    made = innovations_of(motion, fit.theta, noise, float(fit.theta[6]))
    errors, spread = made.values[2 * motion.n :], np.sqrt(made.variance[2 * motion.n :])
    step = resolution(volts[np.isfinite(volts)])
    beyond = np.maximum(np.abs(errors) - step / 2, 0.0) / spread  # beyond its resolution
    limit = BUDGET["slow voltage"].log_chance
    same = math.log(max(likely_same(volts, max(step, 1e-12)), 1e-300))
    for start, end in runs(volts):
        squares = float(beyond[start + 1 : end] @ beyond[start + 1 : end])
        count = end - start - 1
        if math.log(volts.size) + count * same + min(log_beyond(squares, count), 0.0) < limit:
            at = fitted.window.start_s + slow.begin_s + start * slow.period_s
            lasts = 1e3 * (end - start) * slow.period_s
            text = f"voltage repeats {volts[start]:.6g} V for {lasts:.0f} ms from {at:.3f} s, current and speed do not"
            yield Reason("StuckValue", text, "check the sensor or the object's mapping")
            return


def _off_at_rest(fitted: WindowFit, slow: SlowVoltage) -> Iterator[Reason]:
    """Yield a reason if u = R i does not hold at standstill, where nothing else of the model is needed.

    The rows of the rapid itself hardly show an offset, since R and K imitate most of it.
    """
    window, fit = fitted.window, fitted.required_fit
    theta = fit.theta
    rows, begin = sample_rows(window, float(theta[6]), fitted.signals.settings.lowpass_hz)
    time, rest = np.arange(window.n) * window.dt_s, fitted.signals.standstill.astype(np.float64)
    lasts = slow.period_s if window.voltage_sampling == "interval_mean" else 0.0
    ends = [np.interp(at, time, rest) for at in (begin - window.dt_s, begin + lasts / 2, begin + lasts + window.dt_s)]
    still = rows[np.min(ends, axis=0) == 1.0]
    if len(still) < LEAST_AT_REST:
        return
    left = still[:, 0] - still[:, 1:] @ theta[[1, 0, 2]]
    mean_a = float(np.mean(still[:, 2]))
    of_r = float(np.sqrt(inverse_of(fit.information)[0][0, 0])) * mean_a
    chance = BUDGET["standstill"].deviations * math.hypot(float(np.std(left, ddof=1)) / math.sqrt(len(left)), of_r)
    # a steady signal may be half a step from its reading
    hidden = 0.5 * (resolution(rows[:, 0]) + theta[0] * resolution(window.current_a[np.isfinite(window.current_a)]))
    off = float(np.mean(left))
    peak = min(float(np.nanmax(np.abs(slow.voltage_v))), theta[0] * float(np.nanmax(np.abs(window.current_a))))
    if abs(off) > max(LEAST_OFFSET * peak, chance) + hidden:
        text = f"voltage and R i are {off:+.3g} V apart at standstill: an offset of voltage or current"
        yield Reason("CalibrationSuspect", text, "set the zero of both sensors at standstill")
