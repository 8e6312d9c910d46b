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
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fdhil.identification import friction_speed
from fdhil.identification.covariance import SUMMED_LAGS
from fdhil.identification.fit import Fit, fit
from fdhil.identification.kalman import DELAY, LOAD
from fdhil.identification.motion import Course, Motion
from fdhil.identification.normal import inverse_of
from fdhil.identification.slow_voltage import in_order
from fdhil.identification.terms import Candidate, candidates
from fdhil.model.physical import bounds
from fdhil.records import Estimate, Float

Rows = npt.NDArray[np.intp]

ROUNDS = 3
MOST = 8  # courses in all
IMITATED = 1e-6  # share of a direction below which only rounding is left of it
WORTH = 0.005  # of the motor's torque (RMS): a tenth of the share of the following error that is tolerated
SHIFT = 1.0  # standard deviations of one of the six: a smaller shift is within its interval anyway
SIX = 6
LEAST_SURE = 3.5  # standard deviations of a term, colour and all else that was chosen included


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
            if friction_speed.untold(wider.problem.motions):
                weak |= {"stribeck"} & {c.family for c in chosen}
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
    """Return the families of what is not sure beside all else; the last chosen where the six are told no more.

    Friction that pushes is none: what makes it so stands for something else.
    """
    if not set(estimate.missing) <= untold or chosen[-1].family not in estimate.names:
        return {chosen[-1].family}
    weak = {c.family for c in chosen if not abs(estimate.value(c.family)) > LEAST_SURE * _std(estimate, c.family)}
    low = estimate.value("stribeck") if "stribeck" in estimate.names else 0.0
    friction = {"Cd": estimate.value("Cd"), "stribeck": low}
    if low and any(bound.beyond(friction) > 0.0 for bound in bounds(tuple(friction))):
        weak.add("stribeck" if any(c.family == "stribeck" for c in chosen) else chosen[-1].family)
    return weak


def _std(estimate: Estimate, family: str) -> float:
    """Return the deviation of a term; of friction at low speed for the speed that was chosen: whether it is there."""
    if family != "stribeck":
        return estimate.std(family)
    k, speed = estimate.names.index(family), estimate.names.index("stribeck_speed")
    covariance = estimate.covariance
    return math.sqrt(covariance[k, k] - covariance[k, speed] ** 2 / covariance[speed, speed])


def _with(base: Fit, chosen: Sequence[Candidate]) -> Fit:
    """Return the windows fitted with the chosen terms too."""
    motions = []
    for k, motion in enumerate(base.problem.motions):
        more = tuple(course for candidate in chosen for course in candidate.courses[k])
        motions.append(replace(motion, courses=motion.courses + more))
    added = sum(len(candidate.courses[0]) for candidate in chosen)
    start = np.append(base.theta, np.zeros(added))
    free = (*base.free, *range(base.theta.size, base.theta.size + added))
    return friction_speed.sharpened(replace(fit(motions, start, free), delay_doubt_s=base.delay_doubt_s))


def _chosen(base: Fit, left: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that join this fit, the surest first."""
    number, room = len(left), MOST - len(base.problem.motions[0].courses)
    bench = _Bench.of(base, left) if left else None
    found: list[Candidate] = []
    while bench is not None and len(found) < room:
        scores = bench.scores()
        plain = scores.gains - _price(scores.freedom, bench.rows, number)
        hopeful = np.flatnonzero(plain > 0.0)  # were all innovations independent
        colour = bench.colour(scores, hopeful)
        sure = scores.gains[hopeful] / colour - _price(scores.freedom[hopeful], bench.rows / colour, number)
        if not (sure.size and sure.max() > 0.0):
            break
        best = int(hopeful[int(np.argmax(sure))])
        worth = _worth(bench, scores, best)
        if worth:
            found.append(bench.left[best])
        bench = bench.without(best, hopeful, worth)
    return found


def _price(freedom: Float, rows: float | Float, number: int) -> Float:
    price: Float = freedom * np.log(np.maximum(rows, 2.0)) + 2.0 * math.log(number)
    return price


class _Scores(NamedTuple):
    """What each of c candidates, of one course or two, explains beyond all that is free.

    ``beyond`` (2, m, c) are the courses' columns without what is free of them, ``shares`` (2, k, c); ``powers`` (2, c)
    their squares, ``amplitudes`` (2, c), and ``gains`` (c,) the fall of minus twice the log likelihood.
    """

    beyond: Float
    shares: Float
    powers: Float
    amplitudes: Float
    gains: Float
    freedom: Float


@dataclass(frozen=True, slots=True)
class _Bench:
    """A fit with the candidates that are ``left``, their ``columns`` (2, m, c): the second is nil where there is one.

    ``basis`` (m, k) is all that is free, after the ``doubts`` about the voltage's course, and ``inverse`` (k, k) the
    covariance of that.
    """

    fit: Fit
    left: Sequence[Candidate]
    columns: Float
    basis: Float
    doubts: int
    inverse: Float

    @classmethod
    def of(cls, base: Fit, left: Sequence[Candidate]) -> _Bench:
        """Return the bench of a fit."""
        motions = range(len(base.problem.motions))
        pairs = [k for k, c in enumerate(left) if len(c.courses[0]) == 2]
        courses = [[c.courses[k][0] for c in left] + [left[p].courses[k][1] for p in pairs] for k in motions]
        answer = base.problem.answer(base.theta, courses)
        columns = np.zeros((2, answer.shape[0], len(left)))
        columns[0], columns[1][:, pairs] = answer[:, : len(left)], answer[:, len(left) :]
        doubts = base.problem.course_effects(base.theta)
        basis = np.column_stack([doubts, base.jacobian])
        return cls(base, left, columns, basis, doubts.shape[1], _inverse(basis, doubts.shape[1]))

    def without(self, taken: int, kept: Rows, joins: bool) -> _Bench:
        """Return the bench of those ``kept`` that are of another family than the ``taken``, which ``joins`` or not."""
        family = self.left[taken].family
        others = [int(k) for k in kept if self.left[k].family != family]
        more = [c[:, taken] for c in self.columns if c[:, taken].any()] if joins else []
        basis = np.column_stack([self.basis, *more])
        return _Bench(
            self.fit,
            [self.left[k] for k in others],
            self.columns[:, :, others],
            basis,
            self.doubts,
            _inverse(basis, self.doubts),
        )

    @property
    def rows(self) -> float:
        """How many innovations tell of the motion."""
        return 2.0 * sum(int(np.count_nonzero(np.abs(m.mode) == 1)) for m in self.fit.problem.motions)

    @property
    def rest(self) -> Float:
        """The innovations (m,) without what all that is free could explain of them."""
        e = self.fit.residuals
        left: Float = e - self.basis @ (self.inverse @ (self.basis.T @ e))
        return left

    def scores(self) -> _Scores:
        """Return what each candidate explains."""
        shares = self.inverse @ (self.basis.T @ self.columns)
        beyond = self.columns - self.basis @ shares
        whole, powers = (np.einsum("pmc,pmc->pc", part, part) for part in (self.columns, beyond))
        seen = powers > IMITATED * whole
        beyond, powers = np.where(seen[:, None], beyond, 0.0), np.where(seen, powers, 1.0)
        s = beyond.transpose(0, 2, 1) @ self.rest
        both = np.einsum("mc,mc->c", *beyond)
        determinant = np.maximum(powers[0] * powers[1] - both**2, IMITATED * powers[0] * powers[1])
        amplitudes = (powers[::-1] * s - both * s[::-1]) / determinant
        return _Scores(beyond, shares, powers, amplitudes, (amplitudes * s).sum(axis=0), seen.sum(axis=0) * 1.0)

    def colour(self, scores: _Scores, asked: Rows) -> Float:
        """Return by how much the scores of those ``asked`` (c,) vary more than were innovations independent.

        After Newey and West (1987), by rows, of what is left with the candidate: what it explains is no colour.
        Bartlett's weights over lags are the mean square of moving sums.
        """
        beyond, amplitudes = scores.beyond[:, :, asked], scores.amplitudes[:, asked]
        left = self.rest[:, None] - np.einsum("pmc,pc->mc", beyond, amplitudes)
        meat = np.zeros(amplitudes.shape)
        for own, signal in enumerate(beyond):
            for motion, part in zip(self.fit.problem.motions, self.fit.by_window(signal * left), strict=True):
                by_row = in_order(motion, float(self.fit.theta[DELAY]), part)
                sums = np.cumsum(np.pad(by_row, ((SUMMED_LAGS + 1, SUMMED_LAGS), (0, 0))), axis=0)
                moving = sums[SUMMED_LAGS + 1 :] - sums[: -SUMMED_LAGS - 1]
                meat[own] += np.square(moving).sum(axis=0) / (SUMMED_LAGS + 1)
        colour: Float = np.maximum(1.0, (meat / scores.powers[:, asked]).max(axis=0, initial=1.0))
        return colour


def _inverse(basis: Float, doubts: int) -> Float:
    gram = basis.T @ basis
    gram[range(doubts), range(doubts)] += 1.0  # one deviation of the voltage's course is all that is expected of it
    return inverse_of(gram)[0]


def _worth(bench: _Bench, scores: _Scores, k: int) -> bool:
    """Return whether a term's torque matters to the path, or without it one of the six is beyond its interval."""
    amplitudes, six = scores.amplitudes[:, k], slice(bench.doubts, bench.doubts + SIX)
    moved = np.einsum("pk,p->k", scores.shares[:, :, k], amplitudes)[six]
    if (np.abs(moved) > SHIFT * np.sqrt(np.diag(bench.inverse)[six])).any():
        return True
    courses, base = bench.left[k].courses, bench.fit
    if courses[0][0].kind != LOAD:
        return False
    torque = sum(float(np.square(_torque(own, amplitudes)).sum()) for own in courses)
    whole = sum(float(np.square(base.theta[2] * _sure(m)).sum()) for m in base.problem.motions)
    return torque > WORTH**2 * whole


def _torque(courses: Sequence[Course], amplitudes: Float) -> Float:
    total: Float = amplitudes[: len(courses)] @ np.stack([course.values for course in courses])
    return total


def _sure(motion: Motion) -> Float:
    current: Float = motion.current[np.abs(motion.mode) == 1]
    return current
