"""Lets terms join the six where the data surely show them: forward selection on a fit's own innovations.

The innovations are linear in the terms and nearly so in the six, so what each would explain beyond all that are free
is told without another fit. A term joins where minus twice the log likelihood falls by more than its price: the
Bayesian criterion, extended by the number of terms that were tried (Chen and Chen 2008), with as many rows as are
independent; where it is worth it; and where the six stay told. Then all are fitted once more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.identification.covariance import summed
from fdhil.identification.fit import Fit, fit
from fdhil.identification.kalman import DELAY, LOAD
from fdhil.identification.motion import Course, Motion
from fdhil.identification.normal import inverse_of
from fdhil.identification.slow_voltage import in_order
from fdhil.identification.terms import Candidate, candidates
from fdhil.records import Estimate, Float

ROUNDS = 3
MOST = 6  # terms in all
WORTH = 0.005  # of the motor's torque (RMS): a tenth of the share of the following error that is tolerated
SHIFT = 1.0  # standard deviations of one of the six: a smaller shift is within its interval anyway
SIX = 6
LEAST_SURE = 4.0  # standard deviations of a term, colour and all: of 50 candidates, one in 300 windows is by chance


@dataclass(frozen=True, slots=True)
class Tried:
    """A candidate on a fit, and the columns (m, q) of its courses."""

    candidate: Candidate
    columns: Float


def joined(base: Fit, command: bool, told: Callable[[Fit], Estimate]) -> Fit:
    """Return the fit with the terms that its windows surely show; itself where there are none.

    ``command`` says whether the voltage may be a commanded one, ``told`` makes an estimate of a fit.
    """
    result, left = base, candidates(base.problem.motions, command)
    untold = None
    for _ in range(ROUNDS):
        if not result.converged or not np.isfinite(result.residuals).all():
            return result
        chosen = _chosen(result, left)
        while chosen:
            wider = _with(result, chosen)
            untold = set(told(base).missing) if untold is None else untold
            weak = _weak(told(wider), chosen, untold) if wider.converged else {chosen[-1].family}
            if not weak:
                break
            left = [c for c in left if c.family not in weak]
            chosen = [c for c in chosen if c.family not in weak]
        if not chosen:
            return result
        result = wider
        left = [c for c in left if all(c.family != taken.family for taken in chosen)]
    return result


def _weak(estimate: Estimate, chosen: Sequence[Candidate], untold: set[str]) -> set[str]:
    """Return the families of what is not sure beside all else; the last chosen where the six are told no more."""
    if not set(estimate.missing) <= untold:
        return {chosen[-1].family}
    return {c.family for c in chosen if not abs(estimate.value(c.family)) > LEAST_SURE * estimate.std(c.family)}


def _with(base: Fit, chosen: Sequence[Candidate]) -> Fit:
    """Return the windows fitted with the chosen terms too."""
    motions = []
    for k, motion in enumerate(base.problem.motions):
        more = tuple(course for candidate in chosen for course in candidate.courses[k])
        motions.append(replace(motion, courses=motion.courses + more))
    added = sum(len(candidate.courses[0]) for candidate in chosen)
    start = np.append(base.theta, np.zeros(added))
    free = (*base.free, *range(base.theta.size, base.theta.size + added))
    return replace(fit(motions, start, free), delay_doubt_s=base.delay_doubt_s)


def _chosen(base: Fit, left: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that join this fit, the surest first."""
    room = MOST - len({c.name for c in base.problem.motions[0].courses})
    sizes = [len(c.courses[0]) for c in left]
    if not left or room <= 0:
        return []
    courses = [[course for c in left for course in c.courses[k]] for k in range(len(base.problem.motions))]
    columns = base.problem.answer(base.theta, courses)
    ends = np.cumsum(sizes)
    tried = [Tried(c, columns[:, e - s : e]) for c, s, e in zip(left, sizes, ends, strict=True)]
    bench = _Bench.of(base)
    found: list[Candidate] = []
    while tried and len(found) < room:
        taken = _surest(bench, tried, len(left))
        if taken is None:
            break
        if _worth(base, bench, taken):
            found.append(taken.candidate)
            bench = bench.wider(taken.columns)
        tried = [t for t in tried if t.candidate.family != taken.candidate.family]
    return found


def _surest(bench: _Bench, tried: Sequence[Tried], number: int) -> Tried | None:
    """Return the term that gains most beyond its price; None where none does.

    What it gains were all innovations independent comes first: only where that is enough it is asked what is left
    with innovations that hang together.
    """
    plain = [bench.gain(t.columns) - _price(t, bench.rows, number) for t in tried]
    best, most = None, 0.0
    for k in sorted(range(len(tried)), key=lambda k: -plain[k]):
        if plain[k] <= most:
            break
        colour = bench.colour(tried[k].columns)
        left = bench.gain(tried[k].columns) / colour - _price(tried[k], bench.rows / colour, number)
        if left > most:
            best, most = tried[k], left
    return best


def _price(tried: Tried, rows: float, number: int) -> float:
    freedom = int(tried.columns.shape[1])
    return freedom * math.log(max(rows, 2.0)) + 2.0 * math.log(number)


@dataclass(frozen=True, slots=True)
class _Bench:
    """A fit, and the ``basis`` (m, k) of all that is free in it, after the voltage's course, of which one deviation is
    a prior."""

    fit: Fit
    basis: Float
    inverse: Float

    @classmethod
    def of(cls, base: Fit) -> _Bench:
        return cls._made(base, np.column_stack([base.problem.shape_effect(base.theta), base.jacobian]))

    @classmethod
    def _made(cls, base: Fit, basis: Float) -> _Bench:
        gram = basis.T @ basis
        gram[0, 0] += 1.0
        return cls(base, basis, inverse_of(gram)[0])

    def wider(self, columns: Float) -> _Bench:
        """Return the bench with a term's columns free too."""
        return self._made(self.fit, np.column_stack([self.basis, columns]))

    @property
    def residuals(self) -> Float:
        """The innovations (m,)."""
        return self.fit.residuals

    @property
    def rows(self) -> float:
        """How many innovations tell of the motion."""
        return 2.0 * sum(int(np.count_nonzero(np.abs(m.mode) == 1)) for m in self.fit.problem.motions)

    def step(self, columns: Float) -> tuple[Float, Float, Float]:
        """Return score (q,), information (q, q) of ``columns`` (m, q) beyond the basis, and their shares (k, q)."""
        shared = self.basis.T @ columns
        shares = self.inverse @ shared
        pulled = self.basis.T @ self.residuals
        score = columns.T @ self.residuals - shares.T @ pulled
        return score, columns.T @ columns - shared.T @ shares, shares

    def colour(self, columns: Float) -> float:
        """Return by how much the scores of ``columns`` (m, q) vary more than they would were innovations independent.

        After Newey and West (1987), by rows, of what is left with them: what they explain is no colour.
        """
        score, information, shares = self.step(columns)
        beyond = columns - self.basis @ shares
        left = self.residuals - beyond @ (inverse_of(information)[0] @ score)
        scores = self.fit.by_window(beyond * left[:, None])
        motions, delay = self.fit.problem.motions, float(self.fit.theta[DELAY])
        meat = sum(summed(in_order(m, delay, own)) for m, own in zip(motions, scores, strict=True))
        ratio = np.diag(meat) / np.diag(information)
        return max(1.0, float(ratio.max()))

    def gain(self, columns: Float) -> float:
        """Return by how much minus twice the log likelihood falls with these columns."""
        score, information, _ = self.step(columns)
        inverse, condition = inverse_of(information)
        return float(score @ inverse @ score) if math.isfinite(condition) else 0.0


def _worth(base: Fit, bench: _Bench, tried: Tried) -> bool:
    """Return whether a term's torque matters to the path, or without it one of the six is beyond its interval."""
    score, information, shares = bench.step(tried.columns)
    amplitudes = inverse_of(information)[0] @ score
    moved = shares[1 : SIX + 1] @ amplitudes
    if (np.abs(moved) > SHIFT * np.sqrt(np.diag(bench.inverse)[1 : SIX + 1])).any():
        return True
    first = tried.candidate.courses[0][0]
    if first.kind != LOAD:
        return False
    torque = sum(float(np.square(_torque(own, amplitudes)).sum()) for own in tried.candidate.courses)
    whole = sum(float(np.square(base.theta[2] * _sure(m)).sum()) for m in base.problem.motions)
    return torque > WORTH**2 * whole


def _torque(courses: Sequence[Course], amplitudes: Float) -> Float:
    total: Float = amplitudes @ np.stack([course.values for course in courses])
    return total


def _sure(motion: Motion) -> Float:
    current: Float = motion.current[np.abs(motion.mode) == 1]
    return current
