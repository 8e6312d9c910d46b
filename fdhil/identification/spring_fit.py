"""Adds a spring between motor and table to a window's fit, from the resonance in the motor's own encoder.

Its torque is linearised in the resonance f and in the table's share s of the inertia, over a few iterations.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.innovations import whiten_innovations
from fdhil.identification.kalman import LOAD
from fdhil.identification.likelihood_fit import LikelihoodFit, build_problem, fit_parameters_and_noise
from fdhil.identification.normal_equations import invert_symmetric
from fdhil.identification.prepared_motion import BROKEN_MODE, UNKNOWN_MODE, Modes, Motion, NoiseLevels, TermRegressor
from fdhil.identification.spring_torques import LEAST_SHARE, MOST_OF_ROWS, MOST_SHARE, Spring, SpringTorques
from fdhil.records import Float

RESONANCE, SHARE, DAMPING = "resonance", "resonance_share", "resonance_damping"
USUAL_DAMPING, DAMPING_DOUBT = 0.03, 0.02  # of ordinary screws: the data hardly show it
USUAL_SHARE, SHARE_DOUBT = 0.5, 0.15  # prior of the inertia behind the spring
CONFIGURED_DOUBT = 0.05  # relative, of a configured resonance
SEARCHED_DOUBT = 1.0  # relative, of a searched one
GRID = np.geomspace(40.0, 320.0, 24)  # Hz, of the search
AROUND = np.array([0.92, 0.96, 1.0, 1.04, 1.08])  # of a configured resonance: starts of the fit
FAR, FIRM = 0.35, 1e4  # relative distance from the configured resonance; factor of the prior that fixes it
TURNS = 4
SETTLED = np.array([0.005, 0.01])  # relative in f, and in s
STEP = 0.02  # of f and s, for their derivatives
SURE = 40.0  # fall of minus twice the log likelihood: by chance once in millions of grids
NEAR_REST_S = 0.025  # in which the motor does not show when the table breaks away, or stops
LEAST_NOISE = 0.3  # of the visible noise: with less, an inexact vibration would be impossible by chance


@dataclass(frozen=True, slots=True)
class SpringPrior:
    """Prior of a spring: f in Hz with its standard deviation; s as usual."""

    hertz: float
    hertz_std: float
    damping: float = USUAL_DAMPING
    firm: bool = False
    """Whether the data are not asked for f and s."""

    @property
    def std(self) -> Float:
        """The standard deviations (2,) of f and s."""
        return np.array([self.hertz_std, SHARE_DOUBT])

    def compute_precision(self) -> Float:
        """Return (2,) the prior information about f and s."""
        return self.std**-2.0 * (FIRM if self.firm else 1.0)

    def is_plausible(self, spring: Spring) -> bool:
        """Return whether a spring is plausible: one far from the prior stands for something else."""
        near = abs(spring.hertz / self.hertz - 1.0) < (FAR if self.hertz_std < self.hertz else SEARCHED_DOUBT)
        return near and LEAST_SHARE < spring.share < MOST_SHARE

    def compute_offset(self, spring: Spring) -> Float:
        """Return (2,) the difference between the prior's f and s and those of ``spring``."""
        return np.array([self.hertz - spring.hertz, USUAL_SHARE - spring.share])

    def compute_cost(self, spring: Spring) -> float:
        """Return minus twice the log likelihood of a spring by the prior."""
        return float(self.compute_precision() @ self.compute_offset(spring) ** 2)


def fit_with_compliance(base: LikelihoodFit, axis: Axis | None) -> LikelihoodFit | None:
    """Return the fit of one window with the configured or a significant resonance; None without one.

    f and s of a configured resonance combine prior and data.
    """
    motion = base.problem.motions[0]
    if motion.slow is not None or not base.converged or not np.isfinite(base.residuals).all():
        return None
    expected = None
    if axis is not None and axis.resonance_hz is not None:
        expected = SpringPrior(axis.resonance_hz, CONFIGURED_DOUBT * axis.resonance_hz, axis.resonance_damping)
    grid = GRID if expected is None else AROUND * expected.hertz
    # a configured resonance above the samples' band still acts below it
    grid = grid[grid * motion.dt_s < MOST_OF_ROWS * (1 if expected is None else 2)]
    if not grid.size:
        return None
    scores = _score_frequencies(base, grid)
    best = float(grid[int(np.argmax(scores))])
    if expected is None and scores.max() < SURE:
        return None
    known = expected or SpringPrior(best, SEARCHED_DOUBT * best)
    found = _fit_spring(base, Spring(best, USUAL_SHARE, known.damping), known)
    if expected is not None:
        if found is None:
            found = _fit_spring(
                base, Spring(expected.hertz, USUAL_SHARE, expected.damping), replace(expected, firm=True)
            )
        return None if found is None else found[0]
    return found[0] if found is not None and _compute_cost(base) - found[1] > SURE else None


def _score_frequencies(base: LikelihoodFit, grid: Float) -> Float:
    motion, theta = base.problem.motions[0], base.theta
    torques = SpringTorques.from_motion(motion, theta)
    springs = [Spring(float(hertz), USUAL_SHARE, USUAL_DAMPING) for hertz in grid]
    columns = base.problem.compute_term_response(
        theta, [[TermRegressor(RESONANCE, LOAD, values) for values in torques.predict_added_torques(springs)]]
    )
    jacobian, inverse = base.jacobian, invert_symmetric(base.information)[0]
    beyond = columns - jacobian @ (inverse @ (jacobian.T @ columns))
    powers = np.maximum(np.einsum("mg,mg->g", beyond, beyond), 1e-12)
    scores: Float = np.square(beyond.T @ base.residuals) / powers
    return scores


def _fit_spring(base: LikelihoodFit, spring: Spring, expected: SpringPrior) -> tuple[LikelihoodFit, float] | None:
    plain, theta = base.problem.motions[0], base.theta
    free = (*base.free, theta.size, theta.size + 1)
    noises: Sequence[NoiseLevels] = ()
    for _ in range(TURNS):
        fitted = fit_parameters_and_noise(
            [_add_spring_regressors(plain, theta, spring)], np.append(theta, [0.0, 0.0]), free, noises
        )
        if not fitted.converged or not np.isfinite(fitted.residuals).all():
            return None
        fitted, noises = _apply_prior(fitted, spring, expected), fitted.problem.noises
        theta, before = fitted.theta[:-2], spring
        spring = spring.apply_step(*fitted.theta[-2:])
        if not expected.is_plausible(spring):
            return None
        if (np.abs([spring.hertz / before.hertz - 1, spring.share - before.share]) < SETTLED).all():
            break
    torques = SpringTorques.from_motion(plain, theta)
    cost = (
        _compute_cost(fitted)
        + expected.compute_cost(spring)
        + torques.compute_scaling_cost(torques.compute_response(spring))
    )
    return replace(fitted, delay_doubt_s=base.delay_doubt_s), cost


def _add_spring_regressors(plain: Motion, theta: Float, spring: Spring) -> Motion:
    torques = SpringTorques.from_motion(plain, theta)
    answer = torques.compute_response(spring)

    def compute_slope(hertz: float, share: float) -> Float:
        high, low = (
            replace(spring, hertz=spring.hertz + k * hertz, share=spring.share + k * share) for k in (0.5, -0.5)
        )
        return torques.compute_torque_difference(answer, high, low)

    by_hertz = compute_slope(STEP * spring.hertz, 0.0) / (STEP * spring.hertz)
    return replace(
        plain,
        mode=_exclude_standstill(plain),
        noise_floor=LEAST_NOISE,
        courses=(
            *(torques.apply_response(course, answer) for course in plain.courses),
            TermRegressor(RESONANCE, LOAD, by_hertz, about=spring.hertz),
            TermRegressor(SHARE, LOAD, compute_slope(0.0, STEP) / STEP, about=spring.share),
        ),
        known=(*plain.known, TermRegressor(DAMPING, LOAD, torques.compute_felt_torque(answer), about=spring.damping)),
    )


def _exclude_standstill(motion: Motion) -> Modes:
    reach = math.ceil(NEAR_REST_S / motion.dt_s)
    near = np.convolve(motion.mode == UNKNOWN_MODE, np.ones(2 * reach + 1), "same") > 0.0
    return np.where(near & (motion.mode != BROKEN_MODE), UNKNOWN_MODE, motion.mode).astype(np.int8)


def _apply_prior(fitted: LikelihoodFit, spring: Spring, expected: SpringPrior) -> LikelihoodFit:
    prior, std = np.zeros((2, len(fitted.free)))
    prior[-2:], std[-2:] = expected.compute_precision(), expected.std
    information = fitted.information + np.diag(prior)
    theta, pull = fitted.theta.copy(), np.zeros(len(fitted.free))
    pull[-2:] = prior[-2:] * (expected.compute_offset(spring) - theta[-2:])
    theta[list(fitted.free)] += invert_symmetric(information)[0] @ pull
    problem = build_problem(fitted.problem.motions, theta, fitted.problem.noises)
    residuals = problem.compute_residuals(theta)
    fitted = replace(fitted, theta=theta, information=information, residuals=residuals, problem=problem)
    return replace(fitted, prior=prior, prior_std=std)


def _compute_cost(fitted: LikelihoodFit) -> float:
    motion = fitted.problem.motions[0]
    variances = np.maximum(fitted.problem.noises[0].to_array(), LEAST_NOISE * motion.noise.to_array()) ** 2
    if not any(course.name == RESONANCE for course in motion.courses):
        motion = replace(motion, mode=_exclude_standstill(motion))
    white, logdet = whiten_innovations(motion, fitted.theta[None], variances[None])
    return float(np.square(white).sum() + logdet[0])
