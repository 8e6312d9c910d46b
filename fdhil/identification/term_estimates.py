"""Adds the terms of a fit to the estimate: ripples as amplitude and phase, and values that were fixed during the fit.

The errors of the Stribeck speed and of a speed's lag add to the covariance of the others.
"""

from dataclasses import replace

import numpy as np

from fdhil.identification import stribeck_speed
from fdhil.identification.kalman import DELAY, SPEED
from fdhil.identification.likelihood_fit import LikelihoodFit
from fdhil.identification.prepared_motion import TermRegressor
from fdhil.identification.ripple_parts import combine_ripples
from fdhil.identification.spring_fit import DAMPING, DAMPING_DOUBT
from fdhil.records import PARAMETERS, Estimate, Float


def append_terms(six: Estimate, result: LikelihoodFit, values: Float, beyond: Float) -> tuple[Estimate, Float]:
    """Return the estimate with the terms, and the additional covariance ``beyond`` (k, k) in the same coordinates.

    ``six`` is the estimate with the covariance of all entries of theta but the delay, whose ``values`` are given.
    """
    names = (*PARAMETERS, *(course.name for course in result.problem.motions[0].courses))
    assert six.systematic is not None
    covariance, systematic, extended = six.covariance, six.systematic, values.copy()
    extended[len(PARAMETERS) :] += [course.about for course in result.problem.motions[0].courses]
    for name, value, own, effect in _list_nuisance_values(result):
        moved = np.pad(effect, (0, extended.size - effect.size))
        wider = np.empty((extended.size + 1, extended.size + 1))
        wider[:-1, :-1] = covariance + np.outer(moved, moved)
        wider[-1, :-1] = wider[:-1, -1] = own * moved
        wider[-1, -1] = own**2
        covariance, extended, names = wider, np.append(extended, value), (*names, name)
        systematic, beyond = np.pad(systematic, ((0, 1), (0, 0))), np.pad(beyond, (0, 1))
    beyond = combine_ripples(names, extended, beyond, systematic)[1]
    extended, covariance, systematic = combine_ripples(names, extended, covariance, systematic)
    return replace(six, names=names, values=extended, covariance=covariance, systematic=systematic), beyond


def _list_nuisance_values(result: LikelihoodFit) -> list[tuple[str, float, float, Float]]:
    """Return name, value and deviation of each value outside theta, and the effect of one deviation on theta."""
    motions = result.problem.motions
    kept = [k for k, j in enumerate(result.free) if j != DELAY]
    found = []
    low = stribeck_speed.find_stribeck_term(motions)
    if low is not None:
        _, own, effect = stribeck_speed.estimate_marginal_step(
            result, *stribeck_speed.compute_stribeck_slope(result, low)
        )
        found.append(("stribeck_speed", motions[0].courses[low].speed_rad_s, own, effect[kept]))
    found += [(c.name, c.about, DAMPING_DOUBT, np.zeros(0)) for c in motions[0].known if c.name == DAMPING]
    late = motions[0].speed_late
    if late is not None:
        slopes = [[TermRegressor("speed_delay", SPEED, -np.gradient(m.speed, m.dt_s))] for m in motions]
        _, _, effect = stribeck_speed.estimate_marginal_step(result, slopes, 1.0 / late[1] ** 2)
        found.append(("speed_delay", *late, effect[kept]))
    return found
