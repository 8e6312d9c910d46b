"""Several filters over one window in one pass, and the answer of one filter to several changes of the signals.

The filter of :mod:`fdhil.identification.innovations` waits at every row for the row before. Columns that differ in
parameters, noise or signals wait together: ten of them take little longer than one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numba import njit

from fdhil.identification.innovations import DIFFUSE, Gains
from fdhil.identification.motion import BROKEN, UNKNOWN, Motion
from fdhil.model.feed_drive import transition
from fdhil.records import Float

LOAD, VOLTAGE, CURRENT, SPEED = 0, 1, 2, 3  # what a course changes
LOG_ROWS = 16  # determinants, at most DIFFUSE^2 of the measurement's, that are multiplied before a logarithm is taken
NOTHING: Float = np.zeros((0, 0))


def _coefficients_plain(theta: Float, dt: float, unknown: bool) -> Float:
    """Return [phi (4), mean u to i and w, mean f to i and w, ramp u to i and w, walk to i] (11,) of an interval."""
    a = np.array([[-theta[0] / theta[1], -theta[2] / theta[1]], [theta[2] / theta[3], -theta[4] / theta[3]]])
    if unknown:
        a[1, :] = 0.0
    phi, mean, ramp = transition(a, dt)
    u = 1.0 / theta[1]
    out = np.empty(11)
    out[0], out[1], out[2], out[3] = phi[0, 0], phi[0, 1], phi[1, 0], phi[1, 1]
    out[4], out[5] = mean[0, 0] * u, mean[1, 0] * u
    out[6], out[7] = -mean[0, 1] / theta[3], -mean[1, 1] / theta[3]
    if unknown:  # there the friction torque is whatever keeps the speed on its walk
        out[6], out[7] = 0.0, 0.0
    out[8], out[9] = ramp[0, 0] * u, ramp[1, 0] * u
    out[10] = mean[0, 1] / dt
    return out


_coefficients: Callable[[Float, float, bool], Float] = njit(cache=True, nogil=True)(_coefficients_plain)


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
    """Return whitened innovations (n, 2, q) and log determinants (q,) for the columns of ``thetas`` (q, 7).

    ``variances`` (q, 3) as in the single filter; ``mean_v`` (q, n) or, when all columns share it, (1, n).
    """
    n, q = mode.size, thetas.shape[0]
    out = np.zeros((n, 2, q))
    logdet = np.zeros(q)
    moving, free = np.empty((11, q)), np.empty((11, q))
    for c in range(q):
        moving[:, c] = _coefficients(thetas[c], dt, False)
        free[:, c] = _coefficients(thetas[c], dt, True)
    friction, emf = thetas[:, 5].copy(), share * thetas[:, 2]
    vu, vi, vw = variances[:, 0].copy(), variances[:, 1].copy(), variances[:, 2].copy()
    p11, p12, p22 = DIFFUSE * vi, np.zeros(q), DIFFUSE * vw
    i, w = np.full(q, current[0]), np.full(q, speed[0])
    products, counted = np.ones(q), 0
    for k in range(n):
        if observed[k]:
            for c in range(q):
                s11, s12, s22 = p11[c] + vi[c], p12[c], p22[c] + vw[c]
                det = s11 * s22 - s12 * s12
                part = 1.0 / det
                g11, g12 = (p11[c] * s22 - s12 * s12) * part, s12 * vi[c] * part
                g21, g22 = s12 * vw[c] * part, (p22[c] * s11 - s12 * s12) * part
                e1, e2 = current[k] - i[c], speed[k] - w[c]
                out[k, 0, c] = e1 / np.sqrt(s11)
                out[k, 1, c] = (s11 * e2 - s12 * e1) * np.sqrt(part / s11)
                products[c] *= det / (vi[c] * vw[c])
                i[c] += g11 * e1 + g12 * e2
                w[c] += g21 * e1 + g22 * e2
                p11[c], p12[c], p22[c] = g11 * vi[c], g12 * vw[c], g22 * vw[c]
            counted += 1
            if counted % LOG_ROWS == 0:
                logdet += np.log(products)
                products[:] = 1.0
        if mode[k] == BROKEN:
            p11[:], p12[:], p22[:] = DIFFUSE * vi, 0.0, DIFFUSE * vw
            continue
        unknown = mode[k] == UNKNOWN
        h = free if unknown else moving
        v = walk if unknown else 0.0
        rise = rise_v[k] if rise_v.size else 0.0
        own = mean_v.shape[0] > 1
        for c in range(q):
            f00, f01, f10, f11 = h[0, c], h[1, c], h[2, c], h[3, c]
            q11, q12 = f00 * p11[c] + f01 * p12[c], f00 * p12[c] + f01 * p22[c]
            q21, q22 = f10 * p11[c] + f11 * p12[c], f10 * p12[c] + f11 * p22[c]
            b1, b2, v1 = h[4, c], h[5, c], h[10, c] * v
            p11[c] = q11 * f00 + q12 * f01 + b1 * b1 * vu[c] + v1 * v1
            p12[c] = q11 * f10 + q12 * f11 + b1 * b2 * vu[c] + v1 * v
            p22[c] = q21 * f10 + q22 * f11 + b2 * b2 * vu[c] + v * v
            u = mean_v[c, k] if own else mean_v[0, k]
            torque = friction[c] * mode[k]
            w_next = f10 * i[c] + f11 * w[c] + b2 * u + h[7, c] * torque
            r = rise + emf[c] * (w_next - w[c])
            i[c] = f00 * i[c] + f01 * w[c] + b1 * u + h[6, c] * torque + h[8, c] * r
            w[c] = w_next + h[9, c] * r
    return out, logdet + np.log(products) + counted * np.log(vi * vw)


_whiten: Callable[..., tuple[Float, Float]] = njit(cache=True, nogil=True, error_model="numpy")(_whiten_plain)


def whiten(motion: Motion, thetas: Float, variances: Float) -> tuple[Float, Float]:
    """Return the whitened innovations (2 n, q) for the rows of ``thetas`` (q, 7), each by its own filter.

    ``variances`` (q, 3) are those of voltage, current and speed; with them come the log determinants (q,). The
    window's voltage must come with its rows.
    """
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
        motion.current,
        motion.speed,
        motion.speed_walk,
    )
    return white.reshape(2 * motion.n, -1), logdet


def _answers_plain(
    theta: Float,
    dt: float,
    mode: Float,
    observed: Float,
    kind: int,
    course: Float,
    rise: Float,
    share: float,
    gains: Float,
    white: Float,
) -> Float:
    """Return the change (n, 2, q) of the innovations when one signal changes by the columns of ``course`` (n, q)."""
    n, q = course.shape
    out = np.zeros((n, 2, q))
    moving, free = _coefficients(theta, dt, False), _coefficients(theta, dt, True)
    emf = share * theta[2]
    on_f, on_u = 1.0 * (kind == LOAD), 1.0 * (kind == VOLTAGE)
    on_i, on_w = 1.0 * (kind == CURRENT), 1.0 * (kind == SPEED)
    i, w = on_i * course[0], on_w * course[0]
    for k in range(n):
        if observed[k]:
            g11, g12, g21, g22 = gains[k]
            w11, w21, w22 = white[k]
            for c in range(q):
                e1, e2 = on_i * course[k, c] - i[c], on_w * course[k, c] - w[c]
                out[k, 0, c] = w11 * e1
                out[k, 1, c] = w21 * e1 + w22 * e2
                i[c] += g11 * e1 + g12 * e2
                w[c] += g21 * e1 + g22 * e2
        if mode[k] == BROKEN:
            continue
        h = free if mode[k] == UNKNOWN else moving
        f00, f01, f10, f11, u0, u1, t0, t1, r0, r1, _ = h
        for c in range(q):
            u, torque = on_u * course[k, c], on_f * course[k, c]
            w_next = f10 * i[c] + f11 * w[c] + u1 * u + t1 * torque
            r = emf * (w_next - w[c])
            if rise.size:
                r += rise[k, c]
            i[c] = f00 * i[c] + f01 * w[c] + u0 * u + t0 * torque + r0 * r
            w[c] = w_next + r1 * r
    return out


_answers: Callable[..., Float] = njit(cache=True, nogil=True, error_model="numpy")(_answers_plain)


def answers(
    motion: Motion,
    theta: Float,
    gains: Gains,
    kind: int,
    courses: Sequence[Float],
    rises: Sequence[Float] | None = None,
) -> Float:
    """Return the change (2 n, q) of the innovations when a signal changes by each of ``courses`` (n,).

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
        np.column_stack(courses),
        NOTHING if means or rises is None else np.column_stack(rises),
        1.0 if means else 0.0,
        gains.gains,
        gains.whiteners,
    )
    return changed.reshape(2 * motion.n, -1)
