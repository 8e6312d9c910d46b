"""What a sensor should have read over some rows, told by the other two sensors and by its own rows beside them.

The drive's equations with the fitted parameters, and the voltage as a third state that walks from row to row: a Kalman
filter tells how much less likely the most likely course is with the doubted readings than without them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.filtering import moving_mean
from fdhil.identification.motion import BROKEN, DIFFUSE, UNKNOWN
from fdhil.model.feed_drive import transition
from fdhil.records import Float

BESIDE_S = 0.040  # rows beside the doubted ones that are taken in: some time constants of a winding
SMOOTHING_S = 0.004
COURSE = 0.3  # of a voltage's change from row to row: what is not known of its course between them
RISES = 1.5  # of the same: by how much it may rise over one
SIGNALS = ("current", "speed", "voltage")


def _product_plain(one: Float, other: Float, out: Float) -> None:
    """Fill ``out`` (3, 3) with one other."""
    for i in range(3):
        for j in range(3):
            out[i, j] = one[i, 0] * other[0, j] + one[i, 1] * other[1, j] + one[i, 2] * other[2, j]


_product: Callable[[Float, Float, Float], None] = njit(cache=True, nogil=True)(_product_plain)


def _steps_plain(theta: Float, dt: float) -> tuple[Float, Float, Float]:
    """Return the steps (2, 3, 3) of [i, w, u] where friction is not known and where it is, and its effect (2,) there.

    The last (2,) is what a voltage does that rises by 1 V over the interval, about its mean.

    ``theta`` = [R, L, K, Jt, ft, Cd, ...]; where friction is not known, the speed stays but for its walk.
    """
    steps, drag, rise = np.zeros((2, 3, 3)), np.zeros(2), np.zeros(2)
    for known in range(2):
        a = np.array([[-theta[0] / theta[1], -theta[2] / theta[1]], [theta[2] / theta[3], -theta[4] / theta[3]]])
        a[1, :] *= known
        phi, mean, ramp = transition(a, dt)
        steps[known, :2, :2] = phi
        steps[known, :2, 2] = mean[:, 0] / theta[1]
        steps[known, 2, 2] = 1.0
        if known:
            drag, rise = -mean[:, 1] * theta[5] / theta[3], ramp[:, 0] / theta[1]
    return steps, drag, rise


_steps: Callable[[Float, float], tuple[Float, Float, Float]] = njit(cache=True, nogil=True)(_steps_plain)


def _squares_plain(
    theta: Float, dt: float, mode: Float, y: Float, variance: Float, walks: Float, signal: int
) -> tuple[float, float]:
    """Return the sum of squares by which readings ``y`` (n, 3) depart from the best course, in units of ``variance``.

    And how many of the readings of ``signal`` were news: the sum of their shares of variance that were not their own.
    The variance (n, 3) is infinite where there is no reading.

    ``walks`` (n, 3) are the variances that speed (where friction is unknown) and voltage gain over each interval, and
    of the voltage's rise within it.
    """
    steps, drag, rise = _steps(theta, dt)
    here, there, gain = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    state, total, news = y[0].copy(), 0.0, 0.0
    for j in range(3):
        here[j, j] = DIFFUSE * variance[:, j].min()
    for k in range(mode.size):
        for j in range(3):
            if not math.isfinite(variance[k, j]):
                continue
            e, s = y[k, j] - state[j], here[j, j] + variance[k, j]
            total += e * e / s
            news += here[j, j] / s if j == signal else 0.0
            for i in range(3):
                gain[i] = here[i, j] / s
            for i in range(3):
                state[i] += gain[i] * e
                for m in range(3):
                    there[i, m] = here[i, m] - gain[i] * gain[m] * s
            here[:] = there
        known = 0 if mode[k] == UNKNOWN else 1
        step = steps[known]
        _product(step, here, there)
        _product(there, step.T, here)
        here[1, 1] += walks[k, 0] * (1 - known)
        here[2, 2] += walks[k, 1]
        for i in range(2):
            for j in range(2):
                here[i, j] += walks[k, 2] * rise[i] * rise[j]
        i0, w0, u0 = state[0], state[1], state[2]
        for j in range(3):
            state[j] = step[j, 0] * i0 + step[j, 1] * w0 + step[j, 2] * u0
        for j in range(2):
            state[j] += known * drag[j] * mode[k]
    return total, news


_squares: Callable[..., tuple[float, float]] = njit(cache=True, nogil=True)(_squares_plain)


@dataclass(frozen=True, slots=True)
class Bridge:
    """A fitted window: readings (n, 3) of current, speed and voltage, their variances, and how far states walk."""

    fit: Fit
    readings: Float
    variances: Float
    walks: Float

    @classmethod
    def over(cls, fit: Fit) -> Bridge:
        """Return the bridge of a fit's window."""
        motion, theta = fit.problem.motions[0], fit.theta
        noise = np.maximum(fit.problem.noises[0].vector(), motion.noise.vector())[[1, 2, 0]]
        voltage = motion.delayed(theta[6])
        width = 2 * round(SMOOTHING_S / motion.dt_s / 2) + 1
        course = moving_mean(voltage, width)
        change = np.diff(course, append=course[-1]) ** 2
        about = np.maximum(change, np.maximum(np.roll(change, 1), np.roll(change, -1)))
        variances = np.tile(noise**2, (motion.n, 1))
        variances[:, 2] += COURSE**2 * about
        variances[~motion.observed] = np.inf
        # a corner changes faster than the rest of the move
        walks = [np.full(motion.n, motion.speed_walk**2), np.maximum(about, float(change.mean())), RISES**2 * about]
        return cls(fit, np.column_stack([motion.current, motion.speed, voltage]), variances, np.column_stack(walks))

    def crossing(self, name: str, start: int, end: int) -> Crossing | None:
        """Return rows ``start`` to ``end`` - 1 and those beside them, without what sensor ``name`` reads in them.

        None where samples are lost there, or nothing else is read.
        """
        motion, theta = self.fit.problem.motions[0], self.fit.theta
        rows = round(BESIDE_S / motion.dt_s)
        part = slice(max(0, start - rows), min(motion.n, end + rows))
        if (motion.mode[part] == BROKEN).any():
            return None
        signal = SIGNALS.index(name)
        # a voltage that is late by part of a row, or an instant, is mixed from two
        mixed = math.ceil(abs(theta[6]) / motion.dt_s) + 1 if name == "voltage" else 0
        variances = self.variances[part].copy()
        variances[max(0, start - part.start - mixed) : end - part.start + mixed, signal] = np.inf
        if not np.isfinite(variances.min(axis=0)).all():
            return None
        mode = motion.mode[part].astype(np.float64)
        return Crossing(
            theta, motion.dt_s, mode, self.readings[part], variances, self.walks[part], signal, part.start, mixed
        )


@dataclass(frozen=True)
class Crossing:
    """The rows about a run whose readings of one ``signal`` are left out; they begin at row ``begin`` of the window.

    Readings within ``mixed`` rows of the run's ends are mixed from the run and what is beside it.
    """

    theta: Float
    dt_s: float
    mode: Float
    readings: Float
    variances: Float
    walks: Float
    signal: int
    begin: int
    mixed: int

    @cached_property
    def free(self) -> tuple[float, float]:
        """Return the squares and the news of the best course that leaves the run out."""
        return self._squares(self.readings, self.variances)

    def log_chance(self, start: int, end: int, level: float, deviation: float) -> float:
        """Return log p that a living sensor is as far from ``level`` in rows ``start`` to ``end`` - 1 of the window.

        It is that of the sum of squares by which these readings, each with a ``deviation``, make the best course of
        all sensors worse.
        """
        first, beyond = start - self.begin + self.mixed, end - self.begin - self.mixed
        if beyond <= first:
            return 0.0
        readings, variances = self.readings.copy(), self.variances.copy()
        readings[first:beyond, self.signal], variances[first:beyond, self.signal] = level, deviation**2
        (forced, news), (free, other_news) = self._squares(readings, variances), self.free
        return log_beyond(forced - free, max(news - other_news, 1.0))

    def _squares(self, readings: Float, variances: Float) -> tuple[float, float]:
        return _squares(self.theta, self.dt_s, self.mode, readings, variances, self.walks, self.signal)


def log_beyond(square: float, freedom: float) -> float:
    """Return the logarithm of the chance of a chi-square beyond ``square`` (Wilson and Hilferty)."""
    spread = 2.0 / (9.0 * freedom)
    return log_below(-((max(square, 0.0) / freedom) ** (1 / 3) - (1.0 - spread)) / math.sqrt(spread))


def log_below(z: float) -> float:
    """Return the logarithm of the normal distribution at ``z``."""
    if z < -25.0:
        return -0.5 * z * z - math.log(-z * math.sqrt(2.0 * math.pi))
    return math.log(0.5 * math.erfc(-z / math.sqrt(2.0)))
