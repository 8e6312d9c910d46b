"""Checks the samples of a slow voltage sensor: on their own, against the fitted model, and the current beside them.

A steady voltage that is read coarsely repeats itself, and that is no fault. So, before any fit, a run of equal samples
is refused if the speed changes over it by more than such a reading hides, or if the sensor's noise would have changed
it. The fit's filter predicts each sample from current and speed, with its standard deviation: a working sensor repeats
its reading where its noise and resolution allow it, and where the voltage stays; a stuck one repeats it whatever the
voltage does. The delay of a slow voltage is one of the parameters. A current that a drive or a recorder assigns to
later rows shifts by whole rows, which a load along the ramps imitates badly: the gain in likelihood shows it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fdhil.identification import (
    LikelihoodFit,
    Motion,
    build_sample_regressors,
    compute_innovations,
    compute_low_rate_innovations,
    compute_moving_mean,
    estimate_noise_std,
    fill_forward,
    find_resolution,
    fit_parameters_and_noise,
    invert_symmetric,
    smooth_samples,
    sort_runs_by_length,
)
from fdhil.records import Float, Reason, SlowVoltage, Window
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.repeated_readings import compute_repeat_probability
from fdhil.validation.sensor_reconstruction import compute_log_chi_square_tail
from fdhil.validation.signal_delays import LARGEST, SMOOTHING_S, build_delay_reason
from fdhil.validation.timing_checks import SEARCH
from fdhil.validation.window_fit import WindowFit

LEAST_SAMPLES = 3
MOVED_SAMPLES = 4  # equal while the speed changes: shorter runs may lie where current and speed balance
SPEED_CHANGE = 0.05  # of the rapid speed
READ_STEPS = 4.0  # change of a voltage beyond which equal readings are implausible
MOVING = 0.05  # of the rapid speed
LEAST_NOISE = 0.2  # of a step: noise hidden by the resolution
LEAST_NOISE_SAMPLES = 20
LEAST_OFFSET = 0.01  # of the peak of voltage or current
LEAST_AT_REST = 12  # samples: with fewer, their own scatter is not known
LEAST_GAIN = BUDGET["timing"].deviations ** 2
FIRST_SHARE = 0.1  # of the required gain that the score must show at first: it is too small for a long delay


def check_slow_voltage_readings(window: Window) -> Iterator[Reason]:
    """Yield a reason if the samples of a slow voltage sensor repeat themselves, or stay at the sensor's limit."""
    slow = window.slow_voltage
    if slow is None or window.n == 0 or np.count_nonzero(np.isfinite(slow.voltage_v)) < LEAST_NOISE_SAMPLES:
        return
    volts, begins = slow.voltage_v, slow.begin_s + slow.period_s * np.arange(slow.voltage_v.size)
    speed = np.interp(
        begins + slow.period_s / 2, np.arange(window.n) * window.dt_s, smooth_samples(window.speed_rad_s, window.dt_s)
    )
    rails = (float(np.nanmax(volts)), float(np.nanmin(volts)))
    step = max(find_resolution(volts[np.isfinite(volts)]), 1e-12)
    same = compute_same_reading_probability(volts, step)
    for start, end in find_equal_runs(volts):
        moving = np.abs(speed[start:end]) > MOVING * window.rapid_speed_rad_s
        if not moving.all() or not _is_implausible_run(window, volts, speed, (start, end), step, same):
            continue
        at, lasts = window.start_s + begins[start], 1e3 * (end - start) * slow.period_s
        if volts[start] in rails and rails[0] > rails[1]:
            text = f"voltage stays at its extreme {volts[start]:.6g} V for {end - start} samples from {at:.3f} s"
            yield Reason("Saturated", text, "use a larger measuring range")
        else:
            text = f"voltage repeats {volts[start]:.6g} V for {lasts:.0f} ms from {at:.3f} s while the axis moves"
            yield Reason("StuckValue", text, "check the sensor or the object's mapping")
        return


def find_equal_runs(volts: Float) -> list[tuple[int, int]]:
    """Return the half-open runs of equal samples, the longest first."""
    return [(start, end + 1) for start, end in sort_runs_by_length(np.diff(volts) == 0.0, LEAST_SAMPLES - 1)]


def _is_implausible_run(
    window: Window, volts: Float, speed: Float, run: tuple[int, int], step: float, same: float
) -> bool:
    start, end = run
    peak = float(np.nanmax(np.abs(volts)))
    read = READ_STEPS * step / peak if peak else 0.0  # a sensor that only reads 0 shows no step
    hidden = max(SPEED_CHANGE, read) * window.rapid_speed_rad_s
    # the first sample of a run may still be correct, and the last one correct again
    inner = speed[start + 1 : end - 1]
    if end - start >= MOVED_SAMPLES and float(np.ptp(inner)) > hidden:
        return True
    return volts.size * same ** (end - start - 1) < BUDGET["slow voltage"].chance


def compute_same_reading_probability(volts: Float, step: float) -> float:
    """Return the probability that a constant mid-step is read there, by the noise of third differences."""
    noise = math.sqrt(max(estimate_noise_std(fill_forward(volts)) ** 2 - step**2 / 12.0, (LEAST_NOISE * step) ** 2))
    return compute_repeat_probability(noise / step)


def check_slow_voltage_fit(fitted: WindowFit) -> Iterator[Reason]:
    """Yield the contradictions between the samples of a slow voltage and the model fitted to the window."""
    slow, fit = fitted.window.slow_voltage, fitted.required_fit
    if slow is None or np.count_nonzero(np.isfinite(slow.voltage_v)) < LEAST_NOISE_SAMPLES:
        return
    if not (np.isfinite(fit.theta).all() and (fit.theta[:4] > 0).all()):
        return
    yield from _find_stuck_samples(fitted, slow)
    yield from _check_standstill_offset(fitted, slow)


def _find_stuck_samples(fitted: WindowFit, slow: SlowVoltage) -> Iterator[Reason]:
    """Yield a reason for a run of equal samples that neither the sensor's noise nor the model explains by chance.

    A working sensor needs both: its noise leaves the reading of a constant equal, and the model deviates from it by
    chance.
    """
    fit, volts = fitted.required_fit, slow.voltage_v
    motion = fit.problem.motions[0]
    noise = fit.problem.noises[0].to_array() ** 2
    made = compute_low_rate_innovations(motion, fit.theta, noise, float(fit.theta[6]))
    errors, spread = made.values[2 * motion.n :], np.sqrt(made.variance[2 * motion.n :])
    step = find_resolution(volts[np.isfinite(volts)])
    beyond = np.maximum(np.abs(errors) - step / 2, 0.0) / spread  # beyond its resolution
    limit = BUDGET["slow voltage"].log_chance
    same = math.log(max(compute_same_reading_probability(volts, max(step, 1e-12)), 1e-300))
    for start, end in find_equal_runs(volts):
        squares = float(beyond[start + 1 : end] @ beyond[start + 1 : end])
        count = end - start - 1
        if math.log(volts.size) + count * same + min(compute_log_chi_square_tail(squares, count), 0.0) < limit:
            at = fitted.window.start_s + slow.begin_s + start * slow.period_s
            lasts = 1e3 * (end - start) * slow.period_s
            text = f"voltage repeats {volts[start]:.6g} V for {lasts:.0f} ms from {at:.3f} s, current and speed do not"
            yield Reason("StuckValue", text, "check the sensor or the object's mapping")
            return


def _check_standstill_offset(fitted: WindowFit, slow: SlowVoltage) -> Iterator[Reason]:
    """Yield a reason if u = R i does not hold at standstill, where nothing else of the model is needed.

    The rows of the rapid itself hardly show an offset, since R and K imitate most of it.
    """
    window, fit = fitted.window, fitted.required_fit
    theta = fit.theta
    rows, begin = build_sample_regressors(window, float(theta[6]), fitted.signals.settings.lowpass_hz)
    time, rest = np.arange(window.n) * window.dt_s, fitted.signals.standstill.astype(np.float64)
    lasts = slow.period_s if window.voltage_sampling == "interval_mean" else 0.0
    ends = [np.interp(at, time, rest) for at in (begin - window.dt_s, begin + lasts / 2, begin + lasts + window.dt_s)]
    still = rows[np.min(ends, axis=0) == 1.0]
    if len(still) < LEAST_AT_REST:
        return
    left = still[:, 0] - still[:, 1:] @ theta[[1, 0, 2]]
    mean_a = float(np.mean(still[:, 2]))
    of_r = float(np.sqrt(invert_symmetric(fit.information)[0][0, 0])) * mean_a
    chance = BUDGET["standstill"].deviations * math.hypot(float(np.std(left, ddof=1)) / math.sqrt(len(left)), of_r)
    # a steady signal may be half a step from its reading
    hidden = 0.5 * (
        find_resolution(rows[:, 0]) + theta[0] * find_resolution(window.current_a[np.isfinite(window.current_a)])
    )
    off = float(np.mean(left))
    peak = min(float(np.nanmax(np.abs(slow.voltage_v))), theta[0] * float(np.nanmax(np.abs(window.current_a))))
    if abs(off) > max(LEAST_OFFSET * peak, chance) + hidden:
        text = f"voltage and R i are {off:+.3g} V apart at standstill: an offset of voltage or current"
        yield Reason("CalibrationSuspect", text, "set the zero of both sensors at standstill")


def check_slow_current_delay(window: Window, fit: LikelihoodFit, least_gain: float) -> Iterator[Reason]:
    """Yield a reason if the current is late by more than a row, and the window likelier so by ``least_gain``.

    ``fit`` is the window's; the gain is one of twice the log likelihood.
    """
    plain, last, rows = fit.problem.motions[0], fit, 0
    found, std = _estimate_current_delay(fit)
    if not (found / std) ** 2 > max(LEAST_GAIN, FIRST_SHARE * least_gain):
        return
    for _ in range(SEARCH):
        step = int(np.sign(found) * np.ceil(abs(found) - 0.5))  # away from zero: a score underestimates a long delay
        if step == 0:
            break
        rows += step
        earlier = plain.current[np.clip(np.arange(plain.n) + rows, 0, plain.n - 1)]
        last = fit_parameters_and_noise([replace(plain, current=earlier)], last.theta, last.free)
        if not (np.isfinite(last.residuals).all() and np.isfinite(last.information).all()):
            return
        found, _ = _estimate_current_delay(last)
    if abs(rows) > LARGEST and _compute_deviance(fit) - _compute_deviance(last) > max(LEAST_GAIN, least_gain):
        yield build_delay_reason("current", "speed and voltage", rows * window.dt_s, window.dt_s)


def _estimate_current_delay(fit: LikelihoodFit) -> tuple[float, float]:
    """Return the current's delay by the innovations, in rows, and its standard deviation."""
    motion: Motion = fit.problem.motions[0]
    width = 2 * round(SMOOTHING_S / 2 / motion.dt_s) + 1
    earlier = replace(motion, current=motion.current + np.gradient(compute_moving_mean(motion.current, width)))
    gains, theta = fit.problem.filters[0], fit.theta
    answer = compute_innovations(earlier, theta, gains) - compute_innovations(motion, theta, gains)
    rest = answer - fit.jacobian @ (invert_symmetric(fit.information)[0] @ (fit.jacobian.T @ answer))
    power = float(rest @ rest)
    return (-float(rest @ fit.residuals) / power, power**-0.5) if power > 0.0 else (0.0, np.inf)


def _compute_deviance(fit: LikelihoodFit) -> float:
    """Return minus twice the log likelihood, without its constant."""
    return compute_low_rate_innovations(
        fit.problem.motions[0], fit.theta, fit.problem.noises[0].to_array() ** 2, float(fit.theta[6])
    ).cost
