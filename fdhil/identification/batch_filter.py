"""Many filters over one window in one call, and the answer of one filter to many changes of the signals.

Derivatives by parameters and noise levels, and the directions of score tests, are wanted for several columns at once.
Here gain and innovation of a row are made together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numba import njit

from fdhil.identification.innovations import Gains
from fdhil.identification.motion import BROKEN, DIFFUSE, UNKNOWN, Motion
from fdhil.identification.slow_voltage import innovations_of
from fdhil.model.feed_drive import transition
from fdhil.records import Float, read_only

LOAD, VOLTAGE, CURRENT, SPEED = 0, 1, 2, 3  # what a course changes
LOG_ROWS = 16  # determinants, at most DIFFUSE^2 of the measurement's, that are multiplied before a logarithm is taken
NOTHING: Float = np.zeros((0, 0))


def _coefficients_plain(theta: Float, dt: float, unknown: bool, share: float) -> Float:
    """Return [phi (4), mean u to i and w, mean f to i and w, rise of u to i and w, walk to i] (11,) of an interval.

    ``share`` of the back-EMF's own rise over it, which is linear in the same quantities, is part of them.
    """
    a = np.array([[-theta[0] / theta[1], -theta[2] / theta[1]], [theta[2] / theta[3], -theta[4] / theta[3]]])
    if unknown:
        a[1, :] = 0.0
    phi, mean, ramp = transition(a, dt)
    u = 1.0 / theta[1]
    f = 0.0 if unknown else -1.0 / theta[3]  # there the friction torque is whatever keeps the speed on its walk
    to_i = np.array([phi[0, 0], phi[0, 1], mean[0, 0] * u, mean[0, 1] * f])
    to_w = np.array([phi[1, 0], phi[1, 1], mean[1, 0] * u, mean[1, 1] * f])
    rise = share * theta[2] * (to_w - np.array([0.0, 1.0, 0.0, 0.0]))
    to_i, to_w = to_i + ramp[0, 0] * u * rise, to_w + ramp[1, 0] * u * rise
    out = np.empty(11)
    out[0], out[1], out[4], out[6] = to_i[0], to_i[1], to_i[2], to_i[3]
    out[2], out[3], out[5], out[7] = to_w[0], to_w[1], to_w[2], to_w[3]
    out[8], out[9], out[10] = ramp[0, 0] * u, ramp[1, 0] * u, mean[0, 1] / dt
    return out


_coefficients: Callable[[Float, float, bool, float], Float] = njit(cache=True, nogil=True)(_coefficients_plain)


def _one_plain(
    theta: Float,
    variances: Float,
    dt: float,
    mode: Float,
    observed: Float,
    mean_v: Float,
    rise_v: Float,
    share: float,
    current: Float,
    speed: Float,
    walk: float,
    out: Float,
) -> float:
    """Fill ``out`` (n, 2) with the whitened innovations of one filter; return its log determinant."""
    moving, free = _coefficients(theta, dt, False, share), _coefficients(theta, dt, True, share)
    vu, vi, vw = variances
    unit = 1.0 / (vi * vw)
    p11, p12, p22 = DIFFUSE * vi, 0.0, DIFFUSE * vw
    i, w = current[0], speed[0]
    logdet, product, counted = 0.0, 1.0, 0
    for k in range(mode.size):
        if not observed[k]:
            out[k] = 0.0
        else:
            s11, s22 = p11 + vi, p22 + vw
            det = s11 * s22 - p12 * p12
            part = 1.0 / det
            e1, e2 = current[k] - i, speed[k] - w
            out[k, 0] = e1 / np.sqrt(s11)
            out[k, 1] = (s11 * e2 - p12 * e1) * np.sqrt(part / s11)
            g11, g12 = (p11 * s22 - p12 * p12) * part, p12 * vi * part
            g21, g22 = p12 * vw * part, (p22 * s11 - p12 * p12) * part
            i += g11 * e1 + g12 * e2
            w += g21 * e1 + g22 * e2
            p11, p12, p22 = g11 * vi, g12 * vw, g22 * vw
            product *= det * unit
            counted += 1
            if counted % LOG_ROWS == 0:
                logdet += np.log(product)
                product = 1.0
        if mode[k] == BROKEN:
            p11, p12, p22 = DIFFUSE * vi, 0.0, DIFFUSE * vw
            continue
        unknown = mode[k] == UNKNOWN
        f00, f01, f10, f11, b1, b2, t1, t2, r1, r2, v1 = free if unknown else moving
        q11, q12 = f00 * p11 + f01 * p12, f00 * p12 + f01 * p22
        q21, q22 = f10 * p11 + f11 * p12, f10 * p12 + f11 * p22
        own = walk if unknown else 0.0  # of the speed over the interval; it reaches the current through the back-EMF
        p11 = q11 * f00 + q12 * f01 + b1 * b1 * vu + v1 * v1 * own * own
        p12 = q11 * f10 + q12 * f11 + b1 * b2 * vu + v1 * own * own
        p22 = q21 * f10 + q22 * f11 + b2 * b2 * vu + own * own
        u, torque, r = mean_v[k], theta[5] * mode[k], rise_v[k] if rise_v.size else 0.0
        i, w = (
            f00 * i + f01 * w + (b1 * u + t1 * torque + r1 * r),
            f10 * i + f11 * w + (b2 * u + t2 * torque + r2 * r),
        )
    return float(logdet + np.log(product) - counted * np.log(unit))


_one: Callable[..., float] = njit(cache=True, nogil=True, error_model="numpy")(_one_plain)


def _whiten_plain(
    thetas: Float,
    variances: Float,
    dt: float,
    mode: Float,
    observed: Float,
    mean_v: Float,
    rise_v: Float,
    share: float,
    current: Float,
    speed: Float,
    walk: float,
) -> tuple[Float, Float]:
    """Return whitened innovations (q, n, 2) and log determinants (q,) for the rows of ``thetas`` (q, 7).

    ``variances`` (q, 3) as in the single filter; ``mean_v`` is (q, n) or, when all share it, (1, n).
    """
    n, q = mode.size, thetas.shape[0]
    out = np.empty((q, n, 2))
    logdet = np.zeros(q)
    for c in range(q):
        mean = mean_v[min(c, mean_v.shape[0] - 1)]
        logdet[c] = _one(thetas[c], variances[c], dt, mode, observed, mean, rise_v, share, current, speed, walk, out[c])
    return out, logdet


_whiten: Callable[..., tuple[Float, Float]] = njit(cache=True, nogil=True, error_model="numpy")(_whiten_plain)


def whiten(motion: Motion, thetas: Float, variances: Float) -> tuple[Float, Float]:
    """Return the whitened innovations (m, q) for the rows of ``thetas`` (q, 7), each by the filter made for it.

    ``variances`` (q, 3) are those of voltage, current and speed; with the innovations come the log determinants (q,).
    """
    if motion.slow is not None:
        return _whiten_slow(motion, thetas, variances)
    delays = thetas[:, 6]
    together = bool((delays == delays[0]).all())
    voltages = [motion.delayed(float(d)) for d in (delays[:1] if together else delays)]
    means = motion.voltage_sampling == "interval_mean"
    white, logdet = _whiten(
        thetas,
        variances,
        motion.dt_s,
        motion.mode,
        motion.observed,
        np.array(voltages),
        np.zeros(0) if means else motion.voltage_rise,
        1.0 if means else 0.0,
        read_only(motion.current),
        read_only(motion.speed),
        motion.speed_walk,
    )
    return white.reshape(len(thetas), -1).T, logdet


def _whiten_slow(motion: Motion, thetas: Float, variances: Float) -> tuple[Float, Float]:
    pairs = zip(thetas, variances, strict=True)
    made = [innovations_of(motion, theta, v, float(theta[6])) for theta, v in pairs]
    return np.column_stack([one.whitened for one in made]), np.array([one.logdet for one in made])


def _answer_plain(
    moving: Float,
    free: Float,
    kind: int,
    mode: Float,
    observed: Float,
    course: Float,
    rise: Float,
    gains: Float,
    white: Float,
    out: Float,
) -> None:
    """Fill ``out`` (n, 2) with the change of the innovations when one signal changes by ``course`` (n,)."""
    on_f, on_u = 1.0 * (kind == LOAD), 1.0 * (kind == VOLTAGE)
    on_i, on_w = 1.0 * (kind == CURRENT), 1.0 * (kind == SPEED)
    i, w = on_i * course[0], on_w * course[0]
    f00, f01, f10, f11, b1, b2, t1, t2, r1, r2, _ = moving
    last, begin = 1, 0
    while begin < mode.size and course[begin] == 0.0 and (rise.size == 0 or rise[begin] == 0.0):
        begin += 1
    out[:begin] = 0.0
    for k in range(begin, mode.size):
        if not observed[k]:
            out[k] = 0.0
        else:
            e1, e2 = on_i * course[k] - i, on_w * course[k] - w
            out[k, 0] = white[k, 0] * e1
            out[k, 1] = white[k, 1] * e1 + white[k, 2] * e2
            i += gains[k, 0] * e1 + gains[k, 1] * e2
            w += gains[k, 2] * e1 + gains[k, 3] * e2
        if mode[k] == BROKEN:
            continue
        if mode[k] != last:
            f00, f01, f10, f11, b1, b2, t1, t2, r1, r2, _ = free if mode[k] == UNKNOWN else moving
            last = mode[k]
        u, torque, r = on_u * course[k], on_f * course[k], rise[k] if rise.size else 0.0
        i, w = (
            f00 * i + f01 * w + (b1 * u + t1 * torque + r1 * r),
            f10 * i + f11 * w + (b2 * u + t2 * torque + r2 * r),
        )


_answer: Callable[..., None] = njit(cache=True, nogil=True, error_model="numpy")(_answer_plain)


def _answers_plain(
    theta: Float,
    dt: float,
    mode: Float,
    observed: Float,
    kind: int,
    courses: Float,
    rises: Float,
    share: float,
    gains: Float,
    white: Float,
) -> Float:
    """Return the change (q, n, 2) of the innovations when one signal changes by the rows of ``courses`` (q, n)."""
    moving, free = _coefficients(theta, dt, False, share), _coefficients(theta, dt, True, share)
    out = np.empty((courses.shape[0], mode.size, 2))
    none = np.zeros(0)
    for c in range(courses.shape[0]):
        rise = rises[c] if rises.size else none
        _answer(moving, free, kind, mode, observed, courses[c], rise, gains, white, out[c])
    return out


_answers: Callable[..., Float] = njit(cache=True, nogil=True, error_model="numpy")(_answers_plain)


def answers(
    motion: Motion,
    theta: Float,
    gains: Gains,
    kind: int,
    courses: Float | Sequence[Float],
    rises: Float | Sequence[Float] | None = None,
) -> Float:
    """Return the change (2 n, q) of the innovations when a signal changes by each of ``courses`` (q, n).

    ``kind`` names the signal: ``LOAD`` (N.m against the positive direction), ``VOLTAGE`` (V, over each interval with
    ``rises`` within them), ``CURRENT`` (A) or ``SPEED`` (rad/s). The innovations are linear in all of them. The
    window's voltage must come with its rows.
    """
    means = motion.voltage_sampling == "interval_mean"
    changed = _answers(
        theta,
        motion.dt_s,
        motion.mode,
        motion.observed,
        kind,
        np.asarray(courses),
        NOTHING if means or rises is None else np.asarray(rises),
        1.0 if means else 0.0,
        gains.gains,
        gains.whiteners,
    )
    return changed.reshape(len(courses), -1).T
