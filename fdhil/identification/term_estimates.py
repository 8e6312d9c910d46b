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
from fdhil.identification.terms import PHASE, stribeck_slope
from fdhil.records import PARAMETERS, Estimate, Float

SPACING = 0.1  # of a speed on the grid: one standard deviation of where between two of them the best lies
SPREAD = 0.5  # of it: what is known of such a speed beforehand


def told_terms(six: Estimate, result: Fit, values: Float, beyond: Float) -> tuple[Estimate, Float]:
    """Return the estimate with the terms, and what is ``beyond`` its covariance (k, k) turned in the same way.

    ``six`` is the estimate with the covariance of all entries of theta but the delay, whose ``values`` are given.
    """
    motion = result.problem.motions[0]
    names = (*PARAMETERS, *(course.name for course in motion.courses))
    told, turn = _turned(names, values)
    covariance, systematic = turn @ six.covariance @ turn.T, turn @ _columns(six)
    beyond = turn @ beyond @ turn.T
    for name, value, own, effect in _chosen_before(result):
        moved = turn @ effect
        wider = np.empty((len(names) + 1, len(names) + 1))
        wider[:-1, :-1] = covariance + np.outer(moved, moved)
        wider[-1, :-1] = wider[:-1, -1] = own * moved
        wider[-1, -1] = own**2
        covariance, told, names = wider, np.append(told, value), (*names, name)
        systematic, beyond = np.vstack([systematic, np.zeros((1, systematic.shape[1]))]), np.pad(beyond, (0, 1))
        turn = np.vstack([turn, np.zeros((1, turn.shape[1]))])
    return replace(six, names=names, values=told, covariance=covariance, systematic=systematic), beyond


def _columns(six: Estimate) -> Float:
    assert six.systematic is not None
    return six.systematic


def _turned(names: tuple[str, ...], values: Float) -> tuple[Float, Float]:
    """Return the values (k,) with amplitude and phase of each ripple, and their derivatives (k, k) by what was fitted.

    s sin(a) + c cos(a) = A sin(a + phase).
    """
    told, turn = values.copy(), np.eye(values.size)
    for k, name in enumerate(names):
        if name.endswith(PHASE):
            s, c = values[k - 1], values[k]
            size = max(math.hypot(s, c), 1e-300)
            told[k - 1], told[k] = size, math.atan2(c, s)
            turn[k - 1 : k + 1, k - 1 : k + 1] = np.array([[s, c], [-c / size, s / size]]) / size
    return told, turn


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
