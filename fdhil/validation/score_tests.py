"""Scores deficiencies of a fitted model: how its innovations answer an alternative that parameters cannot imitate.

The part of an alternative's direction that the six parameters cannot imitate is compared with the innovations: the
result is a statistic in standard deviations, and the alternative's amplitude in its own unit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from fdhil.identification import (
    CURRENT,
    LOAD,
    SPEED,
    VOLTAGE,
    LikelihoodFit,
    Motion,
    compute_innovations,
    compute_low_rate_innovations,
    compute_moving_mean,
    compute_signal_response,
    estimate_aliasing_doubt,
    invert_symmetric,
)
from fdhil.records import Float, Reason
from fdhil.validation.false_alarm_budget import BUDGET

IMITATED = 1e-6  # share of a direction below which only rounding remains
LAGS = 25
SLOPE_S = 0.005  # over which the acceleration is taken
_KINDS = {"current": CURRENT, "speed": SPEED}


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one alternative: its code and text, its statistic (standard deviations) and amplitude.

    ``least`` is the smallest amplitude that matters, in the amplitude's own unit. ``direction`` (m,) is the change of
    the innovations per unit, and ``compute_load_nm`` (n,) the unit's torque, where it is one.
    """

    code: str
    text: str
    advice: str
    least: float
    statistic: float
    amplitude: float
    direction: Float
    load_nm: Float | None = None
    name: str = ""

    @property
    def is_significant(self) -> bool:
        """Return whether the finding is significant."""
        return abs(self.statistic) > BUDGET["structure"].deviations

    @property
    def is_relevant(self) -> bool:
        """Return whether the finding is significant and large enough to matter."""
        return self.is_significant and abs(self.amplitude) > self.least

    def build_reason(self) -> Reason:
        """Return the finding as a reason."""
        text = self.text.format(self.amplitude)
        return Reason(self.code, f"{text} ({abs(self.statistic):.0f} standard deviations)", self.advice)


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """One fitted window on which alternatives are tried: how innovations answer, and what imitates them.

    ``imitating`` (m, k + c) are the jacobian and the courses that the voltage may have within its samples; ``inverse``
    (k + c, k + c) is the covariance of their sizes, with one standard deviation of each course as its prior; ``held``
    (k + c,) are the sizes that the innovations show.
    """

    fit: LikelihoodFit
    nuisance_directions: Float
    inverse: Float
    nuisance_sizes: Float
    autocorrelation_factor: float = 1.0

    @classmethod
    def prepare(cls, fit: LikelihoodFit) -> ScoreTest:
        """Return the score test of a window's fit."""
        imitating = np.column_stack([fit.jacobian, compute_voltage_uncertainty(fit)])
        gram, k = imitating.T @ imitating, fit.jacobian.shape[1]
        gram[:k, :k] = fit.information
        gram[range(k, len(gram)), range(k, len(gram))] += 1.0
        inverse = invert_symmetric(gram)[0]
        coloured = 1.0 + 2.0 * max(0.0, compute_expected_autocorrelation(fit)[0])
        return cls(fit, imitating, inverse, inverse @ (imitating.T @ fit.residuals), coloured)

    @property
    def motion(self) -> Motion:
        """The window."""
        return self.fit.problem.motions[0]

    @property
    def peak_torque(self) -> float:
        """Largest K |i| of the window, N.m."""
        return float(abs(self.fit.theta[2]) * np.abs(self.motion.current).max())

    def compute_load_responses(self, loads: Float) -> Float:
        """Return minus the change (m, q) of the innovations under each of ``loads`` (q, n), N.m."""
        return self._compute_responses(LOAD, loads, None)

    def compute_gain_responses(self, motion: Motion, name: str, courses: Float) -> Float:
        """Return minus the change (m, q) of the innovations when the gain of ``name`` grows by ``courses`` (q, n)."""
        if name == "voltage":
            at = np.array([motion.sample_at_voltage(c) for c in courses])
            return self._compute_responses(VOLTAGE, motion.voltage_mean * at, motion.voltage_rise * at)
        return self._compute_responses(_KINDS[name], getattr(motion, name) * courses, None)

    def predict_readings(self) -> Motion:
        """Return the motion with each reading as predicted by those before it: a gain acts on what is measured.

        A reading contains its own innovation. Of a gain that the parameters imitate, only that would remain.
        """
        motion, fit = self.motion, self.fit
        if motion.slow is None:
            white, whiteners = fit.residuals.reshape(-1, 2), fit.problem.filters[0].whitening_factors
            safe = np.where(motion.observed[:, None], whiteners, 1.0)
            current = white[:, 0] / safe[:, 0]
            speed = (white[:, 1] - safe[:, 1] * current) / safe[:, 2]
            return replace(motion, current=motion.current - current, speed=motion.speed - speed)
        made = compute_low_rate_innovations(
            motion, fit.theta, fit.problem.noises[0].to_array() ** 2, float(fit.theta[6])
        ).values
        rows = made[: 2 * motion.n].reshape(-1, 2)
        return replace(
            motion,
            current=motion.current - rows[:, 0],
            speed=motion.speed - rows[:, 1],
            voltage_mean=motion.voltage_mean - made[2 * motion.n :],
        )

    def compute_offset_responses(self, name: str, courses: Float) -> Float:
        """Return minus the change (m, q) of the innovations when ``courses`` (q, n) are added to signal ``name``."""
        motion = self.motion
        if name != "voltage":
            return self._compute_responses(_KINDS[name], courses, None)
        at_samples = np.array([motion.sample_at_voltage(c) for c in courses])
        return self._compute_responses(VOLTAGE, at_samples, np.zeros_like(at_samples))

    def _compute_responses(self, kind: int, courses: Float, rises: Float | None) -> Float:
        motion, theta, gains = self.motion, self.fit.theta, self.fit.problem.filters[0]
        if motion.slow is not None:
            return np.column_stack([self._compute_slow_response(kind, course) for course in courses])
        if rises is not None and theta[6] != 0.0:
            both = zip(courses, rises, strict=True)
            courses = np.array(
                [replace(motion, voltage_mean=c, voltage_rise=r).compute_delayed_voltage(theta[6]) for c, r in both]
            )
        answered: Float = -compute_signal_response(motion, theta, gains, kind, courses, rises)
        return answered

    def _compute_slow_response(self, kind: int, course: Float) -> Float:
        """Return minus the change (m,) of the innovations, a slow voltage's among them."""
        motion, theta, gains = self.motion, self.fit.theta, self.fit.problem.filters[0]
        if kind == VOLTAGE:
            motion = replace(motion, voltage_mean=motion.voltage_mean + course)
        elif kind == CURRENT:
            motion = replace(motion, current=motion.current + course)
        elif kind == SPEED:
            motion = replace(motion, speed=motion.speed + course)
        load = course if kind == LOAD else None
        change: Float = self.fit.residuals - compute_innovations(motion, theta, gains, load)
        return change

    def compute_scores(self, directions: Float) -> tuple[Float, Float]:
        """Return score (q,) and information (q, q) of ``directions`` (m, q) beyond what imitates them.

        The effect of the voltage's course within its samples is removed as far as it is expected, so that anything else
        is detected as sharply as ever (generalised least squares).
        """
        shared = self.nuisance_directions.T @ directions
        score = directions.T @ self.fit.residuals - shared.T @ self.nuisance_sizes
        return score, directions.T @ directions - shared.T @ self.inverse @ shared

    def find_best_alternative(self, matrix: Float) -> tuple[int, float, float, Float]:
        """Return index, statistic, amplitude and (m,) of the column of ``matrix`` (m, q) with the largest statistic."""
        shared, whole = self.nuisance_directions.T @ matrix, np.einsum("mq,mq->q", matrix, matrix)
        weight = whole - np.einsum("kq,kq->q", shared, self.inverse @ shared)
        statistic, amplitude = self.compute_statistics(
            self.fit.residuals @ matrix - self.nuisance_sizes @ shared, weight, whole
        )
        k = int(np.argmax(np.abs(statistic)))
        return k, float(statistic[k]), float(amplitude[k]), matrix[:, k]

    def compute_statistics(self, score: Float, weight: Float, whole: Float) -> tuple[Float, Float]:
        """Return statistics and amplitudes; 0 where the parameters imitate all of ``whole`` but rounding.

        The variance of a score is its ``weight``, more where innovations are autocorrelated.
        """
        seen = weight > IMITATED * whole
        safe = np.where(seen, weight, 1.0)
        return np.where(seen, score / np.sqrt(self.autocorrelation_factor * safe), 0.0), np.where(
            seen, score / safe, 0.0
        )


@lru_cache(maxsize=2)
def compute_voltage_uncertainty(fit: LikelihoodFit) -> Float:
    """Return how the innovations (m, c) answer one standard deviation of the unknown course between voltage samples.

    Interval means leave the course within a sample open. Instants that are synchronous with a regulator which answers a
    rising back-EMF have an error in proportion to the acceleration, too; errors in proportion to current and its slope
    are imitated by R and L.
    """
    shape = fit.problem.compute_waveform_effects(fit.theta)
    motion, theta = fit.problem.motions[0], fit.theta
    doubt = estimate_aliasing_doubt(motion.voltage_sampling, motion.voltage_period_s)[0]
    if doubt == 0.0:
        return shape
    rate = np.gradient(compute_moving_mean(motion.speed, 2 * round(SLOPE_S / 2 / motion.dt_s) + 1), motion.dt_s)
    missed = doubt * theta[0] * theta[3] / theta[2] * rate
    if motion.slow is not None:
        moved = replace(motion, voltage_mean=motion.voltage_mean + motion.sample_at_voltage(missed))
        return np.column_stack([shape, compute_innovations(moved, theta, fit.problem.filters[0]) - fit.residuals])
    answer = compute_signal_response(
        motion, theta, fit.problem.filters[0], VOLTAGE, missed[None], np.zeros((1, motion.n))
    )
    return np.column_stack([shape, answer])


@lru_cache(maxsize=2)
def compute_expected_autocorrelation(fit: LikelihoodFit) -> Float:
    """Return the autocorrelation (LAGS,) of the current's innovations that instants of a noisy voltage cause.

    Two neighbouring intervals share the noise of the instant between them, which a filter for white noise ignores: with
    h the answer to one volt over one interval, noise of variance q gives q/2 (h h at one lag less and more).
    """
    motion, gains = fit.problem.motions[0], fit.problem.filters[0]
    known = np.flatnonzero(np.abs(motion.mode) == 1)
    if motion.voltage_sampling != "instant" or motion.slow is not None or known.size <= 3 * LAGS:
        return np.zeros(LAGS)
    row = int(known[known.size // 2])
    pulse = np.zeros(motion.n)
    # noise beyond the sensor's is caused by the regulators, and is not shared in that way
    pulse[row] = min(fit.problem.noises[0].voltage_v, motion.noise.voltage_v)
    answer = compute_signal_response(motion, fit.theta, gains, VOLTAGE, pulse[None], np.zeros((1, motion.n)))
    h = np.zeros(3 * LAGS)
    part = answer.reshape(-1, 2)[row : row + h.size, 0]
    h[: part.size] = part
    powers = np.array([float(h[lag:] @ h[: h.size - lag]) for lag in range(LAGS + 2)])
    expected: Float = 0.5 * (powers[:-2] + powers[2:]) / (1.0 + powers[1])
    return expected
