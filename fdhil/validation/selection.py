"""Selects the findings of one window one after the other: what each shows that those before it do not explain.

Many alternatives resemble each other, so that one thing that the model lacks shows as several. The most significant is
taken, the others are tested again given it, and so on while one is significant. Together with the parameters they are
then one fit, whose amplitudes show how far the parameters were off without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.normal import inverse_of
from fdhil.records import Float
from fdhil.validation.score_bench import Bench, Finding

NO_WORSE = 3.0  # standard deviations by which an alternative may explain less by chance


@dataclass(frozen=True, slots=True)
class Lacking:
    """A deficiency of a model: a finding, the shift of the parameters by it (k,), and its torque (n,), N.m, or None.

    The parameters are those of the fit's jacobian, in its order. ``rivals`` explain the same nearly as well, and may be
    present instead.
    """

    finding: Finding
    shift: Float
    load_nm: Float | None
    rivals: tuple[Lacking, ...] = ()

    @property
    def with_rivals(self) -> tuple[Lacking, ...]:
        """The finding, and its alternatives."""
        return (self, *self.rivals)


def lacking(fit: Fit, findings: Sequence[Finding]) -> list[Lacking]:
    """Return the significant deficiencies of the model, the most significant first; none where all may be chance."""
    if not any(finding.sure for finding in findings):
        return []
    bench = Bench.of(fit)
    directions = np.column_stack([finding.direction for finding in findings])
    score, information = bench.scores(directions)
    whole = np.einsum("mq,mq->q", directions, directions)
    taken: list[int] = []
    similar: list[npt.NDArray[np.intp]] = []
    while len(taken) < len(findings):
        shares = (
            information[:, taken] @ inverse_of(information[np.ix_(taken, taken)])[0]
            if taken
            else np.zeros((len(score), 0))
        )
        rest = np.diag(information) - np.einsum("qt,qt->q", shares, information[:, taken])
        statistic, _ = bench.tested(score - shares @ score[taken], rest, whole)
        statistic[taken] = 0.0
        best = int(np.argmax(np.abs(statistic)))
        if not replace(findings[best], statistic=float(statistic[best])).sure:
            break
        taken.append(best)
        similar.append(np.flatnonzero(np.square(statistic) > statistic[best] ** 2 - NO_WORSE**2))
    moved = inverse_of(fit.information)[0] @ (fit.jacobian.T @ directions)

    def beside_others(n: int, k: int) -> Lacking:
        places = [*taken[:n], k, *taken[n + 1 :]]
        amplitude = float((inverse_of(information[np.ix_(places, places)])[0] @ score[places])[n])
        return _lacking(findings[k], amplitude, moved[:, k])

    found = []
    for n, k in enumerate(taken):
        rivals = tuple(beside_others(n, int(other)) for other in similar[n] if other not in taken)
        found.append(replace(beside_others(n, k), rivals=rivals))
    return found


def _lacking(finding: Finding, amplitude: float, moved: Float) -> Lacking:
    """Return a finding with its amplitude given the others; a sensor's own change has the opposite sign."""
    load = None if finding.load_nm is None else amplitude * finding.load_nm
    signed = amplitude if load is not None else -amplitude
    return Lacking(replace(finding, amplitude=signed), amplitude * moved, load)
