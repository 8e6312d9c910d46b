"""Starts the fit of windows with a low-rate voltage: [5] over the sensor's samples, with the delay to some ms."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.config import Identification
from fdhil.identification.estimators.least_squares import (
    NAME,
    PARAMETER_ORDER,
    build_mechanical_regressors,
    build_two_step_estimate,
    compute_residuals,
    refuse_short_windows,
    solve_two_steps,
)
from fdhil.identification.filtering import compute_moving_mean, filter_zero_phase
from fdhil.identification.kalman import DELAY, L, R
from fdhil.identification.low_rate_voltage.low_rate_innovations import CORNER_ROWS, compute_low_rate_innovations
from fdhil.identification.normal_equations import invert_gram, solve_least_squares
from fdhil.identification.prepared_motion import Motion, prepare_window
from fdhil.identification.rapid_windows import fill_forward
from fdhil.identification.robust_covariance import estimate_aliasing_doubt
from fdhil.records import Estimate, Float, Window

SPAN_S = 0.025
SPAN_SAMPLES = 3
SHIFTS_PER_SAMPLE = 4
IMPROVEMENT = 1.5  # the residual's power must fall by this factor for a shift to be accepted
LEAST_SAMPLES = 16
BEYOND_NOISE = 3.0  # of the noise's variance: five samples rarely exceed it by chance
TIME_CONSTANT_S, LEAST_TIME_CONSTANT_S = 3e-3, 1e-4  # of a winding: usual, and least possible
FLOORS = 10.0 ** np.arange(-6.0, 1.01, 0.5)  # of the variance of the current's second difference that is noise


def estimate_start(
    windows: Sequence[Window], settings: Identification
) -> tuple[Float, list[float], list[Motion]] | None:
    """Return [R, L, K, Jt, ft, Cd] (6,), coarse delays in s, and the prepared windows; None with too few samples."""
    shifts = [_estimate_coarse_shift(w, settings.lowpass_hz) for w in windows]
    rows = _assemble_regressors(windows, shifts, settings)
    if rows is None:
        return None
    electrical, mechanical = rows
    theta = solve_two_steps(electrical, mechanical)[0][PARAMETER_ORDER]
    if theta[R] > 0.0 and theta[L] < LEAST_TIME_CONSTANT_S * theta[R]:
        # so coarse a delay is mistaken for L: R i + L di/dt is like R i, earlier by L / R
        shifts = [shift + TIME_CONSTANT_S - float(theta[L] / theta[R]) for shift in shifts]
        theta[L] = TIME_CONSTANT_S * theta[R]
    return theta, shifts, [prepare_window(w) for w in windows]


def _assemble_regressors(
    windows: Sequence[Window], shifts: Sequence[float], settings: Identification
) -> tuple[Float, Float] | None:
    """Return regressors (m, 4) of [u, Di, i, w] and (n, 4) of [i, Dw, w, sign w]; None with too few samples."""
    pairs = zip(windows, shifts, strict=True)
    electrical = np.vstack([build_sample_regressors(w, s, settings.lowpass_hz)[0] for w, s in pairs])
    mechanical = np.vstack([build_mechanical_regressors(w, settings) for w in windows])
    known = np.isfinite(electrical).all() and np.isfinite(mechanical).all()
    enough = min(electrical.shape[0], mechanical.shape[0]) >= LEAST_SAMPLES
    return (electrical, mechanical) if known and enough else None


def fit_low_rate_least_squares(windows: Sequence[Window], settings: Identification) -> Estimate:
    """Fit [5] to the sensor's samples and [6] to the drive's: for windows without a plausible start.

    The result shows what is wrong with them: an inverted sign makes R, K or Jt negative.
    """
    slow = [w for w in windows if w.slow_voltage is not None]
    rows = _assemble_regressors(slow, [_estimate_coarse_shift(w, settings.lowpass_hz) for w in slow], settings)
    if rows is None:
        return refuse_short_windows(NAME, 0)
    electrical, mechanical = rows
    theta, condition = solve_two_steps(electrical, mechanical)
    left = compute_residuals(theta, electrical, mechanical)
    covariance = np.zeros((6, 6))
    for block, x, e in zip((slice(0, 3), slice(3, 6)), (electrical, mechanical), left, strict=True):
        covariance[block, block] = invert_gram(x[:, 1:])[0] * float(e @ e) / e.size
    return build_two_step_estimate(NAME, theta, covariance, left, condition, mechanical)


def build_sample_regressors(window: Window, delay_s: float, lowpass_hz: float) -> tuple[Float, Float]:
    """Return (m, 4) of [u, Di, i, w] for voltage samples wholly inside the window, and their begins (m,)."""
    slow = window.slow_voltage
    assert slow is not None
    dt, last = window.dt_s, (window.n - 1) * window.dt_s
    begin = slow.begin_s - delay_s + slow.period_s * np.arange(slow.voltage_v.size)
    begin = begin if slow.late_s is None else begin + slow.late_s
    inside = (begin >= 0) & (begin + slow.period_s <= last) & np.isfinite(slow.voltage_v)
    begin, voltage = begin[inside], slow.voltage_v[inside]
    time = np.arange(window.n) * dt
    current, speed = fill_forward(window.current_a), fill_forward(window.speed_rad_s)
    if window.voltage_sampling == "instant":
        slope = np.gradient(filter_zero_phase(current, lowpass_hz, dt), dt)
        rows: Float = np.column_stack([voltage, *(np.interp(begin, time, s) for s in (slope, current, speed))])
        return rows, np.asarray(begin, np.float64)
    end = begin + slow.period_s
    rise = np.interp(end, time, current) - np.interp(begin, time, current)
    sums = [np.concatenate([[0.0], np.cumsum((s[1:] + s[:-1]) / 2)]) * dt for s in (current, speed)]
    swept = [np.interp(end, time, s) - np.interp(begin, time, s) for s in sums]
    rows = np.column_stack([voltage, *(part / slow.period_s for part in (rise, *swept))])
    return rows, np.asarray(begin, np.float64)


def _estimate_coarse_shift(window: Window, lowpass_hz: float) -> float:
    """Return the delay of the voltage in s (negative: early) to a quarter of its sample; 0 unless significant."""
    slow = window.slow_voltage
    assert slow is not None
    reach = max(SPAN_S, SPAN_SAMPLES * slow.period_s)
    step = slow.period_s / SHIFTS_PER_SAMPLE
    shifts = np.arange(-np.ceil(reach / step), np.ceil(reach / step) + 1) * step
    costs = np.full(shifts.size, np.inf)
    for k, shift in enumerate(shifts):
        rows, _ = build_sample_regressors(window, float(shift), lowpass_hz)
        if rows.shape[0] >= LEAST_SAMPLES and np.isfinite(rows).all():
            residual = rows[:, 0] - rows[:, 1:] @ solve_least_squares(rows[:, 1:], rows[:, 0])[0]
            costs[k] = float(residual @ residual) / rows.shape[0]
    best, none = int(np.argmin(costs)), shifts.size // 2
    if not np.isfinite(costs[[best, none]]).all() or costs[none] <= IMPROVEMENT * costs[best]:
        return 0.0
    return float(shifts[best])


def fit_current_walk(motion: Motion, theta: Float) -> Motion:
    """Return the motion with the random walk of its current between samples, for ``theta`` (7,).

    A rapid's current has corners where the acceleration begins and ends, and is smooth between. A walk that everywhere
    suits the corners would follow noise, a weaker one would attribute the corners to the voltage's delay. The most
    likely noise share of the walk is chosen.
    """
    sampled = replace(motion, shape_variance=_compute_shape_variance(motion, theta))
    second = np.pad(np.diff(motion.current, 2), 1, mode="edge")
    chance = 6.0 * motion.noise.current_a**2  # the variance that white noise gives a second difference
    shown = np.maximum(compute_moving_mean(second**2, CORNER_ROWS) - BEYOND_NOISE * chance, 0.0)
    trials = [replace(sampled, slope_walk=(shown + share * chance) / motion.dt_s**3) for share in FLOORS]
    costs = []
    for trial in trials:
        made = compute_low_rate_innovations(trial, theta, trial.noise.to_array() ** 2)
        costs.append(made.logdet + float(made.whitened @ made.whitened))
    return trials[int(np.nanargmin(costs))] if np.isfinite(costs).any() else trials[FLOORS.size // 2]


def _compute_shape_variance(motion: Motion, theta: Float) -> Float:
    """Return the variance (m,), V^2, of an instant against [1] due to regulators within a sample; 0 for means.

    Their effect on L di/dt is the same wherever the current changes, and so is attributed to L.
    """
    share = estimate_aliasing_doubt(motion.voltage_sampling, motion.dt_s)[0]
    course = motion.shift_voltage(float(theta[DELAY])).sample_at_voltage(
        compute_moving_mean(motion.current, CORNER_ROWS)
    )
    doubt: Float = (share * theta[R] * course) ** 2
    return doubt
