"""Fits prepared windows: Gauss-Newton on the whitened innovations, alternated with the noise levels.

The entries of theta are [R, L, K, Jt, ft, Cd, delay], then one for each term of the motions: a torque or a voltage in
which the innovations are linear.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fdhil.identification.identifiability import is_admissible
from fdhil.identification.innovations import (
    FilterGains,
    compute_filter_gains,
    compute_innovations,
    compute_signal_response,
    compute_waveform_response,
    whiten_innovations,
)
from fdhil.identification.kalman import CD, DELAY, FT, LOAD, SPEED, VOLTAGE, K
from fdhil.identification.low_rate_voltage.likelihood_ascent import LowRateLikelihood, maximise_likelihood
from fdhil.identification.low_rate_voltage.low_rate_innovations import (
    compute_low_rate_innovations,
    compute_waveform_effect,
)
from fdhil.identification.noise_fit import fit_noise
from fdhil.identification.normal_equations import invert_symmetric
from fdhil.identification.prepared_motion import Motion, NoiseLevels, TermRegressor
from fdhil.identification.term_regressors import FIRST_TERM
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
class FitProblem:
    """Prepared windows, each with its noise levels and the filter made for the parameters."""

    motions: tuple[Motion, ...]
    noises: tuple[NoiseLevels, ...]
    filters: tuple[FilterGains, ...]

    def compute_residuals(self, theta: Float) -> Float:
        """Return the whitened innovations (m,) of all windows, with the filter matched to ``theta`` (k,)."""
        return self.compute_residual_columns(theta[None])[:, 0]

    @property
    def has_slow_voltage(self) -> bool:
        """Whether the voltage is sampled more slowly than the drive's signals."""
        return any(m.slow is not None for m in self.motions)

    def compute_residual_columns(self, thetas: Float) -> Float:
        """Return the whitened innovations (m, q) for each row of ``thetas`` (q, k)."""
        pairs = zip(self.motions, self.noises, strict=True)
        parts = [whiten_innovations(m, thetas, np.tile(s.to_array() ** 2, (len(thetas), 1)))[0] for m, s in pairs]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def compute_shape_effect(self, theta: Float) -> Float:
        """Return the change (m,) of the innovations due to the unknown waveform of the voltage within its samples."""
        if self.has_slow_voltage:
            pairs = zip(self.motions, self.noises, strict=True)
            return np.concatenate([compute_waveform_effect(m, theta, s.to_array() ** 2) for m, s in pairs])
        return self._compute_innovations(theta, 1.0 + SHAPE_DOUBT) - self._compute_innovations(theta, 1.0)

    def compute_term_response(self, theta: Float, courses: Sequence[Sequence[TermRegressor]]) -> Float:
        """Return minus the change (m, q) of the innovations with each of ``courses``, (q,) for every window.

        The innovations are linear in them, so one filter serves all.
        """
        parts = zip(self.motions, self.noises, courses, strict=True)
        return np.concatenate([-_compute_window_response(m, theta, s, own) for m, s, own in parts])

    def compute_waveform_effects(self, theta: Float) -> Float:
        """Return the change (m, c) of the innovations with one deviation of each unknown of the voltage's waveform.

        The first is the shape effect; in long samples the regulators' part has its own column.
        """
        shape = self.compute_shape_effect(theta)[:, None]
        if any(m.within is None for m in self.motions):
            return shape
        pairs = zip(self.motions, self.filters, strict=True)
        return np.column_stack([shape, np.concatenate([compute_waveform_response(m, theta, f) for m, f in pairs])])

    def _compute_innovations(self, theta: Float, emf_share: float) -> Float:
        pairs = zip(self.motions, self.filters, strict=True)
        return np.concatenate([compute_innovations(m, theta, f, emf_share=emf_share) for m, f in pairs])


@dataclass(frozen=True, slots=True, eq=False)
class LikelihoodFit:
    """A finished fit: ``theta`` (7 + terms,), information (k, k) of the ``free`` entries, innovations (m,), noises.

    ``delay_doubt_s`` is the part of a delay that may be waveform within samples, or the reverse. ``prior`` (k,) is the
    information known beforehand, on the diagonal, and ``prior_std`` (k,) its standard deviation; empty: none.
    """

    theta: Float
    information: Float
    free: tuple[int, ...]
    residuals: Float
    jacobian: Float
    problem: FitProblem
    converged: bool
    delay_doubt_s: float = 0.0
    prior: Float = field(default_factory=lambda: np.zeros(0))
    prior_std: Float = field(default_factory=lambda: np.zeros(0))

    @property
    def jacobian_without_delay(self) -> Float:
        """The jacobian (m, k) without the delay's column."""
        if DELAY not in self.free:
            return self.jacobian
        at = self.free.index(DELAY)  # a slice keeps the order in memory, and with it the last bit
        before, after = self.jacobian[:, :at], self.jacobian[:, at + 1 :]
        return np.column_stack([before, after]) if after.size else before

    def split_by_window(self, values: Float) -> list[Float]:
        """Return ``values`` (m, ...) of all innovations split by window."""
        return np.split(values, np.cumsum([2 * m.n + m.samples for m in self.problem.motions])[:-1])

    def split_by_equation(self) -> dict[str, Float]:
        """Return the innovations of [5], of the current or of a low-rate voltage, and of [6], the speed's."""
        pairs = list(zip(self.problem.motions, self.split_by_window(self.residuals), strict=True))
        return {
            "electrical": np.concatenate([e[2 * m.n :] if m.slow is not None else e[0::2] for m, e in pairs]),
            "mechanical": np.concatenate([e[1 : 2 * m.n : 2] for m, e in pairs]),
        }


def set_delay(theta: Float, delay_s: float) -> Float:
    """Return ``theta`` (k,) with another delay."""
    changed = theta.copy()
    changed[DELAY] = delay_s
    return changed


def exclude_delay(free: Sequence[int]) -> list[int]:
    """Return the ``free`` entries without the delay."""
    return [j for j in free if j != DELAY]


def build_problem(motions: Sequence[Motion], theta: Float, noises: Sequence[NoiseLevels]) -> FitProblem:
    """Return the problem with the filters made for ``theta``."""
    filters = tuple(compute_filter_gains(m, theta, s) for m, s in zip(motions, noises, strict=True))
    return FitProblem(tuple(motions), tuple(noises), filters)


def compute_jacobian(problem: FitProblem, theta: Float, base: Float, free: Sequence[int], scales: Float) -> Float:
    """Return minus the derivative (m, k) of the innovations by the ``free`` entries of theta, filter included."""
    late = [j - FIRST_TERM for j in free if j >= FIRST_TERM]  # they come last
    joined = [[m.courses[j] for j in late] for m in problem.motions]
    free = [j for j in free if j < FIRST_TERM]
    steps = np.array([DELAY_DIFFERENCE_S if j == DELAY else DIFFERENCE * scales[j] for j in free])
    moved = np.tile(theta, (len(free), 1))
    moved[np.arange(len(free)), list(free)] += steps
    changes: Float = (base[:, None] - problem.compute_residual_columns(moved)) / steps
    return np.column_stack([changes, problem.compute_term_response(theta, joined)]) if late else changes


def _compute_window_response(
    motion: Motion, theta: Float, noise: NoiseLevels, courses: Sequence[TermRegressor]
) -> Float:
    if motion.slow is not None:
        variances = noise.to_array() ** 2
        base = compute_low_rate_innovations(motion, theta, variances).whitened
        return np.column_stack(
            [_compute_low_rate_response(motion, theta, variances, course) - base for course in courses]
        )
    gains = compute_filter_gains(motion, theta, noise)
    changes = np.empty((2 * motion.n, len(courses)))
    for kind in (LOAD, VOLTAGE, SPEED):
        of_kind = [k for k, course in enumerate(courses) if course.kind == kind]
        if of_kind:
            values = np.stack([courses[k].values for k in of_kind])
            rises = np.zeros_like(values) if kind == VOLTAGE else None
            changes[:, of_kind] = compute_signal_response(motion, theta, gains, kind, values, rises)
    return changes


def _compute_low_rate_response(motion: Motion, theta: Float, variances: Float, course: TermRegressor) -> Float:
    if course.kind == SPEED:
        return compute_low_rate_innovations(
            replace(motion, speed=motion.speed + course.values), theta, variances
        ).whitened
    return compute_low_rate_innovations(motion, theta, variances, more_nm=course.values).whitened


def estimate_typical_sizes(theta: Float, motions: Sequence[Motion]) -> Float:
    """Return the typical size (k,) of each entry; friction is sized by the torque and speed of the windows."""
    torque = abs(theta[K]) * max(float(np.abs(m.current).max()) for m in motions)
    speed = max(float(np.abs(m.speed).max()) for m in motions)
    sizes = np.abs(theta)
    sizes[FT] = max(sizes[FT], 1e-3 * torque / speed)
    sizes[CD] = max(sizes[CD], 1e-3 * torque)
    sizes[FIRST_TERM:] = np.maximum(sizes[FIRST_TERM:], 1e-3 * torque)
    return sizes


def run_gauss_newton(
    problem: FitProblem, theta: Float, free: Sequence[int], enough: float = CONVERGED
) -> tuple[Float, Float, Float, bool]:
    """Run Gauss-Newton until a step is below ``enough`` standard deviations.

    Return theta, innovations (m,), jacobian (m, k), and success. The jacobian is the expensive part and hardly changes
    near the minimum: it is reused while each step is much shorter than the one before.
    """
    residuals = problem.compute_residuals(theta)
    last, j, inverse, norms = 0.0, *_linearise_residuals(problem, theta, residuals, free)
    for _ in range(STEPS):
        step = inverse @ (j.T @ residuals)
        size = float(np.abs(step * norms).max())
        if last and size > KEPT * last:
            j, inverse, norms = _linearise_residuals(problem, theta, residuals, free)
            step = inverse @ (j.T @ residuals)
            size = float(np.abs(step * norms).max())
        if not np.isfinite(norms).all() or (norms == 0).any():
            return theta, residuals, j, False
        share, ceiling = 1.0, float(residuals @ residuals) * (1 + SLACK)
        while share > 1e-3:
            trial = theta.copy()
            trial[list(free)] += share * step
            if is_admissible(trial):
                moved = problem.compute_residuals(trial)
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


def _linearise_residuals(
    problem: FitProblem, theta: Float, residuals: Float, free: Sequence[int]
) -> tuple[Float, Float, Float]:
    """Return the jacobian (m, k), the inverse (k, k) of its Gram matrix, and the lengths (k,) of its columns."""
    j = compute_jacobian(problem, theta, residuals, free, estimate_typical_sizes(theta, problem.motions))
    gram = j.T @ j
    return j, invert_symmetric(gram)[0], np.sqrt(np.diag(gram))


def fit_parameters_and_noise(
    motions: Sequence[Motion], start: Float, free: Sequence[int], known: Sequence[NoiseLevels] = ()
) -> LikelihoodFit:
    """Alternate between parameters and noise levels, from ``start`` (k,) and the ``known`` levels of an earlier fit."""
    theta, noises = start.copy(), list(known) or [m.noise for m in motions]
    for turn in range(RENEWALS):
        problem = FitProblem(tuple(motions), tuple(noises), ())
        before = theta
        if problem.has_slow_voltage:
            likelihood = LowRateLikelihood(problem.motions, problem.noises)
            theta, residuals, j, converged = maximise_likelihood(
                likelihood, theta, free, estimate_typical_sizes(theta, motions)
            )
        else:
            theta, residuals, j, converged = run_gauss_newton(
                problem, theta, free, CONVERGED if turn or known else ROUGH
            )
        information = j.T @ j
        moved = theta[list(free)] - before[list(free)]
        if (turn or known) and float(moved @ information @ moved) < SETTLED:
            break
        noises = [fit_noise(m, theta, s) for m, s in zip(motions, noises, strict=True)]
    return LikelihoodFit(
        theta, information, tuple(free), residuals, j, build_problem(motions, theta, problem.noises), converged
    )
