"""Refines the Stribeck speed from the nearest one on the grid: Gauss-Newton jointly with all free entries."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.identification.candidate_terms import SPEEDS, build_stribeck_regressor, build_stribeck_slope_regressor
from fdhil.identification.kalman import DELAY
from fdhil.identification.likelihood_fit import LikelihoodFit, fit_parameters_and_noise
from fdhil.identification.normal_equations import invert_symmetric
from fdhil.identification.prepared_motion import Motion, TermRegressor
from fdhil.records import Float

TURNS = 3
SPREAD = 0.5  # of the speed: its prior
ENOUGH = 0.2  # standard deviations: smaller steps end the search
BEYOND = 1.25  # factor by which it may lie beyond the grid
MOST = 1.6  # factor: longer steps would leave the linear range


def estimate_marginal_step(
    result: LikelihoodFit, courses: Sequence[Sequence[TermRegressor]], prior: float
) -> tuple[float, float, Float]:
    """Return step and standard deviation of an amplitude given all free entries, and its effect on those entries.

    ``courses`` has one regressor for each window, ``prior`` is information about the amplitude from outside the data.
    """
    direction = result.problem.compute_term_response(result.theta, courses)[:, 0]
    shares = invert_symmetric(result.information)[0] @ (result.jacobian.T @ direction)
    beyond = direction - result.jacobian @ shares
    information = float(beyond @ beyond) + prior
    return float(beyond @ result.residuals) / information, information**-0.5, -(information**-0.5) * shares


def find_stribeck_term(motions: Sequence[Motion]) -> int | None:
    """Return the index of the Stribeck term among the terms; None without one."""
    return next((k for k, course in enumerate(motions[0].courses) if course.name == "stribeck"), None)


def compute_stribeck_slope(result: LikelihoodFit, k: int) -> tuple[list[list[TermRegressor]], float]:
    """Return the derivative of Stribeck friction by its speed, N.m per rad/s, by window, and the prior information."""
    size, speed = float(result.theta[DELAY + 1 + k]), result.problem.motions[0].courses[k].speed_rad_s
    made = [build_stribeck_slope_regressor(m, m.courses[k]) for m in result.problem.motions]
    return [[replace(course, values=course.values * size)] for course in made], (SPREAD * speed) ** -2


def refine_stribeck_speed(result: LikelihoodFit) -> LikelihoodFit:
    """Return the fit with the Stribeck speed that explains most; the fit itself without a Stribeck term."""
    k = find_stribeck_term(result.problem.motions)
    if k is None:
        return result
    for _ in range(TURNS):
        if not (result.converged and np.isfinite(result.residuals).all()):
            return result
        courses, prior = compute_stribeck_slope(result, k)
        step, own, _ = estimate_marginal_step(result, courses, prior)
        if abs(step) < ENOUGH * own:
            return result
        speed = result.problem.motions[0].courses[k].speed_rad_s
        low, high = _compute_observable_range(result.problem.motions)
        moved = _refit_at_speed(
            result, k, float(np.clip(speed + step, max(low, speed / MOST), min(high, speed * MOST)))
        )
        if not moved.converged:
            return result
        result = moved
        if is_speed_unobservable(result.problem.motions):
            break
    return result


def is_speed_unobservable(motions: Sequence[Motion]) -> bool:
    """Return whether the Stribeck speed lies outside the range that the samples determine."""
    k = find_stribeck_term(motions)
    if k is None:
        return False
    low, high = _compute_observable_range(motions)
    return not low < motions[0].courses[k].speed_rad_s < high


def _compute_observable_range(motions: Sequence[Motion]) -> tuple[float, float]:
    """Return the range of speeds that the samples determine: below it none moves so slowly, and any amplitude fits."""
    top = max(float(np.abs(m.speed).max()) for m in motions)
    return float(SPEEDS[0]) * top / BEYOND, float(SPEEDS[-1]) * top * BEYOND


def _refit_at_speed(result: LikelihoodFit, k: int, speed_rad_s: float) -> LikelihoodFit:
    motions = []
    for motion in result.problem.motions:
        courses = (*motion.courses[:k], build_stribeck_regressor(motion, speed_rad_s), *motion.courses[k + 1 :])
        motions.append(replace(motion, courses=courses))
    return replace(
        fit_parameters_and_noise(motions, result.theta, result.free, result.problem.noises),
        delay_doubt_s=result.delay_doubt_s,
    )
