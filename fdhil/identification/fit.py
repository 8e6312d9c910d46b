"""Fits prepared windows: Gauss-Newton on the whitened innovations, alternated with the noise levels.

The entries of theta are [R, L, K, Jt, ft, Cd, delay], then one for each term of the motions: a torque or a voltage in
which the innovations are linear.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fdhil.identification.courses import FIRST_COURSE
from fdhil.identification.identifiability import admissible
from fdhil.identification.innovations import Gains, answers, course_answers, gains_of, innovations, whiten
from fdhil.identification.kalman import CD, DELAY, FT, LOAD, SPEED, VOLTAGE, K
from fdhil.identification.motion import Course, Motion, Noise
from fdhil.identification.noise import fit_noise
from fdhil.identification.normal import inverse_of
from fdhil.identification.slow_descent import Likelihood, ascend
from fdhil.identification.slow_voltage import course_effect, innovations_of
from fdhil.records import Float

RENEWALS = 3
STEPS = 16
CONVERGED = 1e-3  # of a standard deviation
ROUGH = 0.3  # of a standard deviation: near enough to estimate the noise levels
KEPT = 0.2  # of the step before: while steps shorten faster, the jacobian is reused
SLACK = 1e-6  # of the sum of squares, by which a step may miss the minimum
DIFFERENCE = 1e-5
DELAY_DIFFERENCE_S = 1e-5
SHAPE_DOUBT = 1.5  # of the back-EMF's ramp within a sample: one standard deviation of the voltage's waveform
SETTLED = 0.25  # squared standard deviations: smaller moves change no noise level by a thousandth


@dataclass(frozen=True, slots=True)
class Problem:
    """Prepared windows, each with its noise levels and the filter made for the parameters."""

    motions: tuple[Motion, ...]
    noises: tuple[Noise, ...]
    filters: tuple[Gains, ...]

    def residuals(self, theta: Float) -> Float:
        """Return the whitened innovations (m,) of all windows, with the filter matched to ``theta`` (k,)."""
        return self.columns(theta[None])[:, 0]

    @property
    def slow(self) -> bool:
        """Whether the voltage is sampled more slowly than the drive's signals."""
        return any(m.slow is not None for m in self.motions)

    def columns(self, thetas: Float) -> Float:
        """Return the whitened innovations (m, q) for each row of ``thetas`` (q, k)."""
        pairs = zip(self.motions, self.noises, strict=True)
        parts = [whiten(m, thetas, np.tile(s.vector() ** 2, (len(thetas), 1)))[0] for m, s in pairs]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def shape_effect(self, theta: Float) -> Float:
        """Return the change (m,) of the innovations due to the unknown waveform of the voltage within its samples."""
        if self.slow:
            pairs = zip(self.motions, self.noises, strict=True)
            return np.concatenate([course_effect(m, theta, s.vector() ** 2) for m, s in pairs])
        return self._all(theta, 1.0 + SHAPE_DOUBT) - self._all(theta, 1.0)

    def answer(self, theta: Float, courses: Sequence[Sequence[Course]]) -> Float:
        """Return minus the change (m, q) of the innovations with each of ``courses``, (q,) for every window.

        The innovations are linear in them, so one filter serves all.
        """
        parts = zip(self.motions, self.noises, courses, strict=True)
        return np.concatenate([-_answered(m, theta, s, own) for m, s, own in parts])

    def course_effects(self, theta: Float) -> Float:
        """Return the change (m, c) of the innovations with one deviation of each unknown of the voltage's waveform.

        The first is the shape effect; in long samples the regulators' part has its own column.
        """
        shape = self.shape_effect(theta)[:, None]
        if any(m.within is None for m in self.motions):
            return shape
        pairs = zip(self.motions, self.filters, strict=True)
        return np.column_stack([shape, np.concatenate([course_answers(m, theta, f) for m, f in pairs])])

    def _all(self, theta: Float, emf_share: float) -> Float:
        pairs = zip(self.motions, self.filters, strict=True)
        return np.concatenate([innovations(m, theta, f, emf_share=emf_share) for m, f in pairs])


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A finished fit: ``theta`` (7 + terms,), information (k, k) of the ``free`` entries, innovations (m,), noises.

    ``delay_doubt_s`` is the part of a delay that may be waveform within samples, or the reverse. ``prior`` (k,) is the
    information known beforehand, on the diagonal, and ``prior_std`` (k,) its standard deviation; empty: none.
    """

    theta: Float
    information: Float
    free: tuple[int, ...]
    residuals: Float
    jacobian: Float
    problem: Problem
    converged: bool
    delay_doubt_s: float = 0.0
    prior: Float = field(default_factory=lambda: np.zeros(0))
    prior_std: Float = field(default_factory=lambda: np.zeros(0))

    @property
    def but_delay(self) -> Float:
        """The jacobian (m, k) without the delay's column."""
        if DELAY not in self.free:
            return self.jacobian
        at = self.free.index(DELAY)  # a slice keeps the order in memory, and with it the last bit
        before, after = self.jacobian[:, :at], self.jacobian[:, at + 1 :]
        return np.column_stack([before, after]) if after.size else before

    def by_window(self, values: Float) -> list[Float]:
        """Return ``values`` (m, ...) of all innovations split by window."""
        return np.split(values, np.cumsum([2 * m.n + m.samples for m in self.problem.motions])[:-1])

    def by_equation(self) -> dict[str, Float]:
        """Return the innovations of [5], of the current or of a low-rate voltage, and of [6], the speed's."""
        pairs = list(zip(self.problem.motions, self.by_window(self.residuals), strict=True))
        return {
            "electrical": np.concatenate([e[2 * m.n :] if m.slow is not None else e[0::2] for m, e in pairs]),
            "mechanical": np.concatenate([e[1 : 2 * m.n : 2] for m, e in pairs]),
        }


def with_delay(theta: Float, delay_s: float) -> Float:
    """Return ``theta`` (k,) with another delay."""
    changed = theta.copy()
    changed[DELAY] = delay_s
    return changed


def but_delay(free: Sequence[int]) -> list[int]:
    """Return the ``free`` entries without the delay."""
    return [j for j in free if j != DELAY]


def pose(motions: Sequence[Motion], theta: Float, noises: Sequence[Noise]) -> Problem:
    """Return the problem with the filters made for ``theta``."""
    filters = tuple(gains_of(m, theta, s) for m, s in zip(motions, noises, strict=True))
    return Problem(tuple(motions), tuple(noises), filters)


def jacobian(problem: Problem, theta: Float, base: Float, free: Sequence[int], scales: Float) -> Float:
    """Return minus the derivative (m, k) of the innovations by the ``free`` entries of theta, filter included."""
    late = [j - FIRST_COURSE for j in free if j >= FIRST_COURSE]  # they come last
    joined = [[m.courses[j] for j in late] for m in problem.motions]
    free = [j for j in free if j < FIRST_COURSE]
    steps = np.array([DELAY_DIFFERENCE_S if j == DELAY else DIFFERENCE * scales[j] for j in free])
    moved = np.tile(theta, (len(free), 1))
    moved[np.arange(len(free)), list(free)] += steps
    changes: Float = (base[:, None] - problem.columns(moved)) / steps
    return np.column_stack([changes, problem.answer(theta, joined)]) if late else changes


def _answered(motion: Motion, theta: Float, noise: Noise, courses: Sequence[Course]) -> Float:
    if motion.slow is not None:
        variances = noise.vector() ** 2
        base = innovations_of(motion, theta, variances).whitened
        return np.column_stack([_slow_answered(motion, theta, variances, course) - base for course in courses])
    gains = gains_of(motion, theta, noise)
    changes = np.empty((2 * motion.n, len(courses)))
    for kind in (LOAD, VOLTAGE, SPEED):
        of_kind = [k for k, course in enumerate(courses) if course.kind == kind]
        if of_kind:
            values = np.stack([courses[k].values for k in of_kind])
            rises = np.zeros_like(values) if kind == VOLTAGE else None
            changes[:, of_kind] = answers(motion, theta, gains, kind, values, rises)
    return changes


def _slow_answered(motion: Motion, theta: Float, variances: Float, course: Course) -> Float:
    if course.kind == SPEED:
        return innovations_of(replace(motion, speed=motion.speed + course.values), theta, variances).whitened
    return innovations_of(motion, theta, variances, more_nm=course.values).whitened


def typical(theta: Float, motions: Sequence[Motion]) -> Float:
    """Return the typical size (k,) of each entry; friction is sized by the torque and speed of the windows."""
    torque = abs(theta[K]) * max(float(np.abs(m.current).max()) for m in motions)
    speed = max(float(np.abs(m.speed).max()) for m in motions)
    sizes = np.abs(theta)
    sizes[FT] = max(sizes[FT], 1e-3 * torque / speed)
    sizes[CD] = max(sizes[CD], 1e-3 * torque)
    sizes[FIRST_COURSE:] = np.maximum(sizes[FIRST_COURSE:], 1e-3 * torque)
    return sizes


def descend(
    problem: Problem, theta: Float, free: Sequence[int], enough: float = CONVERGED
) -> tuple[Float, Float, Float, bool]:
    """Run Gauss-Newton until a step is below ``enough`` standard deviations.

    Return theta, innovations (m,), jacobian (m, k), and success. The jacobian is the expensive part and hardly changes
    near the minimum: it is reused while each step is much shorter than the one before.
    """
    residuals = problem.residuals(theta)
    last, j, inverse, norms = 0.0, *_slopes(problem, theta, residuals, free)
    for _ in range(STEPS):
        step = inverse @ (j.T @ residuals)
        size = float(np.abs(step * norms).max())
        if last and size > KEPT * last:
            j, inverse, norms = _slopes(problem, theta, residuals, free)
            step = inverse @ (j.T @ residuals)
            size = float(np.abs(step * norms).max())
        if not np.isfinite(norms).all() or (norms == 0).any():
            return theta, residuals, j, False
        share, ceiling = 1.0, float(residuals @ residuals) * (1 + SLACK)
        while share > 1e-3:
            trial = theta.copy()
            trial[list(free)] += share * step
            if admissible(trial):
                moved = problem.residuals(trial)
                if np.isfinite(moved).all() and float(moved @ moved) <= ceiling:
                    theta, residuals = trial, moved
                    break
            share *= 0.5
        else:
            return theta, residuals, j, True  # nothing lower along the step: the minimum, to rounding
        if size < enough:
            return theta, residuals, j, True
        last = size
    return theta, residuals, j, False


def _slopes(problem: Problem, theta: Float, residuals: Float, free: Sequence[int]) -> tuple[Float, Float, Float]:
    """Return the jacobian (m, k), the inverse (k, k) of its Gram matrix, and the lengths (k,) of its columns."""
    j = jacobian(problem, theta, residuals, free, typical(theta, problem.motions))
    gram = j.T @ j
    return j, inverse_of(gram)[0], np.sqrt(np.diag(gram))


def fit(motions: Sequence[Motion], start: Float, free: Sequence[int], known: Sequence[Noise] = ()) -> Fit:
    """Alternate between parameters and noise levels, from ``start`` (k,) and the ``known`` levels of an earlier fit."""
    theta, noises = start.copy(), list(known) or [m.noise for m in motions]
    for turn in range(RENEWALS):
        problem = Problem(tuple(motions), tuple(noises), ())
        before = theta
        if problem.slow:
            likelihood = Likelihood(problem.motions, problem.noises)
            theta, residuals, j, converged = ascend(likelihood, theta, free, typical(theta, motions))
        else:
            theta, residuals, j, converged = descend(problem, theta, free, CONVERGED if turn or known else ROUGH)
        information = j.T @ j
        moved = theta[list(free)] - before[list(free)]
        if (turn or known) and float(moved @ information @ moved) < SETTLED:
            break
        noises = [fit_noise(m, theta, s) for m, s in zip(motions, noises, strict=True)]
    return Fit(theta, information, tuple(free), residuals, j, pose(motions, theta, problem.noises), converged)
