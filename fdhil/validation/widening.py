"""Widens the intervals of an estimate by what its window shows beyond the model.

Whatever moves the innovations in a direction that the parameters partly imitate has moved the parameters, too. By how
much is known with its amplitude (White 1982: a model that is nearly right is biased by the projection of what it
lacks). What surely is there and was not fitted is taken as one standard deviation of a doubt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.records import PARAMETERS, Estimate, Float, frozen
from fdhil.validation.selection import Lacking


def widened(estimate: Estimate, fit: Fit, lacks: Sequence[Lacking]) -> Estimate:
    """Return the estimate with the shifts by all that the model surely lacks added to its covariance."""
    if not lacks:
        return estimate
    doubts = np.column_stack([_of_names(estimate, fit, lack.shift) for lack in lacks])
    return replace(estimate, covariance=frozen(estimate.covariance + doubts @ doubts.T))


def _of_names(estimate: Estimate, fit: Fit, shift: Float) -> Float:
    """Return the shift (k,) of what the estimate names: the six first, of the fit's columns, and last the terms."""
    moved = np.zeros(len(estimate.names))
    moved[: len(PARAMETERS)] = shift[: len(PARAMETERS)]
    terms = len(fit.jacobian[0]) - len(fit.free)
    if terms > 0 and len(PARAMETERS) + terms == len(estimate.names):
        moved[len(PARAMETERS) :] = shift[len(fit.free) :]
    return moved
