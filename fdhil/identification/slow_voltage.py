"""Innovations of a window whose voltage comes from a sensor slower than the drive: one row per voltage sample.

The voltage is never brought to the drive's grid. A Kalman filter runs over the drive's rows with the state
[i, w, di/dt, int i, int w, i at the start of the running voltage sample]: [2] drives the speed from the current, the
current's slope is a random walk, and each voltage sample is one more measurement, of [1] integrated over its interval

    mean u = (R int i dt + L (i(end) - i(start)) + K int w dt) / T,    or at its instant    u = R i + L di/dt + K w.

The innovations are orthogonal to the past, so Gauss-Newton steps with the filter held fixed solve an unbiased
estimating equation here too. A delay of the voltage moves its intervals among the rows: it is a parameter like others.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from numba import njit

from fdhil.records import Float, SlowVoltage, VoltageSampling

DIFFUSE = 1e6  # variance, in units of the measurement's, of a state about which nothing is known
UNKNOWN = 0  # the mode in which friction is not known
STATES = 6
# kinds of events
ROW, BOUNDARY, INSTANT = range(3)
NO_SAMPLE = -1

Events = npt.NDArray[np.int64]


def events_of(
    slow: SlowVoltage, sampling: VoltageSampling, n: int, dt_s: float, delay_s: float
) -> tuple[Events, Float]:
    """Return events (e, 3) of [kind, row, voltage sample that ends there] in order of time, and their times (e,).

    A boundary ends the sample it names (none: -1) and begins the next; samples that are not wholly inside are left out.
    """
    last = (n - 1) * dt_s
    m = slow.voltage_v.size
    begins = slow.begin_s - delay_s + slow.period_s * np.arange(m + 1)
    rows = np.column_stack([np.full(n, ROW), np.arange(n), np.full(n, NO_SAMPLE)])
    if sampling == "instant":
        inside = np.flatnonzero((begins[:m] >= 0) & (begins[:m] <= last) & np.isfinite(slow.voltage_v))
        marks = np.column_stack([np.full(inside.size, INSTANT), np.zeros(inside.size, int), inside])
    else:
        inside = np.flatnonzero((begins >= 0) & (begins <= last))
        ends = inside - 1
        known = (ends >= 0) & (inside > inside.min(initial=m))
        known &= np.isfinite(slow.voltage_v[np.maximum(ends, 0)])
        marks = np.column_stack([np.full(inside.size, BOUNDARY), np.zeros(inside.size, int), ends])
        marks[~known, 2] = NO_SAMPLE
    times = np.concatenate([np.arange(n) * dt_s, begins[inside]])
    order = np.argsort(times, kind="stable")
    return np.concatenate([rows, marks]).astype(np.int64)[order], times[order]


def _row_of_plain(theta: Float, kind: int, period: float) -> Float:
    """Return how a voltage sample measures the state (6,)."""
    h = np.zeros(STATES)
    if kind == INSTANT:
        h[0], h[1], h[2] = theta[0], theta[2], theta[1]
    else:
        h[0], h[3], h[4], h[5] = theta[1] / period, theta[0] / period, theta[2] / period, -theta[1] / period
    return h


_row_of: Callable[[Float, int, float], Float] = njit(cache=True, nogil=True)(_row_of_plain)


def _advance_plain(theta: Float, h: float, moves: bool) -> Float:
    """Return the transition (6, 6) over ``h``; the terms of third order in h ft/Jt are left out: they are nil."""
    f = np.eye(STATES)
    f[0, 2] = h
    f[3, 0], f[3, 2] = h, h * h / 2
    f[4, 1] = h
    if moves:
        pull, drag = theta[2] / theta[3], theta[4] / theta[3]
        f[1, 0] = pull * (h - drag * h * h / 2)
        f[1, 1] = 1 - drag * h + drag * drag * h * h / 2
        f[1, 2] = pull * h * h / 2
        f[4, 0] = pull * h * h / 2
        f[4, 1] = h - drag * h * h / 2
        f[4, 2] = pull * h * h * h / 6
    return f


_advance: Callable[[Float, float, bool], Float] = njit(cache=True, nogil=True)(_advance_plain)


def _spread_plain(p: Float, f: Float) -> Float:
    """Return F P F' (6, 6)."""
    half = np.zeros((STATES, STATES))
    out = np.zeros((STATES, STATES))
    for a in range(STATES):
        for b in range(STATES):
            total = 0.0
            for c in range(STATES):
                if f[a, c] != 0.0:
                    total += f[a, c] * p[c, b]
            half[a, b] = total
    for a in range(STATES):
        for b in range(STATES):
            total = 0.0
            for c in range(STATES):
                if f[b, c] != 0.0:
                    total += half[a, c] * f[b, c]
            out[a, b] = total
    return (out + out.T) / 2  # rounding must not make it lopsided: that grows


_spread: Callable[[Float, Float], Float] = njit(cache=True, nogil=True)(_spread_plain)


def _gains_plain(
    theta: Float,
    dt: float,
    mode: Float,
    observed: Float,
    noise: Float,
    speed_walk: float,
    slope_walk: float,
    period: float,
    events: Events,
    times: Float,
) -> tuple[Float, Float, float]:
    """Return the gains (e, 12) and whiteners (e, 3) of the filter at its events, and the log determinant.

    ``noise`` = variances of voltage, current, speed; ``slope_walk`` is the variance of di/dt per second, (A/s)^2/s.
    """
    count = events.shape[0]
    gains = np.zeros((count, 2 * STATES))
    white = np.zeros((count, 3))
    logdet = 0.0
    p = np.zeros((STATES, STATES))
    p[0, 0], p[1, 1] = DIFFUSE * noise[1], DIFFUSE * noise[2]
    p[2, 2] = DIFFUSE * noise[1] / (dt * dt)
    k, now = 0, times[0]
    for e in range(count):
        h = times[e] - now
        now = times[e]
        if h > 0.0:
            p = _spread(p, _advance(theta, h, mode[k] != UNKNOWN))
            p[0, 0] += slope_walk * h * h * h / 3
            p[2, 2] += slope_walk * h
            p[3, 3] += slope_walk * h**5 / 20
            p[0, 2] += slope_walk * h * h / 2
            p[2, 0] = p[0, 2]
            p[0, 3] += slope_walk * h**4 / 8
            p[3, 0] = p[0, 3]
            p[2, 3] += slope_walk * h**3 / 6
            p[3, 2] = p[2, 3]
            if mode[k] == UNKNOWN:
                p[1, 1] += speed_walk * speed_walk * h / dt
        if events[e, 0] == ROW:
            k = events[e, 1]
            if not observed[k]:
                continue
            s11, s12, s22 = p[0, 0] + noise[1], p[0, 1], p[1, 1] + noise[2]
            det = s11 * s22 - s12 * s12
            c11 = np.sqrt(s11)
            c21 = s12 / c11
            c22 = np.sqrt(det / s11)
            white[e, 0], white[e, 1], white[e, 2] = 1.0 / c11, -c21 / (c11 * c22), 1.0 / c22
            logdet += np.log(det)
            keep = np.eye(STATES)
            for a in range(STATES):
                gains[e, a] = (p[a, 0] * s22 - p[a, 1] * s12) / det
                gains[e, STATES + a] = (p[a, 1] * s11 - p[a, 0] * s12) / det
                keep[a, 0] -= gains[e, a]
                keep[a, 1] -= gains[e, STATES + a]
            p = _spread(p, keep)  # Joseph's form, which rounding cannot make negative
            for a in range(STATES):
                for b in range(STATES):
                    p[a, b] += noise[1] * gains[e, a] * gains[e, b]
                    p[a, b] += noise[2] * gains[e, STATES + a] * gains[e, STATES + b]
            continue
        if events[e, 2] != NO_SAMPLE:
            measured = _row_of(theta, events[e, 0], period)
            seen = np.zeros(STATES)
            variance = noise[0]
            for a in range(STATES):
                for b in range(STATES):
                    seen[a] += p[a, b] * measured[b]
                variance += measured[a] * seen[a]
            white[e, 0] = 1.0 / np.sqrt(variance)
            logdet += np.log(variance)
            for a in range(STATES):
                gains[e, a] = seen[a] / variance
            for a in range(STATES):
                for b in range(STATES):
                    p[a, b] -= seen[a] * seen[b] / variance
        if events[e, 0] == BOUNDARY:
            for a in range(STATES):
                p[3, a] = p[a, 3] = p[4, a] = p[a, 4] = 0.0
            for a in range(STATES):
                p[5, a] = p[a, 5] = p[0, a]
            p[5, 5] = p[0, 0]
    return gains, white, logdet


gains: Callable[..., tuple[Float, Float, float]] = njit(cache=True, nogil=True)(_gains_plain)


def _residuals_plain(
    theta: Float,
    mode: Float,
    observed: Float,
    load: Float,
    current: Float,
    speed: Float,
    voltage: Float,
    period: float,
    events: Events,
    times: Float,
    late: float,
    gain: Float,
    white: Float,
) -> Float:
    """Return the whitened innovations: (2 n) of current and speed, row by row, then (m,) of the voltage samples.

    ``late`` is by how much (s) the voltage comes later than the events were made for: their order is kept.
    """
    n = current.size
    out = np.zeros(2 * n + voltage.size)
    inertia, viscous, dry, constant = theta[3], theta[4], theta[5], theta[2]
    i, w, s, charge, angle, began = current[0], speed[0], 0.0, 0.0, 0.0, current[0]
    k, now = 0, times[0]
    for e in range(events.shape[0]):
        kind = events[e, 0]
        at = times[e] if kind == ROW else times[e] - late
        h = at - now
        now = at
        if h != 0.0:
            charge += i * h + s * h * h / 2
            if mode[k] == UNKNOWN:
                angle += w * h
            else:
                torque = constant * i - viscous * w - dry * mode[k] - (load[k] if load.size else 0.0)
                a = torque / inertia
                b = (constant * s - viscous * a) / inertia
                angle += w * h + a * h * h / 2 + b * h * h * h / 6
                w += a * h + b * h * h / 2
            i += s * h
        if kind == ROW:
            k = events[e, 1]
            if observed[k]:
                e1, e2 = current[k] - i, speed[k] - w
                out[2 * k] = white[e, 0] * e1
                out[2 * k + 1] = white[e, 1] * e1 + white[e, 2] * e2
                i += gain[e, 0] * e1 + gain[e, 6] * e2
                w += gain[e, 1] * e1 + gain[e, 7] * e2
                s += gain[e, 2] * e1 + gain[e, 8] * e2
                charge += gain[e, 3] * e1 + gain[e, 9] * e2
                angle += gain[e, 4] * e1 + gain[e, 10] * e2
                began += gain[e, 5] * e1 + gain[e, 11] * e2
            continue
        j = events[e, 2]
        if j != NO_SAMPLE:
            if kind == INSTANT:
                e1 = voltage[j] - (theta[0] * i + theta[1] * s + constant * w)
            else:
                e1 = voltage[j] - (theta[0] * charge + theta[1] * (i - began) + constant * angle) / period
            out[2 * n + j] = white[e, 0] * e1
            i += gain[e, 0] * e1
            w += gain[e, 1] * e1
            s += gain[e, 2] * e1
        if kind == BOUNDARY:
            charge, angle, began = 0.0, 0.0, i
    return out


residuals: Callable[..., Float] = njit(cache=True, nogil=True)(_residuals_plain)
