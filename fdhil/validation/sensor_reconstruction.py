"""Reconstructs a sensor's readings over some rows from the other two and from its own rows around them.

The drive's equations with the fitted parameters, and the voltage as a third state that walks from row to row: a Kalman
filter shows how much less likely the most likely course is with the doubted readings than without them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fdhil.identification import (
    BROKEN_MODE,
    DELAY,
    LikelihoodFit,
    Modes,
    compute_departure,
    compute_load_nm,
    compute_motor_voltage_v,
    compute_moving_mean,
)
from fdhil.records import Float

NEIGHBOUR_S = 0.040  # around the doubted rows that are included: some time constants of a winding
SMOOTHING_S = 0.004
COURSE = 0.3  # of a voltage's change from row to row: uncertainty of its course between them
RISES = 1.5  # of the same: its possible rise within one row
SIGNALS = ("current", "speed", "voltage")


@dataclass(frozen=True, slots=True)
class SensorReconstruction:
    """A fitted window: readings (n, 3) of current, speed and voltage, their variances, and the states' walks."""

    fit: LikelihoodFit
    readings: Float
    variances: Float
    walks: Float

    @classmethod
    def prepare(cls, fit: LikelihoodFit) -> SensorReconstruction:
        """Return the reconstruction of a fit's window."""
        motion, theta = fit.problem.motions[0], fit.theta
        noise = np.maximum(fit.problem.noises[0].to_array(), motion.noise.to_array())[[1, 2, 0]]
        voltage = compute_motor_voltage_v(motion, theta)
        width = 2 * round(SMOOTHING_S / motion.dt_s / 2) + 1
        course = compute_moving_mean(voltage, width)
        change = np.diff(course, append=course[-1]) ** 2
        about = np.maximum(change, np.maximum(np.roll(change, 1), np.roll(change, -1)))
        variances = np.tile(noise**2, (motion.n, 1))
        variances[:, 2] += COURSE**2 * about
        variances[~motion.observed] = np.inf
        # a corner changes faster than the rest of the move
        walks = [np.full(motion.n, motion.speed_walk**2), np.maximum(about, float(change.mean())), RISES**2 * about]
        return cls(fit, np.column_stack([motion.current, motion.speed, voltage]), variances, np.column_stack(walks))

    def omit_readings(self, name: str, start: int, end: int) -> ReconstructedSpan | None:
        """Return rows ``start`` to ``end`` - 1 and those around them, without the readings of sensor ``name`` in them.

        None where samples are lost there, or no other sensor is read.
        """
        motion, theta = self.fit.problem.motions[0], self.fit.theta
        rows = round(NEIGHBOUR_S / motion.dt_s)
        part = slice(max(0, start - rows), min(motion.n, end + rows))
        if (motion.mode[part] == BROKEN_MODE).any():
            return None
        signal = SIGNALS.index(name)
        # a voltage that is late by part of a row, or an instant, is mixed from two
        mixed = math.ceil(abs(theta[DELAY]) / motion.dt_s) + 1 if name == "voltage" else 0
        variances = self.variances[part].copy()
        variances[max(0, start - part.start - mixed) : end - part.start + mixed, signal] = np.inf
        if not np.isfinite(variances.min(axis=0)).all():
            return None
        return ReconstructedSpan(
            theta,
            motion.dt_s,
            motion.mode[part],
            compute_load_nm(motion, theta)[part],
            self.readings[part],
            variances,
            self.walks[part],
            signal,
            part.start,
            mixed,
        )


@dataclass(frozen=True)
class ReconstructedSpan:
    """The rows around a run whose readings of one ``signal`` are left out; they begin at row ``begin`` of the window.

    Readings within ``mixed`` rows of the run's ends mix samples from inside and outside the run.
    """

    theta: Float
    dt_s: float
    mode: Modes
    load_nm: Float
    readings: Float
    variances: Float
    walks: Float
    signal: int
    begin: int
    mixed: int

    @cached_property
    def unconstrained_fit(self) -> tuple[float, float]:
        """Return the squares and the degrees of freedom of the best course that leaves the run out."""
        return self._compute_deviation(self.readings, self.variances)

    def compute_log_probability(self, start: int, end: int, level: float, deviation: float) -> float:
        """Return log p that a working sensor is as far from ``level`` in rows ``start`` to ``end`` - 1 of the window.

        It is that of the sum of squares by which these readings, each with a ``deviation``, make the best course of all
        sensors worse.
        """
        first, beyond = start - self.begin + self.mixed, end - self.begin - self.mixed
        if beyond <= first:
            return 0.0
        readings, variances = self.readings.copy(), self.variances.copy()
        readings[first:beyond, self.signal], variances[first:beyond, self.signal] = level, deviation**2
        (forced, news), (free, other_news) = self._compute_deviation(readings, variances), self.unconstrained_fit
        return compute_log_chi_square_tail(forced - free, max(news - other_news, 1.0))

    def _compute_deviation(self, readings: Float, variances: Float) -> tuple[float, float]:
        return compute_departure(
            self.theta, self.dt_s, self.mode, self.load_nm, readings, variances, self.walks, self.signal
        )


def compute_log_chi_square_tail(square: float, freedom: float) -> float:
    """Return the logarithm of the chance of a chi-square beyond ``square`` (Wilson and Hilferty)."""
    spread = 2.0 / (9.0 * freedom)
    return compute_log_normal_cdf(-((max(square, 0.0) / freedom) ** (1 / 3) - (1.0 - spread)) / math.sqrt(spread))


def compute_log_normal_cdf(z: float) -> float:
    """Return the logarithm of the normal distribution at ``z``."""
    if z < -25.0:
        return -0.5 * z * z - math.log(-z * math.sqrt(2.0 * math.pi))
    return math.log(0.5 * math.erfc(-z / math.sqrt(2.0)))
