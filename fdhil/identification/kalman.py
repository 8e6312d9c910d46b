"""Compiled Kalman filters over a window's samples, with named entries.

Three filters share the drive's equations [1] and [2]. The whitening filter takes the noisy voltage of each interval as
an input: with G the model's response from voltage to z = [i; w], the residual z - G u has covariance S_iw + G S_u G',
and a filter whose process noise is the voltage's noise through the drive whitens exactly that residual. The low-rate
filter takes the samples of a slower sensor as measurements; the departure filter takes the voltage as a random walk.
Where friction is unknown (standstill, reversal) the speed is a random walk, and only [1] applies.

Two states and one input are written out: calling a matrix library would take longer than the sums.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fdhil.identification.prepared_motion import BROKEN_MODE, DIFFUSE, UNKNOWN_MODE, Modes, Motion
from fdhil.model import compile_kernel, compute_transition
from fdhil.records import Bool, Float, make_read_only_view

Rows = npt.NDArray[np.int64]

R, L, K, JT, FT, CD, DELAY = range(7)  # entries of theta
OF_VOLTAGE, OF_CURRENT, OF_SPEED = range(3)  # entries of noise variances
LOAD, VOLTAGE, CURRENT, SPEED = range(4)  # signals that drive the filter
# columns of an interval's transition: current and speed from those at its begin, from the mean voltage, from friction
# and load together, from the voltage's rise within it; and the effect of a walk of the speed on the current
I_I, I_W, W_I, W_W, I_U, W_U, I_T, W_T, I_RISE, W_RISE, I_WALK = range(11)
# columns of a sample's gains: from the innovations of current and speed to their states, and to whitened innovations
G_II, G_IW, G_WI, G_WW, WHITE_I, WHITE_IW, WHITE_W = range(7)
STATE_I, STATE_W, STATE_SLOPE, STATE_SUM = range(4)  # of the filter with a low-rate voltage
STATE_U = 2  # of the filter with a random-walk voltage
STATES = 4
NO_SAMPLE = -1
SETTLED, SETTLED_ROWS = 1e-12, 4  # relative change of a gain per sample, and how often: then it is constant
LOG_ROWS = 16  # determinants, at most DIFFUSE^2 of the measurement's, multiplied per logarithm


class Readings(NamedTuple):
    """The samples (n,) of a window as the filters take them; ``mode`` and ``observed`` as in the prepared window.

    ``emf_share`` of the back-EMF's rise within an interval is used, in addition to the voltage's own ``rise_v``, which
    may be empty; ``walk`` is the standard deviation of the speed's change over an interval of unknown friction.
    """

    dt_s: float
    mode: Modes
    observed: Bool
    current: Float
    speed: Float
    rise_v: Float
    emf_share: float
    walk: float

    @classmethod
    def from_motion(cls, motion: Motion, emf_share: float = 1.0) -> Readings:
        """Return the readings of a prepared window.

        Within an interval mean only the back-EMF's ramp is certain: the regulator's part depends on the drive, and
        taking it from neighbouring means would bias L.
        """
        means = motion.voltage_sampling == "interval_mean"
        rise_v, share = (np.zeros(0), emf_share) if means else (motion.voltage_rise, emf_share - 1.0)
        current, speed = make_read_only_view(motion.current), make_read_only_view(motion.speed)
        return cls(motion.dt_s, motion.mode, motion.observed, current, speed, rise_v, share, motion.speed_walk)


class SampleMarks(NamedTuple):
    """Where the samples of a low-rate voltage begin and end among the drive's samples, in order of time (b,).

    Mark b follows the drive's sample ``row``, at ``time_s``; there the voltage sample ``sample`` ends (-1: none
    complete) and the next begins. Instants are marks that begin no sample.
    """

    row: Rows
    sample: Rows
    time_s: Float


class SlowSensor(NamedTuple):
    """The samples (m,) of a low-rate voltage, means over ``period_s`` or instants, and ``shape_variance`` (m,)."""

    voltage: Float
    instant: bool
    period_s: float
    shape_variance: Float
    marks: SampleMarks


@compile_kernel
def compute_interval_steps(theta: Float, dt: float, emf_share: float) -> Float:
    """Return the transition coefficients (2, 11) over an interval of unknown friction, and of known friction.

    They include ``emf_share`` of the back-EMF's rise over the interval, which is linear in the same quantities.
    """
    steps = np.empty((2, 11))
    for known in range(2):
        a = np.array([[-theta[R] / theta[L], -theta[K] / theta[L]], [theta[K] / theta[JT], -theta[FT] / theta[JT]]])
        if not known:
            a[1, :] = 0.0
        phi, mean, ramp = compute_transition(a, dt)
        u = 1.0 / theta[L]
        f = -1.0 / theta[JT] if known else 0.0  # else the speed is a random walk, whatever the friction
        to_i = np.array([phi[0, 0], phi[0, 1], mean[0, 0] * u, mean[0, 1] * f])
        to_w = np.array([phi[1, 0], phi[1, 1], mean[1, 0] * u, mean[1, 1] * f])
        rise = emf_share * theta[K] * (to_w - np.array([0.0, 1.0, 0.0, 0.0]))
        to_i, to_w = to_i + ramp[0, 0] * u * rise, to_w + ramp[1, 0] * u * rise
        step = steps[known]
        step[I_I], step[I_W], step[I_U], step[I_T] = to_i
        step[W_I], step[W_W], step[W_U], step[W_T] = to_w
        step[I_RISE], step[W_RISE], step[I_WALK] = ramp[0, 0] * u, ramp[1, 0] * u, mean[0, 1] / dt
    return steps


@compile_kernel
def _propagate_state(
    steps: Float, known: int, i: float, w: float, u: float, torque: float, rise: float
) -> tuple[float, float]:
    s = steps[known]
    return (
        s[I_I] * i + s[I_W] * w + (s[I_U] * u + s[I_T] * torque + s[I_RISE] * rise),
        s[W_I] * i + s[W_W] * w + (s[W_U] * u + s[W_T] * torque + s[W_RISE] * rise),
    )


@compile_kernel
def _propagate_covariance(
    steps: Float, known: int, p11: float, p12: float, p22: float, vu: float, walk: float
) -> tuple[float, float, float]:
    """Return variance of current, covariance, and variance of speed at the end of an interval.

    ``vu`` is the voltage's variance; the speed's own ``walk`` reaches the current through the back-EMF.
    """
    s = steps[known]
    q11, q12 = s[I_I] * p11 + s[I_W] * p12, s[I_I] * p12 + s[I_W] * p22
    q21, q22 = s[W_I] * p11 + s[W_W] * p12, s[W_I] * p12 + s[W_W] * p22
    b1, b2, v1 = s[I_U], s[W_U], s[I_WALK]
    return (
        q11 * s[I_I] + q12 * s[I_W] + b1 * b1 * vu + v1 * v1 * walk * walk,
        q11 * s[W_I] + q12 * s[W_W] + b1 * b2 * vu + v1 * walk * walk,
        q21 * s[W_I] + q22 * s[W_W] + b2 * b2 * vu + walk * walk,
    )


@compile_kernel
def _whiten_window(
    theta: Float, variances: Float, readings: Readings, mean_v: Float, load: Float, white: Float, gains: Float
) -> float:
    """Fill ``white`` (n, 2), and ``gains`` (n, 7) unless it is empty; return the innovations' log determinant."""
    steps = compute_interval_steps(theta, readings.dt_s, readings.emf_share)
    mode, observed, rise_v = readings.mode, readings.observed, readings.rise_v
    current, speed = readings.current, readings.speed
    vu, vi, vw = variances
    unit = 1.0 / (vi * vw)
    p11, p12, p22 = DIFFUSE * vi, 0.0, DIFFUSE * vw
    i, w = current[0], speed[0]
    logdet, product, counted, still = 0.0, 1.0, 0, 0
    s11 = det = scale = root = g11 = g12 = g21 = g22 = before = 1.0
    known = -1
    for k in range(mode.size):
        if not observed[k]:
            white[k], still = 0.0, 0
        else:
            if still < SETTLED_ROWS:
                s11, s22 = p11 + vi, p22 + vw
                det = s11 * s22 - p12 * p12
                part = 1.0 / det
                scale, root = 1.0 / np.sqrt(s11), np.sqrt(part / s11)
                g11, g12 = (p11 * s22 - p12 * p12) * part, p12 * vi * part
                g21, g22 = p12 * vw * part, (p22 * s11 - p12 * p12) * part
                still = still + 1 if abs(g11 + g22 - before) <= SETTLED * before else 0
                before = g11 + g22
                white_iw, white_w = -p12 * root, s11 * root
            e1, e2 = current[k] - i, speed[k] - w
            white[k, 0] = e1 * scale
            white[k, 1] = white_w * e2 + white_iw * e1
            if gains.size:
                gains[k, G_II], gains[k, G_IW], gains[k, G_WI], gains[k, G_WW] = g11, g12, g21, g22
                gains[k, WHITE_I], gains[k, WHITE_IW], gains[k, WHITE_W] = scale, white_iw, white_w
            i += g11 * e1 + g12 * e2
            w += g21 * e1 + g22 * e2
            product *= det * unit
            counted += 1
            if counted % LOG_ROWS == 0:
                logdet += np.log(product)
                product = 1.0
        if mode[k] == BROKEN_MODE:
            p11, p12, p22, still = DIFFUSE * vi, 0.0, DIFFUSE * vw, 0
            continue
        was, known = known, 0 if mode[k] == UNKNOWN_MODE else 1
        if known != was:
            still = 0
        if still < SETTLED_ROWS:  # else the gains are constant
            if observed[k]:
                p11, p12, p22 = g11 * vi, g12 * vw, g22 * vw
            p11, p12, p22 = _propagate_covariance(steps, known, p11, p12, p22, vu, 0.0 if known else readings.walk)
        rise = rise_v[k] if rise_v.size else 0.0
        i, w = _propagate_state(steps, known, i, w, mean_v[k], load[k], rise)
    return float(logdet + np.log(product) - counted * np.log(unit))


@compile_kernel
def whiten_for_parameters(
    thetas: Float, variances: Float, readings: Readings, mean_v: Float, loads: Float, gains: Float
) -> tuple[Float, Float]:
    """Return whitened innovations (q, n, 2) and log determinants (q,) for the rows of ``thetas`` (q, 7).

    ``variances`` (q, 3) are those of voltage, current and speed; ``mean_v`` and ``loads``, the total torque against the
    positive direction, are (q, n), or (1, n) where shared. ``gains`` (n, 7) receives the last filter's gains, unless
    empty.
    """
    q = thetas.shape[0]
    white = np.empty((q, readings.mode.size, 2))
    logdet = np.zeros(q)
    for c in range(q):
        mean, load = mean_v[min(c, mean_v.shape[0] - 1)], loads[min(c, loads.shape[0] - 1)]
        logdet[c] = _whiten_window(thetas[c], variances[c], readings, mean, load, white[c], gains)
    return white, logdet


@compile_kernel
def compute_filter_response(
    theta: Float, readings: Readings, signals: Float, kind: int, courses: Float, rises: Float, gains: Float
) -> Float:
    """Return the whitened innovations (n, 2, q) by the filter of ``gains`` (n, 7), linear in all signals.

    The signal ``kind`` of ``signals`` (4, n) is replaced by each of ``courses`` (q, n), with ``rises`` (q, n) of the
    voltage within the intervals, or none. The load is friction and all other torque against the positive direction.
    """
    steps, q = compute_interval_steps(theta, readings.dt_s, readings.emf_share), len(courses)
    mode, observed = readings.mode, readings.observed
    white, course, rise = np.empty((mode.size, 2, q)), np.ascontiguousarray(courses.T), np.zeros(q)
    risen = np.ascontiguousarray(rises.T)
    share = np.zeros(4)
    share[kind], signals[kind] = 1.0, 0.0
    i, w = signals[CURRENT, 0] + share[CURRENT] * course[0], signals[SPEED, 0] + share[SPEED] * course[0]
    for k in range(mode.size):
        gain = gains[k]
        if not observed[k]:
            white[k] = 0.0
        else:
            for c in range(q):
                e1 = signals[CURRENT, k] + share[CURRENT] * course[k, c] - i[c]
                e2 = signals[SPEED, k] + share[SPEED] * course[k, c] - w[c]
                white[k, 0, c] = gain[WHITE_I] * e1
                white[k, 1, c] = gain[WHITE_IW] * e1 + gain[WHITE_W] * e2
                i[c] += gain[G_II] * e1 + gain[G_IW] * e2
                w[c] += gain[G_WI] * e1 + gain[G_WW] * e2
        if mode[k] == BROKEN_MODE:
            continue
        step = steps[0 if mode[k] == UNKNOWN_MODE else 1]
        if risen.size:
            rise = risen[k]
        for c in range(q):
            u = signals[VOLTAGE, k] + share[VOLTAGE] * course[k, c]
            torque = signals[LOAD, k] + share[LOAD] * course[k, c]
            was_i, was_w = i[c], w[c]
            i[c] = step[I_I] * was_i + step[I_W] * was_w + (step[I_U] * u + step[I_T] * torque + step[I_RISE] * rise[c])
            w[c] = step[W_I] * was_i + step[W_W] * was_w + (step[W_U] * u + step[W_T] * torque + step[W_RISE] * rise[c])
    return white


@compile_kernel
def _apply_measurement(x: Float, p: Float, h: Float, value: float, noise: float) -> tuple[float, float]:
    """Update with a measurement ``value`` = h x of variance ``noise``; return its innovation and variance."""
    error, variance = value, noise
    s0 = p[0, 0] * h[0] + p[0, 1] * h[1] + p[0, 2] * h[2] + p[0, 3] * h[3]
    s1 = p[1, 0] * h[0] + p[1, 1] * h[1] + p[1, 2] * h[2] + p[1, 3] * h[3]
    s2 = p[2, 0] * h[0] + p[2, 1] * h[1] + p[2, 2] * h[2] + p[2, 3] * h[3]
    s3 = p[3, 0] * h[0] + p[3, 1] * h[1] + p[3, 2] * h[2] + p[3, 3] * h[3]
    variance += h[0] * s0 + h[1] * s1 + h[2] * s2 + h[3] * s3
    error -= h[0] * x[0] + h[1] * x[1] + h[2] * x[2] + h[3] * x[3]
    part = 1.0 / variance
    for a, gain in enumerate((s0 * part, s1 * part, s2 * part, s3 * part)):
        x[a] += gain * error
        p[a, 0] -= gain * s0
        p[a, 1] -= gain * s1
        p[a, 2] -= gain * s2
        p[a, 3] -= gain * s3
    return error, variance


@compile_kernel
def _advance_state(
    theta: Float, x: Float, p: Float, h: float, known: bool, push: float, walk: float, period: float
) -> None:
    """Propagate ``x`` (4,) and ``p`` (4, 4) by ``h`` seconds; Jt w' = K i - ft w + Jt ``push`` where friction is known.

    ``walk`` is the variance of di/dt per second; terms of third order in h ft/Jt are negligible and left out.
    """
    pull, drag = (theta[K] / theta[JT], theta[FT] / theta[JT]) if known else (0.0, 0.0)
    drop, emf, square = theta[R] / period, theta[K] / period, h * h / 2
    keep, on_i, on_s = 1.0 - drag * h + drag * drag * square, pull * (h - drag * square), pull * square
    m_w = emf * (h - drag * square)
    m_i, m_s = drop * h + emf * on_s, drop * square + emf * pull * square * h / 3
    x[STATE_SUM] += m_i * x[STATE_I] + m_w * x[STATE_W] + m_s * x[STATE_SLOPE] + emf * push * square
    x[STATE_W] = on_i * x[STATE_I] + keep * x[STATE_W] + on_s * x[STATE_SLOPE] + push * (h - drag * square)
    x[STATE_I] += h * x[STATE_SLOPE]
    for c in range(STATES):
        i, w, s = p[STATE_I, c], p[STATE_W, c], p[STATE_SLOPE, c]
        p[STATE_SUM, c] += m_i * i + m_w * w + m_s * s
        p[STATE_W, c] = on_i * i + keep * w + on_s * s
        p[STATE_I, c] = i + h * s
    for c in range(STATES):
        i, w, s = p[c, STATE_I], p[c, STATE_W], p[c, STATE_SLOPE]
        p[c, STATE_SUM] += m_i * i + m_w * w + m_s * s
        p[c, STATE_W] = on_i * i + keep * w + on_s * s
        p[c, STATE_I] = i + h * s
    both, third = walk * square, walk * square * h / 3
    p[STATE_SLOPE, STATE_SLOPE] += walk * h
    p[STATE_I, STATE_SLOPE] += both
    p[STATE_SLOPE, STATE_I] += both
    p[STATE_I, STATE_I] += 2 * third
    p[STATE_SLOPE, STATE_SUM] += drop * third
    p[STATE_SUM, STATE_SLOPE] += drop * third
    p[STATE_I, STATE_SUM] += drop * third * h * 0.75
    p[STATE_SUM, STATE_I] += drop * third * h * 0.75
    p[STATE_SUM, STATE_SUM] += drop * drop * third * h * h * 0.3


@compile_kernel
def run_low_rate_filter(
    theta: Float, readings: Readings, sensor: SlowSensor, noise: Float, spread: Float, load: Float, slope_walk: Float
) -> tuple[Float, Float]:
    """Return innovations (2 n + m,) of the drive's samples and of a low-rate voltage (m,), and their variances.

    ``noise`` (3,) = variances of voltage, current, speed; ``spread`` (n, 2) are the last two of each sample, infinite
    where nothing was read. ``load`` (n,) may be empty.
    """
    dt, mode, current, speed = readings.dt_s, readings.mode, readings.current, readings.speed
    voltage, period, instant = sensor.voltage, sensor.period_s, sensor.instant
    row, sample, time = sensor.marks
    n = current.size
    values, variance = np.zeros(2 * n + voltage.size), np.ones(2 * n + voltage.size)
    x = np.array([current[0], speed[0], 0.0, 0.0])
    p = np.zeros((STATES, STATES))
    p[STATE_I, STATE_I], p[STATE_W, STATE_W] = DIFFUSE * noise[OF_CURRENT], DIFFUSE * noise[OF_SPEED]
    p[STATE_SLOPE, STATE_SLOPE] = DIFFUSE * noise[OF_CURRENT] / (dt * dt)
    of_current, of_speed = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])
    lever, b = theta[L] / period, 0
    of_voltage = np.array([theta[R], theta[K], theta[L], 0.0]) if instant else np.array([lever, 0.0, 0.0, 1.0])
    for k in range(n):
        if spread[k, 0] < np.inf:
            values[2 * k], variance[2 * k] = _apply_measurement(x, p, of_current, current[k], spread[k, 0])
        if spread[k, 1] < np.inf:
            values[2 * k + 1], variance[2 * k + 1] = _apply_measurement(x, p, of_speed, speed[k], spread[k, 1])
        known, now = mode[k] != UNKNOWN_MODE, k * dt
        push = -(theta[CD] * mode[k] + (load[k] if load.size else 0.0)) / theta[JT] if known else 0.0
        stray = 0.0 if known else readings.walk * readings.walk / dt
        while b < row.size and row[b] == k:
            _advance_state(theta, x, p, time[b] - now, known, push, slope_walk[k], period)
            p[STATE_W, STATE_W] += stray * (time[b] - now)
            now = time[b]
            j = sample[b]
            if j != NO_SAMPLE:
                at = 2 * n + j
                noisy = noise[OF_VOLTAGE] + sensor.shape_variance[j]
                values[at], variance[at] = _apply_measurement(x, p, of_voltage, voltage[j], noisy)
            if not instant:  # a sample begins: its sum starts at - L i / T of the present current
                x[STATE_SUM] = -lever * x[STATE_I]
                for a in range(STATE_SUM):
                    p[STATE_SUM, a] = p[a, STATE_SUM] = -lever * p[STATE_I, a]
                p[STATE_SUM, STATE_SUM] = lever * lever * p[STATE_I, STATE_I]
            b += 1
        _advance_state(theta, x, p, (k + 1) * dt - now, known, push, slope_walk[k], period)
        p[STATE_W, STATE_W] += stray * ((k + 1) * dt - now)
    return values, variance


@compile_kernel
def compute_departure(
    theta: Float, dt: float, mode: Modes, load: Float, y: Float, variance: Float, walks: Float, signal: int
) -> tuple[float, float]:
    """Return the squares, in units of ``variance``, by which readings ``y`` (n, 3) depart from the smoothed signals.

    Also return how many readings of ``signal`` were informative: the sum of the shares of variance that were not their
    own. Readings are current, speed and voltage; their variance (n, 3) is infinite where there is none. ``load`` (n,)
    is as in the whitening filter; ``walks`` (n, 3) are the variances that speed (where friction is unknown) and voltage
    gain over each interval, and of the voltage's rise within it.
    """
    steps = compute_interval_steps(theta, dt, 0.0)
    x, p, of_signal = np.zeros(STATES), np.zeros((STATES, STATES)), np.eye(STATES)
    rises = (steps[1, I_RISE], steps[1, W_RISE])
    x[:3], total, news = y[0], 0.0, 0.0
    for j in range(3):
        p[j, j] = DIFFUSE * variance[:, j].min()
    for k in range(mode.size):
        for j in range(3):
            if math.isfinite(variance[k, j]):
                before = p[j, j]
                error, spread = _apply_measurement(x, p, of_signal[j], y[k, j], variance[k, j])
                total += error * error / spread
                news += before / spread if j == signal else 0.0
        known = 0 if mode[k] == UNKNOWN_MODE else 1
        step = steps[known]
        for c in range(3):
            i, w, u = p[STATE_I, c], p[STATE_W, c], p[STATE_U, c]
            p[STATE_I, c] = step[I_I] * i + step[I_W] * w + step[I_U] * u
            p[STATE_W, c] = step[W_I] * i + step[W_W] * w + step[W_U] * u
        for c in range(3):
            i, w, u = p[c, STATE_I], p[c, STATE_W], p[c, STATE_U]
            p[c, STATE_I] = step[I_I] * i + step[I_W] * w + step[I_U] * u
            p[c, STATE_W] = step[W_I] * i + step[W_W] * w + step[W_U] * u
        p[STATE_W, STATE_W] += walks[k, 0] * (1 - known)
        p[STATE_U, STATE_U] += walks[k, 1]
        for a in range(2):
            for b in range(2):
                p[a, b] += walks[k, 2] * rises[a] * rises[b]
        x[STATE_I], x[STATE_W] = _propagate_state(steps, known, x[STATE_I], x[STATE_W], x[STATE_U], load[k], 0.0)
    return total, news
