"""Adds significant terms to the six parameters: forward selection on a fit's own innovations.

One Gram matrix yields what each term would explain beyond all free entries, without another fit. A term is added where
minus twice the log likelihood falls by more than its price (the Bayesian criterion extended by the number of terms
tried, Chen and Chen 2008, with the number of independent samples), where it is worthwhile, and where the six stay
identifiable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fdhil.identification import stribeck_speed
from fdhil.identification.candidate_terms import CandidateTerm, list_candidates
from fdhil.identification.identifiability import is_admissible
from fdhil.identification.kalman import DELAY, LOAD
from fdhil.identification.likelihood_fit import LikelihoodFit, fit_parameters_and_noise
from fdhil.identification.low_rate_voltage.low_rate_innovations import sum_by_sample
from fdhil.identification.noise_fit import fit_noise
from fdhil.identification.normal_equations import invert_symmetric
from fdhil.identification.robust_covariance import SUMMED_LAGS
from fdhil.identification.voltage_delay import LEAST_DELAY, MOST_DELAY, add_delay_doubt, differentiate_by_delay
from fdhil.model import list_bounds
from fdhil.records import Estimate, Float

Rows = npt.NDArray[np.intp]

ROUNDS = 3
MOST = 8  # regressors in all
IMITATED = 1e-6  # share of a direction below which only rounding remains
WORTH = 0.005  # of the motor's torque (RMS): a tenth of the tolerated share of the following error
SHIFT = 1.0  # standard deviations of one of the six: a smaller shift is within its interval
SIX = 6
LEAST_SURE = 3.5  # standard deviations of a term, with colour and all other terms
LATE = "late"  # the candidate that is a delay of the voltage, not a term
SURE_DELAY = 5.0  # standard deviations beyond which a delay is accepted


def add_terms(
    base: LikelihoodFit, command: bool, estimate_of: Callable[[LikelihoodFit], Estimate], *, delayed: bool = False
) -> LikelihoodFit:
    """Return the fit with the terms that are significant in its windows; the fit itself without any.

    ``command`` is true where the voltage may be a commanded one; ``estimate_of`` converts a fit to an estimate. Where
    the voltage may be ``delayed``, its delay is a candidate too: dead time and other terms resemble it.
    """
    result, left = base, list_candidates(base.problem.motions, command)
    if delayed and DELAY not in base.free:
        left.append(CandidateTerm(LATE, tuple(() for _ in base.problem.motions)))
    for _ in range(ROUNDS):
        if not result.converged or not np.isfinite(result.residuals).all():
            return result
        bench, chosen = _choose_terms(result, left, delayed)
        while chosen:
            wider = _refit_with_terms(result, chosen, bench)
            weak = _find_weak_terms(wider, chosen, base, estimate_of) if wider.converged else {chosen[-1].family}
            if stribeck_speed.is_speed_unobservable(wider.problem.motions):
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


def _find_weak_terms(
    wider: LikelihoodFit,
    chosen: Sequence[CandidateTerm],
    base: LikelihoodFit,
    estimate_of: Callable[[LikelihoodFit], Estimate],
) -> set[str]:
    """Return the families that are insignificant given all else; the last chosen where the six lose identifiability.

    Negative friction is rejected: it stands for something else.
    """
    estimate = estimate_of(wider)
    terms = [c.family for c in chosen if c.family != LATE]
    lost = bool(estimate.missing) and not set(estimate.missing) <= set(estimate_of(base).missing)
    if lost or not set(terms) <= set(estimate.names):
        return {chosen[-1].family}
    weak = {name for name in terms if not abs(estimate.get_value(name)) > LEAST_SURE * _get_term_std(estimate, name)}
    if len(terms) < len(chosen) and not _has_significant_delay(wider, estimate):
        weak.add(LATE)
    low = estimate.get_value("stribeck") if "stribeck" in estimate.names else 0.0
    friction = {"Cd": estimate.get_value("Cd"), "stribeck": low}
    if low and any(bound.compute_violation(friction) > 0.0 for bound in list_bounds(tuple(friction))):
        weak.add("stribeck" if "stribeck" in terms else chosen[-1].family)
    return weak


def _has_significant_delay(wider: LikelihoodFit, estimate: Estimate) -> bool:
    if estimate.delay_s is None or estimate.delay_std_s is None or not _is_plausible_delay(wider, estimate.delay_s):
        return False
    alone = not wider.problem.motions[0].courses
    return alone or abs(estimate.delay_s) >= SURE_DELAY * estimate.delay_std_s


def _is_plausible_delay(base: LikelihoodFit, delay_s: float) -> bool:
    return LEAST_DELAY <= abs(delay_s) / min(m.dt_s for m in base.problem.motions) <= MOST_DELAY


def _get_term_std(estimate: Estimate, family: str) -> float:
    """Return the deviation of a term; for Stribeck friction at its chosen speed, which decides whether it exists."""
    if family != "stribeck":
        return estimate.get_std(family)
    k, speed = estimate.names.index(family), estimate.names.index("stribeck_speed")
    covariance = estimate.covariance
    return math.sqrt(covariance[k, k] - covariance[k, speed] ** 2 / covariance[speed, speed])


def _refit_with_terms(base: LikelihoodFit, chosen: Sequence[CandidateTerm], bench: _SelectionProblem) -> LikelihoodFit:
    motions = []
    for k, motion in enumerate(base.problem.motions):
        more = tuple(course for candidate in chosen for course in candidate.courses[k])
        motions.append(replace(motion, courses=motion.courses + more))
    late = [DELAY] if any(c.family == LATE for c in chosen) else []
    terms = range(base.theta.size, base.theta.size + sum(len(c.courses[0]) for c in chosen))
    free = sorted({*base.free, *late, *terms})
    start = np.append(base.theta, np.zeros(len(terms)))
    ahead = start.copy()
    ahead[[*base.free, *(j for c in chosen for j in _index_term_entries(c, chosen, base.theta.size))]] += (
        bench.solve_step(chosen)
    )
    start = ahead if is_admissible(ahead) else start
    noises = [fit_noise(m, start, m.noise) for m in motions]
    made = stribeck_speed.refine_stribeck_speed(fit_parameters_and_noise(motions, start, free, noises))
    return add_delay_doubt(made) if bench.delayed else replace(made, delay_doubt_s=base.delay_doubt_s)


def _index_term_entries(candidate: CandidateTerm, chosen: Sequence[CandidateTerm], first: int) -> list[int]:
    if candidate.family == LATE:
        return [DELAY]
    before = sum(len(c.courses[0]) for c in chosen[: list(chosen).index(candidate)])
    return [first + before + k for k in range(len(candidate.courses[0]))]


def _choose_terms(
    base: LikelihoodFit, left: Sequence[CandidateTerm], delayed: bool
) -> tuple[_SelectionProblem, list[CandidateTerm]]:
    number, room = len(left), MOST - len(base.problem.motions[0].courses)
    bench = begun = _SelectionProblem.from_fit(base, left, delayed)
    found: list[CandidateTerm] = []
    while bench.left.size and len(found) < room:
        scores = bench.score_candidates()
        plain = scores.gains - _compute_price(scores.freedom, bench.rows, number)
        hopeful = np.flatnonzero(plain > 0.0)  # if all innovations were independent
        if not hopeful.size:
            break
        colour = bench.compute_colour_factor(scores, hopeful)
        sure = scores.gains[hopeful] / colour - _compute_price(scores.freedom[hopeful], bench.rows / colour, number)
        if delayed and (found or base.problem.motions[0].courses):
            late = [left[bench.left[k]].family == LATE for k in hopeful]
            sure[late & (scores.gains[hopeful] < SURE_DELAY**2 * colour)] = -np.inf
        if not sure.max() > 0.0:
            break
        best = int(hopeful[int(np.argmax(sure))])
        worth = _is_worthwhile(bench, scores, best)
        if worth:
            found.append(left[bench.left[best]])
        bench = bench.settle_candidate(best, hopeful, worth)
    return begun, found


def _compute_price(freedom: Float, rows: float | Float, number: int) -> Float:
    return freedom * np.log(np.maximum(rows, 2.0)) + 2.0 * math.log(number)


class _CandidateScores(NamedTuple):
    """Score of each of c candidates, of one regressor or two, given all free entries.

    ``shares`` (k, 2, c) are the projections of the regressors on the free entries; ``powers`` (2, c) the squares of the
    rest, ``amplitudes`` (2, c), and ``gains`` (c,) the fall of minus twice the log likelihood.
    """

    shares: Float
    powers: Float
    amplitudes: Float
    gains: Float
    freedom: Float


@dataclass(frozen=True, slots=True)
class _SelectionProblem:
    """A fit with ``candidates``, of which those ``left`` (c,) are still tried.

    ``columns`` (m, p) are ``doubts`` about the voltage's waveform, the jacobian, and the candidates' regressors, the
    two of each at ``places`` (2, candidates); the last column is zero and stands for a missing second. ``gram`` (p, p),
    filled on demand, and ``pulls`` (p,) are their products, with the doubts' expected sizes; ``free`` are those that
    are fitted.
    """

    fit: LikelihoodFit
    candidates: Sequence[CandidateTerm]
    columns: Float
    gram: Float
    pulls: Float
    doubts: int
    places: Rows
    left: Rows
    free: list[int]
    delayed: bool

    @classmethod
    def from_fit(cls, base: LikelihoodFit, left: Sequence[CandidateTerm], delayed: bool) -> _SelectionProblem:
        doubts = base.problem.compute_waveform_effects(base.theta)
        begin = doubts.shape[1] + base.jacobian.shape[1]
        motions = range(len(base.problem.motions))
        answer = base.problem.compute_term_response(
            base.theta, [[x for c in left for x in c.courses[k]] for k in motions]
        )
        late = [differentiate_by_delay(base)] if any(c.family == LATE for c in left) else []
        columns = np.column_stack([doubts, base.jacobian, answer, *late, np.zeros(len(base.residuals))])
        sizes = [len(c.courses[0]) for c in left]
        first = begin + np.cumsum([0, *sizes])[:-1]
        zero_column = columns.shape[1] - 1
        places = np.array([first, np.where(np.array(sizes) == 2, first + 1, zero_column)], dtype=np.intp)
        places[0, [c.family == LATE for c in left]] = zero_column - 1
        rows, free = np.arange(len(left)), list(range(begin))
        gram = np.diag(np.einsum("mp,mp->p", columns, columns))
        gram[tuple(places)] = gram[tuple(places[::-1])] = np.einsum("mc,mc->c", *(columns[:, p] for p in places))
        pulls = columns.T @ base.residuals
        made = cls(base, left, columns, gram, pulls, doubts.shape[1], places, rows, free, delayed)
        made._fill_gram(free)
        gram[range(doubts.shape[1]), range(doubts.shape[1])] += 1.0  # their prior: one standard deviation
        return made

    def _fill_gram(self, rows: list[int]) -> None:
        products = self.columns[:, rows].T @ self.columns
        self.gram[rows], self.gram[:, rows] = products, products.T

    def settle_candidate(self, taken: int, kept: Rows, joins: bool) -> _SelectionProblem:
        family = self.candidates[self.left[taken]].family
        others = [k for k in self.left[kept] if self.candidates[k].family != family]
        more = self._list_columns(int(self.left[taken])) if joins else []
        if more:
            self._fill_gram(more)
        return replace(self, left=np.array(others, dtype=np.intp), free=[*self.free, *more])

    def _list_columns(self, candidate: int) -> list[int]:
        return [int(p) for p in self.places[:, candidate] if p < self.columns.shape[1] - 1]

    def solve_step(self, chosen: Sequence[CandidateTerm]) -> Float:
        free = self.free + [p for c in chosen for p in self._list_columns(list(self.candidates).index(c))]
        moved: Float = invert_symmetric(self.gram[np.ix_(free, free)])[0] @ self.pulls[free]
        return moved[self.doubts :]

    @property
    def rows(self) -> float:
        return 2.0 * sum(int(np.count_nonzero(np.abs(m.mode) == 1)) for m in self.fit.problem.motions)

    @property
    def inverse(self) -> Float:
        return invert_symmetric(self.gram[np.ix_(self.free, self.free)])[0]

    def score_candidates(self) -> _CandidateScores:
        free, inverse = self.free, self.inverse
        first, second = places = self.places[:, self.left]
        across = self.gram[free][:, places]  # (k, 2, c)
        shares = np.tensordot(inverse, across, 1)
        whole = self.gram[places, places]
        powers = whole - np.einsum("kpc,kpc->pc", across, shares)
        seen = powers > IMITATED * whole
        powers = np.where(seen, powers, 1.0)
        both = self.gram[first, second] - np.einsum("kc,kc->c", across[:, 0], shares[:, 1])
        both = np.where(seen.all(axis=0), both, 0.0)
        s = np.where(seen, self.pulls[places] - np.tensordot(self.pulls[free], shares, 1), 0.0)
        determinant = np.maximum(powers[0] * powers[1] - both**2, IMITATED * powers[0] * powers[1])
        amplitudes = (powers[::-1] * s - both * s[::-1]) / determinant
        return _CandidateScores(shares, powers, amplitudes, (amplitudes * s).sum(axis=0), seen.sum(axis=0) * 1.0)

    def compute_colour_factor(self, scores: _CandidateScores, tried: Rows) -> Float:
        """Return by how much the scores of the candidates ``tried`` (c,) vary more than with independent innovations.

        After Newey and West (1987), of the residuals including the candidate, so that what it explains does not count
        as colour. Bartlett's weights over lags are the mean square of moving sums.
        """
        basis = self.columns[:, self.free]
        rest = self.fit.residuals - basis @ (self.inverse @ self.pulls[self.free])
        amplitudes, left = scores.amplitudes[:, tried], rest[:, None]
        beyond = []
        for own, place in enumerate(self.places[:, self.left[tried]]):
            beyond.append(self.columns[:, place] - basis @ scores.shares[:, own, tried])
            left = left - beyond[own] * amplitudes[own]
        meat = np.zeros(amplitudes.shape)
        for own, signal in enumerate(beyond):
            for motion, part in zip(self.fit.problem.motions, self.fit.split_by_window(signal * left), strict=True):
                by_row = sum_by_sample(motion, float(self.fit.theta[DELAY]), part)
                sums = np.cumsum(np.pad(by_row, ((SUMMED_LAGS + 1, SUMMED_LAGS), (0, 0))), axis=0)
                moving = sums[SUMMED_LAGS + 1 :] - sums[: -SUMMED_LAGS - 1]
                meat[own] += np.einsum("mc,mc->c", moving, moving) / (SUMMED_LAGS + 1)
        colour: Float = np.maximum(1.0, (meat / scores.powers[:, tried]).max(axis=0, initial=1.0))
        return colour


def _is_worthwhile(bench: _SelectionProblem, scores: _CandidateScores, k: int) -> bool:
    """Return whether a term's torque matters to the path, or moves one of the six beyond its interval."""
    amplitudes, six = scores.amplitudes[:, k], slice(bench.doubts, bench.doubts + SIX)
    candidate = bench.candidates[bench.left[k]]
    if candidate.family == LATE and not _is_plausible_delay(bench.fit, float(amplitudes[0])):
        return False
    moved = (scores.shares[:, :, k] @ amplitudes)[six]
    if (np.abs(moved) > SHIFT * np.sqrt(np.diag(bench.inverse)[six])).any():
        return True
    courses, base = candidate.courses, bench.fit
    if candidate.family == LATE or courses[0][0].kind != LOAD:
        return False
    torques = (amplitudes[: len(own)] @ np.stack([course.values for course in own]) for own in courses)
    torque = sum(float(np.square(own).sum()) for own in torques)
    currents = (m.current[np.abs(m.mode) == 1] for m in base.problem.motions)
    whole = sum(float(np.square(base.theta[2] * current).sum()) for current in currents)
    return torque > WORTH**2 * whole
