"""Kalman innovations of a window: what current and speed do that the model, driven by the measured voltage, does not.

With G the model's response from voltage to z = [i; w], the residual z - G u has covariance S_iw + G S_u G'. A Kalman
filter whose process noise is the voltage's noise through the drive whitens exactly that residual, sample by sample.
Where friction is not known (standstill, reversal) the speed is a random walk and only the electrical equation speaks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from fdhil.identification import slow_voltage
from fdhil.identification.motion import BROKEN, DIFFUSE, UNKNOWN, Motion, Noise
from fdhil.model.feed_drive import transition
from fdhil.records import Float, Parameters, read_only

NOTHING: Float = np.zeros(0)


def _matrix_plain(theta: Float) -> Float:
    """Return A (2, 2) for ``theta`` = [R, L, K, Jt, ft, Cd, ...]."""
    return np.array([[-theta[0] / theta[1], -theta[2] / theta[1]], [theta[2] / theta[3], -theta[4] / theta[3]]])


_matrix: Callable[[Float], Float] = njit(cache=True, nogil=True)(_matrix_plain)


def _gains_plain(
    theta: Float, dt: float, mode: Float, observed: Float, noise: Float, walk: float
) -> tuple[Float, Float, float]:
    """Return the gains (n, 4) and whiteners (n, 3) of the filter, and the log determinant of the innovations.

    ``noise`` = variances of voltage, current, speed; a whitener is [w11, w21, w22].
    """
    n = mode.size
    a = _matrix(theta)
    lever = np.array([1 / theta[1], 1 / theta[3]])
    gains = np.zeros((n, 4))
    white = np.zeros((n, 3))
    logdet = 0.0
    free = a.copy()
    free[1, :] = 0.0
    phi_m, mean_m, _ = transition(a, dt)
    phi_u, mean_u, _ = transition(free, dt)
    p11, p12, p22 = DIFFUSE * noise[1], 0.0, DIFFUSE * noise[2]
    for k in range(n):
        if observed[k]:
            s11, s12, s22 = p11 + noise[1], p12, p22 + noise[2]
            det = s11 * s22 - s12 * s12
            g11, g12 = (p11 * s22 - p12 * s12) / det, (p12 * s11 - p11 * s12) / det
            g21, g22 = (p12 * s22 - p22 * s12) / det, (p22 * s11 - p12 * s12) / det
            gains[k, 0], gains[k, 1], gains[k, 2], gains[k, 3] = g11, g12, g21, g22
            c11 = np.sqrt(s11)
            c21 = s12 / c11
            c22 = np.sqrt(s22 - c21 * c21)
            white[k, 0], white[k, 1], white[k, 2] = 1.0 / c11, -c21 / (c11 * c22), 1.0 / c22
            logdet += np.log(det)
            p11, p12, p22 = g11 * noise[1], g12 * noise[2], g22 * noise[2]
        if mode[k] == BROKEN:
            p11, p12, p22 = DIFFUSE * noise[1], 0.0, DIFFUSE * noise[2]
            continue
        unknown = mode[k] == UNKNOWN
        phi = phi_u if unknown else phi_m
        b = mean_u if unknown else mean_m
        b1, b2 = b[0, 0] * lever[0], b[1, 0] * lever[0]
        q11 = phi[0, 0] * p11 + phi[0, 1] * p12
        q12 = phi[0, 0] * p12 + phi[0, 1] * p22
        q21 = phi[1, 0] * p11 + phi[1, 1] * p12
        q22 = phi[1, 0] * p12 + phi[1, 1] * p22
        p11 = q11 * phi[0, 0] + q12 * phi[0, 1] + b1 * b1 * noise[0]
        p12 = q11 * phi[1, 0] + q12 * phi[1, 1] + b1 * b2 * noise[0]
        p22 = q21 * phi[1, 0] + q22 * phi[1, 1] + b2 * b2 * noise[0]
        if unknown:
            # the walk of the speed over the interval reaches the current through the back-EMF
            v1, v2 = mean_u[0, 1] / dt * walk, walk
            p11 += v1 * v1
            p12 += v1 * v2
            p22 += v2 * v2
    return gains, white, logdet


_gains: Callable[..., tuple[Float, Float, float]] = njit(cache=True, nogil=True)(_gains_plain)


def _residuals_plain(
    theta: Float,
    dt: float,
    mode: Float,
    observed: Float,
    mean_v: Float,
    rise_v: Float,
    share: float,
    load: Float,
    current: Float,
    speed: Float,
    gains: Float,
    white: Float,
) -> Float:
    """Return the whitened innovations (n, 2); 0 where nothing was measured.

    ``share`` of the back-EMF's rise over an interval is added to ``rise_v``; an empty array is all 0.
    """
    n = mode.size
    out = np.zeros((n, 2))
    a = _matrix(theta)
    lever = np.array([1 / theta[1], 1 / theta[3]])
    friction, emf = theta[5], share * theta[2]
    free = a.copy()
    free[1, :] = 0.0
    phi_m, mean_m, ramp_m = transition(a, dt)
    phi_u, mean_u, ramp_u = transition(free, dt)
    i, w = current[0], speed[0]
    for k in range(n):
        if observed[k]:
            e1, e2 = current[k] - i, speed[k] - w
            out[k, 0] = white[k, 0] * e1
            out[k, 1] = white[k, 1] * e1 + white[k, 2] * e2
            i += gains[k, 0] * e1 + gains[k, 1] * e2
            w += gains[k, 2] * e1 + gains[k, 3] * e2
        if mode[k] == BROKEN:
            continue
        u = lever[0] * mean_v[k]
        r = lever[0] * rise_v[k] if rise_v.size else 0.0
        if mode[k] == UNKNOWN:
            i = phi_u[0, 0] * i + phi_u[0, 1] * w + mean_u[0, 0] * u + ramp_u[0, 0] * r
            continue
        f = -lever[1] * (friction * mode[k] + (load[k] if load.size else 0.0))
        w_next = phi_m[1, 0] * i + phi_m[1, 1] * w + mean_m[1, 0] * u + mean_m[1, 1] * f
        r += lever[0] * emf * (w_next - w)
        i = phi_m[0, 0] * i + phi_m[0, 1] * w + mean_m[0, 0] * u + mean_m[0, 1] * f + ramp_m[0, 0] * r
        w = w_next + ramp_m[1, 0] * r
    return out


_residuals: Callable[..., Float] = njit(cache=True, nogil=True)(_residuals_plain)


@dataclass(frozen=True, slots=True)
class Gains:
    """The filter's gains (n, 4), whiteners (n, 3), and log determinant, for fixed parameters and noise.

    With a slow voltage the filter is made anew from the noise's ``variances`` (3,), and the rest is empty.
    """

    gains: Float
    whiteners: Float
    logdet: float
    variances: Float = field(default_factory=lambda: np.zeros(0))


def gains_of(motion: Motion, theta: Float, noise: Noise) -> Gains:
    """Return the filter's gains for ``theta`` (7,) = [R, L, K, Jt, ft, Cd, delay]."""
    variances = noise.vector() ** 2
    if motion.slow is not None:
        made = slow_voltage.innovations_of(motion, theta, variances, float(theta[6]))
        return Gains(NOTHING, NOTHING, made.logdet, variances)
    return Gains(*_gains(theta, motion.dt_s, motion.mode, motion.observed, variances, motion.speed_walk))


def innovations(
    motion: Motion,
    theta: Float,
    gains: Gains,
    delay_s: float = 0.0,
    load_nm: Float | None = None,
    emf_share: float = 1.0,
) -> Float:
    """Return the whitened innovations (2 n,) of current and speed row by row.

    Those of the samples of a slow voltage (m,) follow them. All are white, of unit variance, in a right model.

    ``load_nm`` (n,) is a torque against the positive direction over each interval (none when left out). Of the course
    of an interval mean within its sample only the back-EMF's ramp is certain (``emf_share`` of it is taken): what the
    current regulator adds depends on the drive, and to take it from neighbouring means biases L.
    """
    if motion.slow is not None:
        late = np.append(theta[:6], delay_s)
        made = slow_voltage.innovations_of(motion, late, gains.variances, delay_s, load_nm)
        return made.whitened
    load = NOTHING if load_nm is None else load_nm
    means = motion.voltage_sampling == "interval_mean"
    return _residuals(
        theta,
        motion.dt_s,
        motion.mode,
        motion.observed,
        read_only(motion.delayed(delay_s)),
        NOTHING if means else motion.voltage_rise,
        emf_share if means else emf_share - 1.0,
        load,
        read_only(motion.current),
        read_only(motion.speed),
        gains.gains,
        gains.whiteners,
    ).ravel()


def vector_of(parameters: Parameters) -> Float:
    """Return [R, L, K, Jt, ft, Cd] (6,)."""
    return np.array(list(parameters.as_dict().values()))
