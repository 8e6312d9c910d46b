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

from fdhil.identification.fit import Fit, fit
from fdhil.identification.kalman import LOAD
from fdhil.identification.motion import Course, Motion
from fdhil.identification.normal import inverse_of
from fdhil.identification.terms import Candidate, candidates
from fdhil.records import Float

LAGS = 25
ROUNDS = 3
MOST = 6  # terms in all
WORTH = 0.005  # of the motor's torque (RMS): a tenth of the share of the following error that is tolerated
SHIFT = 1.0  # standard deviations of one of the six: a smaller shift is within its interval anyway
SIX = 6


@dataclass(frozen=True, slots=True)
class Tried:
    """A candidate on a fit: the columns (m, q) of its courses, and what it explains beyond all else."""

    candidate: Candidate
    columns: Float


def joined(base: Fit, command: bool, missing: Callable[[Fit], frozenset[str]]) -> Fit:
    """Return the fit with the terms that its windows surely show; itself where there are none.

    ``command`` says whether the voltage may be a commanded one, ``missing`` which of the six a fit cannot tell.
    """
    result, left = base, candidates(base.problem.motions, command)
    untold = None
    for _ in range(ROUNDS):
        if not result.converged or not np.isfinite(result.residuals).all():
            return result
        chosen = _chosen(result, left)
        while chosen:
            wider = _with(result, chosen)
            untold = missing(base) if untold is None else untold
            if wider.converged and missing(wider) <= untold:
                break
            left = [c for c in left if c.family != chosen[-1].family]
            chosen = chosen[:-1]
        if not chosen:
            return result
        result = wider
        left = [c for c in left if all(c.family != taken.family for taken in chosen)]
    return result


def _with(base: Fit, chosen: Sequence[Candidate]) -> Fit:
    """Return the windows fitted with the chosen terms too."""
    motions = []
    for k, motion in enumerate(base.problem.motions):
        more = tuple(course for candidate in chosen for course in candidate.courses[k])
        motions.append(replace(motion, courses=motion.courses + more))
    added = sum(len(candidate.courses[0]) for candidate in chosen)
    start = np.append(base.theta, np.zeros(added))
    free = (*base.free, *range(base.theta.size, base.theta.size + added))
    return replace(fit(motions, start, free, base.problem.noises), delay_doubt_s=base.delay_doubt_s)


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
    colour = _colour(base)
    rows = sum(int(np.count_nonzero(np.abs(m.mode) == 1)) for m in base.problem.motions) * 2 / colour
    bench = _Bench.of(base)
    found: list[Candidate] = []
    while tried and len(found) < room:
        gains = [bench.gain(t.columns) / colour - _price(t, rows, len(left)) for t in tried]
        best = int(np.argmax(gains))
        if not gains[best] > 0.0:
            break
        taken = tried[best]
        if _worth(base, bench, taken):
            found.append(taken.candidate)
            bench = bench.wider(taken.columns)
        tried = [t for t in tried if t.candidate.family != taken.candidate.family]
    return found


def _price(tried: Tried, rows: float, number: int) -> float:
    freedom = int(tried.columns.shape[1])
    return freedom * math.log(max(rows, 2.0)) + 2.0 * math.log(number)


@dataclass(frozen=True, slots=True)
class _Bench:
    """Innovations (m,) beside all that is free, ``basis`` (m, k): of the voltage's course one deviation is a prior."""

    residuals: Float
    basis: Float
    inverse: Float
    doubted: int

    @classmethod
    def of(cls, base: Fit) -> _Bench:
        shape = base.problem.shape_effect(base.theta)[:, None]
        return cls._made(base.residuals, np.column_stack([base.jacobian, shape]), base.jacobian.shape[1])

    @classmethod
    def _made(cls, residuals: Float, basis: Float, doubted: int) -> _Bench:
        gram = basis.T @ basis
        gram[doubted, doubted] += 1.0
        return cls(residuals, basis, inverse_of(gram)[0], doubted)

    def wider(self, columns: Float) -> _Bench:
        """Return the bench with a term's columns free too."""
        return self._made(self.residuals, np.column_stack([self.basis, columns]), self.doubted)

    def step(self, columns: Float) -> tuple[Float, Float, Float]:
        """Return score (q,), information (q, q) of ``columns`` (m, q) beyond the basis, and their shares (k, q)."""
        shared = self.basis.T @ columns
        shares = self.inverse @ shared
        pulled = self.basis.T @ self.residuals
        score = columns.T @ self.residuals - shares.T @ pulled
        return score, columns.T @ columns - shared.T @ shares, shares

    def gain(self, columns: Float) -> float:
        """Return by how much minus twice the log likelihood falls with these columns."""
        score, information, _ = self.step(columns)
        inverse, condition = inverse_of(information)
        return float(score @ inverse @ score) if math.isfinite(condition) else 0.0


def _worth(base: Fit, bench: _Bench, tried: Tried) -> bool:
    """Return whether a term's torque matters to the path, or without it one of the six is beyond its interval."""
    score, information, shares = bench.step(tried.columns)
    amplitudes = inverse_of(information)[0] @ score
    moved = shares[:SIX] @ amplitudes
    if (np.abs(moved) > SHIFT * np.sqrt(np.diag(bench.inverse)[:SIX])).any():
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


def _colour(base: Fit) -> float:
    """Return by how much innovations that hang together over rows tell less than as many independent ones."""
    most = 1.0
    for motion, e in zip(base.problem.motions, base.by_window(base.residuals), strict=True):
        rows = (np.abs(motion.mode) == 1) & motion.observed
        for own in e[: 2 * motion.n].reshape(-1, 2)[rows].T:
            if own.size <= 4 * LAGS:
                continue
            power = float(own @ own)
            lags = np.array([own[lag:] @ own[:-lag] for lag in range(1, LAGS + 1)]) / power
            most = max(most, 1.0 + 2.0 * float(lags[lags > 2.0 / math.sqrt(own.size)].sum()))
    return most
