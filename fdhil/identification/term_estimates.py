"""Tells the terms of a fit beside the six: ripples as amplitude and phase, and what was not a free entry of the fit.

The speed at which friction falls off was chosen from a grid, and a speed's lag before the fit: neither is known without
an error, and what that error makes of the others is added to their covariance.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from fdhil.identification.fit import Fit
from fdhil.identification.kalman import DELAY, SPEED
from fdhil.identification.motion import Course
from fdhil.identification.normal import inverse_of
from fdhil.identification.ripple_parts import as_amplitude
from fdhil.identification.spring import DAMPING, DAMPING_DOUBT
from fdhil.identification.terms import stribeck_slope
from fdhil.records import PARAMETERS, Estimate, Float

SPACING = 0.1  # of a speed on the grid: one standard deviation of where between two of them the best lies
SPREAD = 0.5  # of it: what is known of such a speed beforehand


def told_terms(six: Estimate, result: Fit, values: Float, beyond: Float) -> tuple[Estimate, Float]:
    """Return the estimate with the terms, and what is ``beyond`` its covariance (k, k) turned in the same way.

    ``six`` is the estimate with the covariance of all entries of theta but the delay, whose ``values`` are given.
    """
    names = (*PARAMETERS, *(course.name for course in result.problem.motions[0].courses))
    assert six.systematic is not None
    covariance, systematic, told = six.covariance, six.systematic, values.copy()
    told[len(PARAMETERS) :] += [course.about for course in result.problem.motions[0].courses]
    for name, value, own, effect in _chosen_before(result):
        moved = np.pad(effect, (0, told.size - effect.size))
        wider = np.empty((told.size + 1, told.size + 1))
        wider[:-1, :-1] = covariance + np.outer(moved, moved)
        wider[-1, :-1] = wider[:-1, -1] = own * moved
        wider[-1, -1] = own**2
        covariance, told, names = wider, np.append(told, value), (*names, name)
        systematic, beyond = np.pad(systematic, ((0, 1), (0, 0))), np.pad(beyond, (0, 1))
    beyond = as_amplitude(names, told, beyond, systematic)[1]
    told, covariance, systematic = as_amplitude(names, told, covariance, systematic)
    return replace(six, names=names, values=told, covariance=covariance, systematic=systematic), beyond


def _chosen_before(result: Fit) -> list[tuple[str, float, float, Float]]:
    """Return name, value and deviation of what was chosen before the fit, and what one deviation makes of theta."""
    motions = result.problem.motions
    found = []
    for k, course in enumerate(motions[0].courses):
        if course.name == "stribeck":
            size = float(result.theta[DELAY + 1 + k])
            slopes = [[_scaled(stribeck_slope(m, m.courses[k]), size)] for m in motions]
            prior = 1.0 / (SPREAD * course.speed_rad_s) ** 2
            own, effect = _marginal(result, slopes, prior)
            found.append(("stribeck_speed", course.speed_rad_s, math.hypot(own, SPACING * course.speed_rad_s), effect))
    found += [(c.name, c.about, DAMPING_DOUBT, np.zeros(0)) for c in motions[0].known if c.name == DAMPING]
    late = motions[0].speed_late
    if late is not None:
        slopes = [[Course("speed_delay", SPEED, -np.gradient(m.speed, m.dt_s))] for m in motions]
        found.append(("speed_delay", *late, _marginal(result, slopes, 1.0 / late[1] ** 2)[1]))
    return found


def _scaled(course: Course, size: float) -> Course:
    return replace(course, values=course.values * size)


def _marginal(result: Fit, courses: list[list[Course]], prior: float) -> tuple[float, Float]:
    """Return the deviation of an amplitude beside all that is free, and what that makes of the entries of theta.

    ``prior`` is the information about it that the data do not hold.
    """
    direction = result.problem.answer(result.theta, courses)[:, 0]
    shares = inverse_of(result.information)[0] @ (result.jacobian.T @ direction)
    beyond = direction - result.jacobian @ shares
    own = (float(beyond @ beyond) + prior) ** -0.5
    kept = [k for k, j in enumerate(result.free) if j != DELAY]
    return own, -own * shares[kept]
