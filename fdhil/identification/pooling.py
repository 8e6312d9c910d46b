"""Combines the estimates of several windows of one drive, and tells how far two of them may lie apart by chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.identification.covariance import aliasing
from fdhil.records import PARAMETERS, Estimate, Float, Window, frozen

# of a doubt that windows of one drive share, what may still differ between them: its size depends on the regulators,
# which are the same, and a little on the move
UNSHARED = 0.2


def weighted(told: Sequence[tuple[Window, Estimate]]) -> Estimate | None:
    """Return the estimates weighted by the inverse covariance of each window's own chance; None when one lacks a value.

    What windows share (the systematic part, and what instants of the voltage miss) does not average away: it goes
    through the same weights.
    """
    first = told[0][1]
    scale = np.where(first.values != 0.0, np.abs(first.values), 1.0)  # the parameters differ by orders of magnitude
    information = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    pull = np.zeros(len(PARAMETERS))
    shared = np.zeros((len(PARAMETERS), 2 + len(PARAMETERS)))
    for window, estimate in told:
        if not (np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()):
            return None
        own, systematic, alias = _parts(window, estimate)
        weight = np.linalg.inv(own / np.outer(scale, scale))
        information += weight
        pull += weight @ (estimate.values / scale)
        shared += weight @ (np.column_stack([systematic, np.diag(alias)]) / scale[:, None])
    covariance = np.linalg.inv(information)
    doubts = (covariance @ shared) * scale[:, None]
    return replace(
        first,
        values=frozen(covariance @ pull * scale),
        covariance=frozen(covariance * np.outer(scale, scale) + doubts @ doubts.T),
        residuals={},
        delay_s=None,
        delay_std_s=None,
        systematic=frozen(doubts[:, :2]),
    )


def difference_covariance(one: tuple[Window, Estimate], other: tuple[Window, Estimate]) -> Float:
    """Return the covariance (6, 6) of the difference between what two windows of one drive tell.

    What is not known of the voltage's course within its samples is the regulators' doing and the same in both: with s
    and t what it does to either estimate, it moves their difference by s - t only, and hides no change of the drive.
    """
    (own, systematic, alias), (its_own, its_systematic, its_alias) = _parts(*one), _parts(*other)
    apart = systematic - its_systematic
    unshared = systematic @ systematic.T + its_systematic @ its_systematic.T + np.diag(alias**2 + its_alias**2)
    covariance: Float = own + its_own + apart @ apart.T + np.diag((alias - its_alias) ** 2) + UNSHARED**2 * unshared
    return covariance


def _parts(window: Window, estimate: Estimate) -> tuple[Float, Float, Float]:
    """Return the covariance (6, 6) of a window's own chance, and the doubts (6, 2) and (6,) that it shares."""
    size = len(PARAMETERS)
    systematic = np.zeros((size, 2)) if estimate.systematic is None else estimate.systematic
    slow = window.slow_voltage
    period = window.dt_s if slow is None else slow.period_s
    alias = aliasing(window.voltage_sampling, period) * np.abs(estimate.values)
    return estimate.covariance - systematic @ systematic.T - np.diag(alias**2), systematic, alias
