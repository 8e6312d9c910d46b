"""Adds a spring between motor and table to a window's fit, from the resonance in the motor's own encoder.

Its torque is linearised in the resonance f and in the table's share s of the inertia, over a few iterations.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.fit import Fit, fit, pose
from fdhil.identification.innovations import whiten
from fdhil.identification.kalman import LOAD
from fdhil.identification.motion import BROKEN_MODE, UNKNOWN_MODE, Course, Modes, Motion, Noise
from fdhil.identification.normal import inverse_of
from fdhil.identification.spring_torques import LEAST_SHARE, MOST_OF_ROWS, MOST_SHARE, Spring, Torques
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
class Told:
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

    def precision(self) -> Float:
        """Return (2,) the prior information about f and s."""
        return self.std**-2.0 * (FIRM if self.firm else 1.0)

    def allows(self, spring: Spring) -> bool:
        """Return whether a spring is plausible: one far from the prior stands for something else."""
        near = abs(spring.hertz / self.hertz - 1.0) < (FAR if self.hertz_std < self.hertz else SEARCHED_DOUBT)
        return near and LEAST_SHARE < spring.share < MOST_SHARE

    def away(self, spring: Spring) -> Float:
        """Return (2,) the difference between the prior's f and s and those of ``spring``."""
        return np.array([self.hertz - spring.hertz, USUAL_SHARE - spring.share])

    def cost(self, spring: Spring) -> float:
        """Return minus twice the log likelihood of a spring by the prior."""
        return float(self.precision() @ self.away(spring) ** 2)


def sprung(base: Fit, axis: Axis | None) -> Fit | None:
    """Return the fit of one window with the configured or a significant resonance; None without one.

    f and s of a configured resonance combine prior and data.
    """
    motion = base.problem.motions[0]
    if motion.slow is not None or not base.converged or not np.isfinite(base.residuals).all():
        return None
    expected = None
    if axis is not None and axis.resonance_hz is not None:
        expected = Told(axis.resonance_hz, CONFIGURED_DOUBT * axis.resonance_hz, axis.resonance_damping)
    grid = GRID if expected is None else AROUND * expected.hertz
    # a configured resonance above the samples' band still acts below it
    grid = grid[grid * motion.dt_s < MOST_OF_ROWS * (1 if expected is None else 2)]
    if not grid.size:
        return None
    scores = _scores(base, grid)
    best = float(grid[int(np.argmax(scores))])
    if expected is None and scores.max() < SURE:
        return None
    known = expected or Told(best, SEARCHED_DOUBT * best)
    found = _turned(base, Spring(best, USUAL_SHARE, known.damping), known)
    if expected is not None:
        if found is None:
            found = _turned(base, Spring(expected.hertz, USUAL_SHARE, expected.damping), replace(expected, firm=True))
        return None if found is None else found[0]
    return found[0] if found is not None and _cost(base) - found[1] > SURE else None


def _scores(base: Fit, grid: Float) -> Float:
    motion, theta = base.problem.motions[0], base.theta
    torques = Torques.of(motion, theta)
    springs = [Spring(float(hertz), USUAL_SHARE, USUAL_DAMPING) for hertz in grid]
    columns = base.problem.answer(theta, [[Course(RESONANCE, LOAD, values) for values in torques.begun(springs)]])
    jacobian, inverse = base.jacobian, inverse_of(base.information)[0]
    beyond = columns - jacobian @ (inverse @ (jacobian.T @ columns))
    powers = np.maximum(np.einsum("mg,mg->g", beyond, beyond), 1e-12)
    scores: Float = np.square(beyond.T @ base.residuals) / powers
    return scores


def _turned(base: Fit, spring: Spring, expected: Told) -> tuple[Fit, float] | None:
    plain, theta = base.problem.motions[0], base.theta
    free = (*base.free, theta.size, theta.size + 1)
    noises: Sequence[Noise] = ()
    for _ in range(TURNS):
        fitted = fit([_bent(plain, theta, spring)], np.append(theta, [0.0, 0.0]), free, noises)
        if not fitted.converged or not np.isfinite(fitted.residuals).all():
            return None
        fitted, noises = _with_prior(fitted, spring, expected), fitted.problem.noises
        theta, before = fitted.theta[:-2], spring
        spring = spring.moved(*fitted.theta[-2:])
        if not expected.allows(spring):
            return None
        if (np.abs([spring.hertz / before.hertz - 1, spring.share - before.share]) < SETTLED).all():
            break
    torques = Torques.of(plain, theta)
    cost = _cost(fitted) + expected.cost(spring) + torques.squeezed(torques.answer(spring))
    return replace(fitted, delay_doubt_s=base.delay_doubt_s), cost


def _bent(plain: Motion, theta: Float, spring: Spring) -> Motion:
    torques = Torques.of(plain, theta)
    answer = torques.answer(spring)

    def slope(hertz: float, share: float) -> Float:
        high, low = (
            replace(spring, hertz=spring.hertz + k * hertz, share=spring.share + k * share) for k in (0.5, -0.5)
        )
        return torques.slope(answer, high, low)

    by_hertz = slope(STEP * spring.hertz, 0.0) / (STEP * spring.hertz)
    return replace(
        plain,
        mode=_surely(plain),
        noise_floor=LEAST_NOISE,
        courses=(
            *(torques.with_answer(course, answer) for course in plain.courses),
            Course(RESONANCE, LOAD, by_hertz, about=spring.hertz),
            Course(SHARE, LOAD, slope(0.0, STEP) / STEP, about=spring.share),
        ),
        known=(*plain.known, Course(DAMPING, LOAD, torques.felt(answer), about=spring.damping)),
    )


def _surely(motion: Motion) -> Modes:
    reach = math.ceil(NEAR_REST_S / motion.dt_s)
    near = np.convolve(motion.mode == UNKNOWN_MODE, np.ones(2 * reach + 1), "same") > 0.0
    return np.where(near & (motion.mode != BROKEN_MODE), UNKNOWN_MODE, motion.mode).astype(np.int8)


def _with_prior(fitted: Fit, spring: Spring, expected: Told) -> Fit:
    prior, std = np.zeros((2, len(fitted.free)))
    prior[-2:], std[-2:] = expected.precision(), expected.std
    information = fitted.information + np.diag(prior)
    theta, pull = fitted.theta.copy(), np.zeros(len(fitted.free))
    pull[-2:] = prior[-2:] * (expected.away(spring) - theta[-2:])
    theta[list(fitted.free)] += inverse_of(information)[0] @ pull
    problem = pose(fitted.problem.motions, theta, fitted.problem.noises)
    residuals = problem.residuals(theta)
    fitted = replace(fitted, theta=theta, information=information, residuals=residuals, problem=problem)
    return replace(fitted, prior=prior, prior_std=std)


def _cost(fitted: Fit) -> float:
    motion = fitted.problem.motions[0]
    variances = np.maximum(fitted.problem.noises[0].vector(), LEAST_NOISE * motion.noise.vector()) ** 2
    if not any(course.name == RESONANCE for course in motion.courses):
        motion = replace(motion, mode=_surely(motion))
    white, logdet = whiten(motion, fitted.theta[None], variances[None])
    return float(np.square(white).sum() + logdet[0])
