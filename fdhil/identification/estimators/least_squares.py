"""Estimates by the paper's method: one low-pass on every signal, operator [4], least squares on [5] and [6] of [DES].

Current and speed are converted to interval means like the voltage's. [6] is fitted as K i = Jt Dw + ft w + Cd sign(w)
with K from [5]. One sandwich over both equations yields the standard deviations: filtered residuals are coloured.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Identification
from fdhil.identification.derivatives import ZERO_FORCING_1, DerivativeStencil, differentiate_signal
from fdhil.identification.filtering import (
    compute_filter_reach,
    compute_impulse_response,
    erode_flags,
    filter_zero_phase,
)
from fdhil.identification.identifiability import create_empty_estimate, withhold_unidentifiable
from fdhil.identification.normal_equations import solve_least_squares
from fdhil.identification.prepared_motion import detect_motion, estimate_noise_levels
from fdhil.identification.rapid_windows import fill_forward
from fdhil.identification.robust_covariance import (
    compute_residual_autocovariances,
    compute_two_step_covariance,
    estimate_aliasing_doubt,
    estimate_attenuation_bias,
)
from fdhil.identification.speed_alignment import align_speed_to_samples
from fdhil.records import PARAMETERS, Bool, Estimate, Float, Reason, Result, Window

NAME = "least_squares"
PARAMETER_ORDER = [1, 0, 2, 3, 4, 5]  # from L, R, K to R, L, K, and back
# of [L, R, K, Jt, ft, Cd]: doubt due to stencils and the voltage's waveform within a sample, without noise
OPEN_SHARE = np.array([1e-3, 5e-4, 5e-5, 3e-4, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class AlignedSignals:
    """A window's signals (n,), filtered alike and at one instant per sample; ``usable`` marks the samples to fit."""

    voltage: Float
    current: Float
    speed: Float
    side: Float
    usable: Bool
    broken: Bool


def compute_interval_means(values: Float) -> Float:
    """Return the mean of a sampled signal over [t_k, t_k + dt) (n,), exact for cubics; the ends by a line."""
    means = np.empty_like(values)
    means[1:-2] = (-values[:-3] + 13 * values[1:-2] + 13 * values[2:-1] - values[3:]) / 24
    means[0] = (values[0] + values[1]) / 2
    means[-2] = (values[-2] + values[-1]) / 2
    means[-1] = values[-1]
    return means


def align_signals(window: Window, settings: Identification) -> AlignedSignals:
    """Return the three signals at one instant per sample, through the same zero-phase low-pass."""
    assert window.voltage_v is not None
    dt = window.dt_s
    raw = [fill_forward(s) for s in (window.voltage_v, window.current_a, window.speed_rad_s)]
    voltage, current, speed = raw
    if window.voltage_sampling == "interval_mean":
        current, speed = compute_interval_means(current), compute_interval_means(speed)
    moving = detect_motion(window.speed_rad_s, window.rapid_speed_rad_s)
    filtered = filter_zero_phase(np.stack([voltage, current, speed]), settings.lowpass_hz, dt)
    side = np.where(moving, np.sign(filtered[2]), 0.0)
    broken = ~(np.isfinite(window.voltage_v) & np.isfinite(window.current_a) & np.isfinite(window.speed_rad_s))
    width = 2 * compute_filter_reach(settings.lowpass_hz, dt) + 1
    usable = erode_flags(moving & ~broken, width, beyond=False)
    return AlignedSignals(filtered[0], filtered[1], filtered[2], side, usable, broken)


def build_mechanical_regressors(window: Window, settings: Identification) -> Float:
    """Return the usable samples (m, 4) of [i, Dw, w, sign w] of a window, with or without a voltage."""
    silent = window if window.voltage_v is not None else replace(window, voltage_v=np.zeros(window.n))
    return build_regressors(align_signals(silent, settings), window.dt_s)[1]


def build_regressors(
    signals: AlignedSignals, dt_s: float, operator: DerivativeStencil = ZERO_FORCING_1
) -> tuple[Float, Float]:
    """Return the usable samples (m, 4) of [u, Di, i, w] and (m, 4) of [i, Dw, w, sign w]."""
    di, dw = differentiate_signal(signals.current, dt_s, operator), differentiate_signal(signals.speed, dt_s, operator)
    rows = signals.usable & np.isfinite(di) & np.isfinite(dw)
    electrical = np.column_stack([signals.voltage, di, signals.current, signals.speed])[rows]
    mechanical = np.column_stack([signals.current, dw, signals.speed, signals.side])[rows]
    return electrical, mechanical


def estimate(windows: Sequence[Window], settings: Identification) -> Estimate:
    """Fit [5] and [6] to the windows together."""
    windows = [align_speed_to_samples(w, settings.speed_source) for w in windows]
    parts = [build_regressors(align_signals(w, settings), w.dt_s) for w in windows if w.voltage_v is not None]
    parts = [p for p in parts if p[0].shape[0] > 0]
    rows = sum(p[0].shape[0] for p in parts)
    if rows < 8:
        return refuse_short_windows(NAME, rows)
    alias = estimate_aliasing_doubt(windows[0].voltage_sampling, windows[0].dt_s)
    return fit_two_steps(NAME, parts, *propagate_sensor_noise(windows, settings), alias)


def propagate_sensor_noise(windows: Sequence[Window], settings: Identification) -> tuple[Float, Float, Float]:
    """Return variances (3,) of voltage, current and speed, and the responses of low-pass and operator to one sample."""
    impulse = compute_impulse_response(settings.lowpass_hz, windows[0].dt_s)
    noise = np.mean([estimate_noise_levels(w).to_array() ** 2 for w in windows], axis=0)
    return noise, impulse, np.nan_to_num(differentiate_signal(impulse, windows[0].dt_s))


def refuse_short_windows(method: str, rows: int) -> Estimate:
    """Return the estimate for windows with hardly any sample in motion beyond the low-pass's reach."""
    text = f"only {rows} samples in motion lie beyond the low-pass's reach from standstill"
    reason = Reason("LowExcitation", text, "record a longer rapid or raise lowpass_hz")
    return create_empty_estimate(method, Result.UNDER_EXCITED, reason)


def fit_two_steps(
    method: str, parts: Sequence[tuple[Float, Float]], noise: Float, impulse: Float, slope: Float, alias: Float
) -> Estimate:
    """Fit [5], then [6] with its K, to samples (m, 4) of [u, Di, i, w] and of [i, Dw, w, sign w] per window.

    ``noise`` (3,) are the variances of voltage, current and speed; ``impulse`` and ``slope`` are the weights with which
    a noisy sample enters a signal and its derivative; ``alias`` (6,) is the doubt due to the voltage's sampling.
    """
    electrical, mechanical = (np.vstack([p[k] for p in parts]) for k in (0, 1))
    if not (np.isfinite(electrical).all() and np.isfinite(mechanical).all()):
        reason = Reason("NotFinite", "a filtered signal is not finite", "check the sensor")
        return create_empty_estimate(method, Result.NOT_FINITE, reason)
    theta, condition = solve_two_steps(electrical, mechanical)
    residual_u, residual_t = compute_residuals(theta, electrical, mechanical)
    noise = np.append(_estimate_voltage_variance(residual_u, theta, impulse, slope, noise), noise[1:])
    gammas = compute_residual_autocovariances(theta, impulse, slope, noise)
    covariance = compute_two_step_covariance(
        electrical, mechanical, (residual_u, residual_t), gammas, [p[0].shape[0] for p in parts]
    )
    bias = estimate_attenuation_bias(electrical, mechanical, theta, impulse, slope, noise)
    covariance += np.outer(bias, bias) + np.diag(np.square(OPEN_SHARE * theta))
    covariance += np.diag(np.square(alias[PARAMETER_ORDER] * theta))
    return build_two_step_estimate(method, theta, covariance, (residual_u, residual_t), condition, mechanical)


def solve_two_steps(electrical: Float, mechanical: Float) -> tuple[Float, float]:
    """Return [L, R, K, Jt, ft, Cd] (6,) by least squares on [5], then on [6], and the larger condition number."""
    first, condition_1 = solve_least_squares(electrical[:, 1:], electrical[:, 0])
    second, condition_2 = solve_least_squares(mechanical[:, 1:], mechanical[:, 0] * first[2])
    return np.concatenate([first, second]), max(condition_1, condition_2)


def compute_residuals(theta: Float, electrical: Float, mechanical: Float) -> tuple[Float, Float]:
    """Return the residuals of ``theta`` = [L, R, K, Jt, ft, Cd] in [5] (m,), V, and in K times [6] (m,), N.m."""
    torque = mechanical[:, 0] * theta[2]
    return electrical[:, 0] - electrical[:, 1:] @ theta[:3], torque - mechanical[:, 1:] @ theta[3:]


def build_two_step_estimate(
    method: str, theta: Float, covariance: Float, residuals: tuple[Float, Float], condition: float, mechanical: Float
) -> Estimate:
    """Return the estimate of ``theta`` = [L, R, K, Jt, ft, Cd] with its covariance (6, 6) in that order."""
    electrical, torque = residuals
    answer = Estimate(
        method=method,
        names=PARAMETERS,
        values=theta[PARAMETER_ORDER],
        covariance=covariance[np.ix_(PARAMETER_ORDER, PARAMETER_ORDER)],
        residuals={"electrical": electrical, "mechanical": torque / theta[2] if theta[2] else torque},
        result=Result.OK,
    )
    return withhold_unidentifiable(answer, condition, float(np.abs(mechanical[:, 2]).max()))


def _estimate_voltage_variance(residual_u: Float, theta: Float, impulse: Float, slope: Float, noise: Float) -> float:
    """Return the variance of the voltage's noise from the residual of [5]: the drive's own ripple is not noise."""
    silent = np.append(0.0, noise[1:])
    others = compute_residual_autocovariances(theta, impulse, slope, silent)[0][0].max()
    return max(float(np.mean(residual_u**2) - others) / float(impulse @ impulse), 1e-3 * float(noise[0]))


def estimate_raw_values(signals: Sequence[AlignedSignals], dt_s: Sequence[float]) -> Float | None:
    """Return [R, L, K, Jt, ft, Cd] (6,) as a start for other estimators; None with too few samples."""
    parts = [build_regressors(s, dt) for s, dt in zip(signals, dt_s, strict=True)]
    if sum(p[0].shape[0] for p in parts) < 8:
        return None
    electrical, mechanical = (np.vstack([p[k] for p in parts]) for k in (0, 1))
    if not (np.isfinite(electrical).all() and np.isfinite(mechanical).all()):
        return None
    return solve_two_steps(electrical, mechanical)[0][PARAMETER_ORDER]
