"""Widens the intervals of an estimate by what its window shows beyond the model.

An effect that moves the innovations in a direction that the parameters partly imitate has biased the parameters, too.
The bias follows from its amplitude (White 1982: a model that is nearly right is biased by the projection of what it
lacks). A significant deficiency that was not fitted adds its bias as one standard deviation.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from fdhil.identification.courses import FIRST_COURSE
from fdhil.identification.delay import delay_direction
from fdhil.identification.fit import Fit
from fdhil.identification.kalman import DELAY
from fdhil.identification.normal import solve
from fdhil.identification.terms import PHASE
from fdhil.records import PARAMETERS, Estimate, Float, frozen
from fdhil.validation.selection import Lacking

UNKNOWN_WAY = 2.0  # times an interval
LAG_ROWS = 3.0  # lag of a sensor that may go unreported: it looks like the winding's own


def widened(
    estimate: Estimate, fit: Fit, lacks: Sequence[Lacking], restless: Collection[str] = (), nameless: bool = False
) -> Estimate:
    """Return the estimate with the shifts by all significant deficiencies added to its covariance.

    ``restless`` are the signals whose innovations are autocorrelated, or scatter more than they should. Where no
    finding explains that (``nameless``), its effect on the parameters is unknown, and every interval is doubled. Where
    it shows in voltage or current, a sensor may lag, which looks like another winding.
    """
    covariance = estimate.covariance
    for lack in lacks:
        covariance = covariance + _square(_worst(estimate, fit, lack))
    if nameless:
        covariance = UNKNOWN_WAY**2 * covariance
    if {"voltage", "current"} & set(restless):
        covariance = covariance + _square(_of_names(estimate, fit, _lag(fit)))
    return replace(estimate, covariance=frozen(covariance))


def _square(doubt: Float) -> Float:
    return np.outer(doubt, doubt)


def _lag(fit: Fit) -> Float:
    """Return the shift (k,) of a fit's free entries by a voltage that lags ``LAG_ROWS`` rows behind the current."""
    lag_s = LAG_ROWS * fit.problem.motions[0].dt_s
    others = [k for k, j in enumerate(fit.free) if j != DELAY]
    shift = np.zeros(len(fit.free))
    shift[others] = -lag_s * solve(fit.but_delay, delay_direction(fit))[0]
    return shift


def _worst(estimate: Estimate, fit: Fit, lack: Lacking) -> Float:
    """Return the larger shift (k,) in standard deviations, of the deficiency or of an alternative."""
    shifts = [_of_names(estimate, fit, each.shift) for each in lack.with_rivals]
    deviations = np.sqrt(np.maximum(np.diag(estimate.covariance), np.finfo(np.float64).tiny))
    return max(shifts, key=lambda shift: float(np.abs(shift / deviations).max()))


def _of_names(estimate: Estimate, fit: Fit, shift: Float) -> Float:
    """Return the shift (k,) of the estimate's names, from that of the fit's free entries.

    The parts of a ripple have no name of their own: their shift is left to their covariance.
    """
    moved = np.zeros(len(estimate.names))
    courses = fit.problem.motions[0].courses
    for entry, by in zip(fit.free, shift, strict=True):
        name = PARAMETERS[entry] if entry < DELAY else courses[entry - FIRST_COURSE].name if entry > DELAY else ""
        if name in estimate.names and f"{name}{PHASE}" not in estimate.names and not name.endswith(PHASE):
            moved[estimate.names.index(name)] = by
    return moved
