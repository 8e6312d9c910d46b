"""Selects what the model of one window lacks, and widens the estimate's intervals by its bias.

Many alternatives resemble each other, so that one thing that the model lacks shows as several. The most significant is
taken, the others are tested again given it, and so on while one is significant. Together with the parameters they are
then one fit, whose amplitudes show how far the parameters were off without them (White 1982: a model that is nearly
right is biased by the projection of what it lacks). A deficiency that was not fitted adds its bias to the covariance as
one standard deviation.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fdhil.identification import (
    DELAY,
    FIRST_TERM,
    PHASE_SUFFIX,
    LikelihoodFit,
    differentiate_by_delay,
    invert_symmetric,
    solve_least_squares,
)
from fdhil.records import PARAMETERS, Estimate, Float, freeze_array
from fdhil.validation.score_tests import Finding, ScoreTest

NO_WORSE = 3.0  # standard deviations by which an alternative may explain less by chance
UNKNOWN_BIAS = 2.0  # times an interval
LAG_ROWS = 3.0  # lag of a sensor that may go unreported: it looks like the winding's own


@dataclass(frozen=True, slots=True)
class Deficiency:
    """A deficiency of a model: a finding, the shift of the parameters by it (k,), and its torque (n,), N.m, or None.

    The parameters are those of the fit's jacobian, in its order. ``rivals`` explain the same nearly as well, and may be
    present instead.
    """

    finding: Finding
    shift: Float
    load_nm: Float | None
    alternatives: tuple[Deficiency, ...] = ()

    @property
    def with_alternatives(self) -> tuple[Deficiency, ...]:
        """The finding, and its alternatives."""
        return (self, *self.alternatives)


def select_deficiencies(fit: LikelihoodFit, findings: Sequence[Finding]) -> list[Deficiency]:
    """Return the significant deficiencies of the model, the most significant first; none where all may be chance."""
    if not any(finding.is_significant for finding in findings):
        return []
    bench = ScoreTest.prepare(fit)
    directions = np.column_stack([finding.direction for finding in findings])
    score, information = bench.compute_scores(directions)
    whole = np.einsum("mq,mq->q", directions, directions)
    taken: list[int] = []
    similar: list[npt.NDArray[np.intp]] = []
    while len(taken) < len(findings):
        shares = (
            information[:, taken] @ invert_symmetric(information[np.ix_(taken, taken)])[0]
            if taken
            else np.zeros((len(score), 0))
        )
        rest = np.diag(information) - np.einsum("qt,qt->q", shares, information[:, taken])
        statistic, _ = bench.compute_statistics(score - shares @ score[taken], rest, whole)
        statistic[taken] = 0.0
        best = int(np.argmax(np.abs(statistic)))
        if not replace(findings[best], statistic=float(statistic[best])).is_significant:
            break
        taken.append(best)
        similar.append(np.flatnonzero(np.square(statistic) > statistic[best] ** 2 - NO_WORSE**2))
    moved = invert_symmetric(fit.information)[0] @ (fit.jacobian.T @ directions)

    def build_deficiency(n: int, k: int) -> Deficiency:
        places = [*taken[:n], k, *taken[n + 1 :]]
        amplitude = float((invert_symmetric(information[np.ix_(places, places)])[0] @ score[places])[n])
        finding = findings[k]
        load = None if finding.load_nm is None else amplitude * finding.load_nm
        # a sensor's own change has the opposite sign of its correction
        signed = replace(finding, amplitude=amplitude if load is not None else -amplitude)
        return Deficiency(signed, amplitude * moved[:, k], load)

    found = []
    for n, k in enumerate(taken):
        rivals = tuple(build_deficiency(n, int(other)) for other in similar[n] if other not in taken)
        found.append(replace(build_deficiency(n, k), alternatives=rivals))
    return found


def inflate_covariance(
    estimate: Estimate,
    fit: LikelihoodFit,
    lacks: Sequence[Deficiency],
    restless: Collection[str] = (),
    nameless: bool = False,
) -> Estimate:
    """Return the estimate with the shifts by all significant deficiencies added to its covariance.

    ``restless`` are the signals whose innovations are autocorrelated, or scatter more than they should. Where no
    finding explains that (``nameless``), its effect on the parameters is unknown, and every interval is doubled. Where
    it shows in voltage or current, a sensor may lag, which looks like another winding.
    """
    covariance = estimate.covariance
    for lack in lacks:
        shift = _select_worst_shift(estimate, fit, lack)
        covariance = covariance + np.outer(shift, shift)
    if nameless:
        covariance = UNKNOWN_BIAS**2 * covariance
    if {"voltage", "current"} & set(restless):
        shift = _map_shift_to_names(estimate, fit, _compute_sensor_lag_shift(fit))
        covariance = covariance + np.outer(shift, shift)
    return replace(estimate, covariance=freeze_array(covariance))


def _compute_sensor_lag_shift(fit: LikelihoodFit) -> Float:
    """Return the shift (k,) of a fit's free entries by a voltage that lags ``LAG_ROWS`` rows behind the current."""
    lag_s = LAG_ROWS * fit.problem.motions[0].dt_s
    others = [k for k, j in enumerate(fit.free) if j != DELAY]
    shift = np.zeros(len(fit.free))
    shift[others] = -lag_s * solve_least_squares(fit.jacobian_without_delay, differentiate_by_delay(fit))[0]
    return shift


def _select_worst_shift(estimate: Estimate, fit: LikelihoodFit, lack: Deficiency) -> Float:
    """Return the larger shift (k,) in standard deviations, of the deficiency or of an alternative."""
    shifts = [_map_shift_to_names(estimate, fit, each.shift) for each in lack.with_alternatives]
    deviations = np.sqrt(np.maximum(np.diag(estimate.covariance), np.finfo(np.float64).tiny))
    return max(shifts, key=lambda shift: float(np.abs(shift / deviations).max()))


def _map_shift_to_names(estimate: Estimate, fit: LikelihoodFit, shift: Float) -> Float:
    """Return the shift (k,) of the estimate's names, from that of the fit's free entries.

    The parts of a ripple have no name of their own: their shift is left to their covariance.
    """
    moved = np.zeros(len(estimate.names))
    courses = fit.problem.motions[0].courses
    for entry, by in zip(fit.free, shift, strict=True):
        name = PARAMETERS[entry] if entry < DELAY else courses[entry - FIRST_TERM].name if entry > DELAY else ""
        if name in estimate.names and f"{name}{PHASE_SUFFIX}" not in estimate.names and not name.endswith(PHASE_SUFFIX):
            moved[estimate.names.index(name)] = by
    return moved
