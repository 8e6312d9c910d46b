"""Widens the intervals of an estimate by what its window shows beyond the model.

Whatever moves the innovations in a direction that the parameters partly imitate has moved the parameters, too. By how
much is known with its amplitude (White 1982: a model that is nearly right is biased by the projection of what it
lacks). What surely is there and was not fitted is taken as one standard deviation of a doubt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.identification.courses import FIRST_COURSE
from fdhil.identification.fit import Fit
from fdhil.identification.kalman import DELAY
from fdhil.identification.terms import PHASE
from fdhil.records import PARAMETERS, Estimate, Float, frozen
from fdhil.validation.selection import Lacking


def widened(estimate: Estimate, fit: Fit, lacks: Sequence[Lacking]) -> Estimate:
    """Return the estimate with the shifts by all that the model surely lacks added to its covariance."""
    if not lacks:
        return estimate
    doubts = np.column_stack([_worst(estimate, fit, lack) for lack in lacks])
    return replace(estimate, covariance=frozen(estimate.covariance + doubts @ doubts.T))


def _worst(estimate: Estimate, fit: Fit, lack: Lacking) -> Float:
    """Return the shift (k,) by what is lacked or by a rival, whichever moves a parameter by more deviations."""
    shifts = [_of_names(estimate, fit, each.shift) for each in lack.with_rivals]
    deviations = np.sqrt(np.maximum(np.diag(estimate.covariance), np.finfo(np.float64).tiny))
    return max(shifts, key=lambda shift: float(np.abs(shift / deviations).max()))


def _of_names(estimate: Estimate, fit: Fit, shift: Float) -> Float:
    """Return the shift (k,) of what the estimate names, from that of the fit's free entries.

    The parts of a ripple have no name of their own: what moves them is left to their covariance.
    """
    moved = np.zeros(len(estimate.names))
    courses = fit.problem.motions[0].courses
    for entry, by in zip(fit.free, shift, strict=True):
        name = PARAMETERS[entry] if entry < DELAY else courses[entry - FIRST_COURSE].name if entry > DELAY else ""
        if name in estimate.names and f"{name}{PHASE}" not in estimate.names and not name.endswith(PHASE):
            moved[estimate.names.index(name)] = by
    return moved
