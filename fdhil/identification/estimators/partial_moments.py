"""Estimates by reinitialised partial moments [COI 93], the method that the paper compared with its own.

[1] is multiplied by the time since the start of a horizon T and integrated over it; by parts,

    int_0^T s x'(t + s) ds = T x(t + T) - int_0^T x(t + s) ds,

so no derivative and no initial state appears, and the integral itself is the low-pass. The horizon restarts at every
sample (the reinitialisation), and least squares is solved over all of them, as in [5] and [6].
"""

from collections.abc import Sequence

import numpy as np

from fdhil.config import Identification
from fdhil.identification.estimators.least_squares import fit_two_steps, refuse_short_windows
from fdhil.identification.prepared_motion import detect_motion, estimate_noise_levels
from fdhil.identification.rapid_windows import fill_forward
from fdhil.identification.robust_covariance import estimate_aliasing_doubt
from fdhil.identification.speed_alignment import align_speed_to_samples
from fdhil.records import Estimate, Float, VoltageSampling, Window

NAME = "partial_moments"
LEAST_STEPS = 8


def estimate(windows: Sequence[Window], settings: Identification) -> Estimate:
    """Fit [1], then [2] with its K, by partial moments over a horizon of one period of the low-pass's corner."""
    usable = [align_speed_to_samples(w, settings.speed_source) for w in windows if w.voltage_v is not None]
    parts = [compute_moments(w, count_horizon_steps(settings, w.dt_s)) for w in usable]
    if sum(p[0].shape[0] for p in parts) < 8:
        return refuse_short_windows(NAME, sum(p[0].shape[0] for p in parts))
    noise = np.mean([estimate_noise_levels(w).to_array() ** 2 for w in usable], axis=0)
    moment, slope = compute_moment_weights(count_horizon_steps(settings, usable[0].dt_s), usable[0].dt_s)
    alias = estimate_aliasing_doubt(usable[0].voltage_sampling, usable[0].dt_s)
    return fit_two_steps(NAME, [p for p in parts if p[0].shape[0]], noise, moment, slope, alias)


def count_horizon_steps(settings: Identification, dt_s: float) -> int:
    """Return the samples of a horizon: one period of the low-pass's corner, at least ``LEAST_STEPS``."""
    return max(LEAST_STEPS, round(1 / settings.lowpass_hz / dt_s))


def compute_moment_weights(steps: int, dt_s: float) -> tuple[Float, Float]:
    """Return the weights (steps + 1,) of the first moment and of the derivative's, over samples t .. t + T.

    Both are divided by T^2/2, so that the moment of a constant is that constant.
    """
    times: Float = np.linspace(0.0, steps * dt_s, steps + 1)
    horizon = steps * dt_s
    ends = np.ones(steps + 1)
    ends[0] = ends[-1] = 0.5
    moment = times * ends * dt_s
    slope = -ends * dt_s
    slope[-1] += horizon
    whole = 2 / horizon**2
    return moment * whole, slope * whole


def compute_voltage_weights(steps: int, dt_s: float, sampling: VoltageSampling) -> Float:
    """Return the weights (steps + 1,) of the voltage's moment: exact over each interval for interval means."""
    if sampling == "instant":
        return compute_moment_weights(steps, dt_s)[0]
    horizon = steps * dt_s
    weights: Float = np.linspace(0.5, steps + 0.5, steps + 1) * dt_s * dt_s * 2 / horizon**2
    weights[-1] = 0.0
    return weights


def compute_moments(window: Window, steps: int) -> tuple[Float, Float]:
    """Return the moments (m, 4) of [u, i', i, w] and of [i, w', w, sign w]."""
    assert window.voltage_v is not None
    dt = window.dt_s
    moment, slope = compute_moment_weights(steps, dt)
    over = compute_voltage_weights(steps, dt, window.voltage_sampling)
    current, speed = fill_forward(window.current_a), fill_forward(window.speed_rad_s)
    moving = detect_motion(window.speed_rad_s, window.rapid_speed_rad_s)
    known = np.isfinite(window.voltage_v) & np.isfinite(window.current_a) & np.isfinite(window.speed_rad_s)
    if window.n <= steps:
        return np.zeros((0, 4)), np.zeros((0, 4))
    usable = np.convolve(moving & known, np.ones(steps + 1), "valid")
    rows = np.flatnonzero(usable > steps + 0.5)

    def apply_weights(values: Float, weights: Float) -> Float:
        return np.correlate(values, weights, "valid")[rows]

    mean_current, mean_speed = apply_weights(current, moment), apply_weights(speed, moment)
    electrical = [
        apply_weights(fill_forward(window.voltage_v), over),
        apply_weights(current, slope),
        mean_current,
        mean_speed,
    ]
    mechanical = [mean_current, apply_weights(speed, slope), mean_speed, np.sign(mean_speed)]
    return np.column_stack(electrical), np.column_stack(mechanical)
