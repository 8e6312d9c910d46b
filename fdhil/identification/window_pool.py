"""Pools the estimates of several windows of one drive, and computes how far two of them may differ by chance.

A small mixed model: common values are estimated by generalised least squares, with the variance between windows in the
covariance. Moves in both directions separate a constant load from dry friction, and viscous friction by direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.identification.between_window_variance import BetweenWindowVariance, PoolMember
from fdhil.identification.low_rate_voltage.within_sample import has_unknown_setpoint_steps
from fdhil.identification.ripple_parts import combine_ripples, split_ripples
from fdhil.identification.robust_covariance import estimate_aliasing_doubt
from fdhil.records import PARAMETERS, Estimate, Float, Int, Window, freeze_array

# share of a common doubt that may still differ between windows of one drive: it depends on the regulators, which are
# the same, and a little on the move
UNSHARED = 0.2
JOINS = 3.3  # standard deviations: one false load in a thousand pools
LEAST_BEYOND = 0.5  # of the windows' range, by which a common value may lie outside it
LEAST_SHARE = 1e-6  # of a parameter's size: rounding
BY_DIRECTION = {"load": "Cd", "viscous": "ft"}  # term by direction: the parameter that it changes


def build_pool_member(window: Window, estimate: Estimate, place: int = 0) -> PoolMember:
    """Return a window's estimate ready to be pooled: own covariance separated from the doubts shared by all windows."""
    own, systematic, alias = _split_covariance(window, estimate)
    finite = np.isfinite(estimate.values) & np.isfinite(np.diag(estimate.covariance))
    kept = [k for k, name in enumerate(estimate.names) if finite[k] and name not in estimate.given]
    doubts = np.column_stack([np.diag(alias)[:, : len(PARAMETERS)], systematic])
    names = tuple(estimate.names[k] for k in kept)
    values, own, doubts = split_ripples(names, estimate.values[kept], own[np.ix_(kept, kept)], doubts[kept])
    return PoolMember(names, values, own, doubts, place, window.direction)


def pool_estimates(
    members: Sequence[PoolMember], first: Estimate, variance: BetweenWindowVariance, *, joining: bool = True
) -> Estimate:
    """Pool the estimates of windows given in order, as of the newest of them.

    ``variance`` is the variance between windows. With ``joining`` a load, and viscous friction by direction, are added
    where significant. Method, and parameters that no window determines, are those of ``first``.
    """
    names = _select_common_names(members)
    added: list[str] = []
    stack = _StackedValues.from_members(members, names, variance)
    answer = _solve_pool(stack, added)
    if _is_beyond_all(answer, stack):
        members = [replace(m, own=np.diag(np.diag(m.own))) for m in members]
        stack = _StackedValues.from_members(members, names, variance)
        answer = _solve_pool(stack, added)
    while joining:
        trials = {term: _solve_pool(stack, [*added, term]) for term in _list_open_terms(members, names, added)}
        surest = max(trials, key=lambda term: trials[term].compute_significance(), default=None)
        if surest is None or trials[surest].compute_significance() < JOINS:
            break
        added.append(surest)
        answer = trials[surest]
    return _build_estimate(answer, names, added, first)


def _is_beyond_all(answer: _PoolSolution, stack: _StackedValues) -> bool:
    """Return whether R, L, K or Jt lies outside the range of all windows.

    Shared doubts that tie parameters together more than windows agree move the common value away from each of them.
    """
    for k, name in enumerate(stack.names):
        if name in ("R", "L", "K", "Jt"):
            own = stack.values[stack.which == k]
            if not own.min() - LEAST_BEYOND * np.ptp(own) <= answer.values[k] <= own.max() + LEAST_BEYOND * np.ptp(own):
                return True
    return False


def _select_common_names(members: Sequence[PoolMember]) -> tuple[str, ...]:
    seen = dict.fromkeys(name for m in members for name in m.names)
    known = [name for name in PARAMETERS if name in seen]
    terms = [name for name in seen if name not in PARAMETERS and 2 * sum(name in m.names for m in members)
             >= len(members)]  # fmt: skip
    return (*known, *terms)


def _list_open_terms(members: Sequence[PoolMember], names: Sequence[str], added: Sequence[str]) -> list[str]:
    both = len({m.direction for m in members}) == 2
    return [term for term, of in BY_DIRECTION.items() if both and of in names and term not in added]


@dataclass(frozen=True, slots=True)
class _PoolSolution:
    """Common ``values`` (k,) with their covariance ``chance`` (k, k) and the doubts (k, q) that the windows share."""

    values: Float
    chance: Float
    doubts: Float

    def compute_significance(self) -> float:
        return abs(float(self.values[-1])) / float(np.sqrt(self.chance[-1, -1]))


def _solve_pool(stack: _StackedValues, added: Sequence[str]) -> _PoolSolution:
    of = [stack.names.index(BY_DIRECTION[term]) for term in added]
    columns = np.equal.outer(stack.which, np.arange(len(stack.names))).astype(np.float64)
    columns = np.column_stack([columns, *(np.where(stack.which == k, stack.side, 0.0) for k in of)])
    unit = np.concatenate([stack.unit, stack.unit[of]])
    phi = columns * unit / stack.unit[stack.which][:, None]
    chance = np.linalg.inv(phi.T @ stack.weight @ phi)
    gain = chance @ phi.T @ stack.weight / stack.unit[stack.which]
    return _PoolSolution(
        gain @ stack.values * unit, chance * np.outer(unit, unit), (gain @ stack.shared) * unit[:, None]
    )


@dataclass(frozen=True, slots=True)
class _StackedValues:
    """All windows' values stacked (m,): ``which`` of the ``names`` each is, and the ``side`` it was moved to.

    ``weight`` (m, m) is the inverse covariance relative to the newest window, in units (k,) of the names; ``shared``
    (m, q) are the doubts that the windows share.
    """

    names: tuple[str, ...]
    values: Float
    which: Int
    side: Float
    shared: Float
    unit: Float
    weight: Float

    @classmethod
    def from_members(
        cls, members: Sequence[PoolMember], names: tuple[str, ...], variance: BetweenWindowVariance
    ) -> _StackedValues:
        kept = [[k for k, name in enumerate(m.names) if name in names] for m in members]
        which = np.array([names.index(m.names[k]) for m, own in zip(members, kept, strict=True) for k in own])
        values = np.concatenate([m.values[own] for m, own in zip(members, kept, strict=True)])
        side = np.repeat([float(m.direction) for m in members], [len(own) for own in kept])
        shared = np.zeros((which.size, max(m.shared.shape[1] for m in members)))
        unit = np.array([float(np.abs(values[which == k]).max()) for k in range(len(names))])
        unit[unit == 0.0] = 1.0
        total, start = _compute_between_covariance(members, kept, which, names, variance), 0
        for m, own in zip(members, kept, strict=True):
            rows = slice(start, start + len(own))
            total[rows, rows] += m.own[own][:, own]
            shared[rows, : m.shared.shape[1]] = m.shared[own]
            start = rows.stop
        scale = unit[which]
        weight = np.asarray(
            np.linalg.inv(total / np.outer(scale, scale) + LEAST_SHARE**2 * np.eye(which.size)), dtype=np.float64
        )
        return cls(names, values, which, side, shared, unit, weight)


def _compute_between_covariance(
    members: Sequence[PoolMember],
    kept: Sequence[Sequence[int]],
    which: Int,
    names: Sequence[str],
    variance: BetweenWindowVariance,
) -> Float:
    """Return the covariance (m, m) due to variation between windows, relative to the newest."""
    place = np.repeat([float(m.place) for m in members], [len(own) for own in kept])
    back = place.max() - place
    walk, scatter = (
        np.array([shares.get(name, 0.0) * variance.sizes.get(name, 0.0) ** 2 for name in names])[which]
        for shares in (variance.walk, variance.scatter)
    )
    # two windows share the walk from the newer of them to the newest
    total = np.where(np.equal.outer(which, which), walk * np.minimum.outer(back, back), 0.0)
    return total + np.diag(scatter)


def _build_estimate(found: _PoolSolution, names: Sequence[str], added: Sequence[str], first: Estimate) -> Estimate:
    extra = [*(["load"] * ("load" in added)), *(["viscous_positive", "viscous_negative"] * ("viscous" in added))]
    listed = (*PARAMETERS, *(name for name in names if name not in PARAMETERS), *extra)
    values, total, doubts = combine_ripples((*names, *added), found.values, found.chance, found.doubts)
    known = {name: k for k, name in enumerate((*names, *added))}
    root = np.zeros((len(listed), len(known)))
    for row, name in enumerate(listed):
        for of, share in _map_to_solved_values(name).items():
            if of in known:
                root[row, known[of]] = share
    answer, covariance = root @ values, root @ total @ root.T
    systematic = root @ doubts
    covariance += systematic @ systematic.T
    for row, name in enumerate(PARAMETERS):
        if name not in known:
            answer[row] = first.get_value(name)
            covariance[row, :] = covariance[:, row] = 0.0 if name in first.given else np.nan
    return replace(
        first,
        names=listed,
        values=freeze_array(answer),
        covariance=freeze_array(covariance),
        residuals={},
        delay_s=None,
        delay_std_s=None,
        systematic=freeze_array(systematic[:, len(PARAMETERS) :]),
    )


def _map_to_solved_values(name: str) -> dict[str, float]:
    sides = {"viscous_positive": 1.0, "viscous_negative": -1.0}
    return {"ft": 1.0, "viscous": sides[name]} if name in sides else {name: 1.0}


def estimate_friction_at(estimate: Estimate, speed_rad_s: float) -> tuple[float, float] | None:
    """Return the friction torque Cd + ft w at a speed and its standard deviation (N.m); None where it is unknown.

    At one speed ft and Cd compensate each other, each with a wide interval: their sum is well determined, and trends
    follow it. From a single window it includes the load of its direction.
    """
    if not {"ft", "Cd"} <= set(estimate.names):
        return None
    rows = [estimate.names.index(name) for name in ("ft", "Cd")]
    lever = np.array([speed_rad_s, 1.0])
    value = float(lever @ estimate.values[rows])
    variance = float(lever @ estimate.covariance[np.ix_(rows, rows)] @ lever)
    return (value, variance**0.5) if np.isfinite(value) and variance >= 0.0 else None


def compute_difference_covariance(one: tuple[Window, Estimate], other: tuple[Window, Estimate]) -> Float:
    """Return the covariance (6, 6) of the difference between the estimates of two windows of one drive.

    The voltage's unknown waveform within its samples depends on the regulators and is the same in both: with its
    effects s and t on the two estimates, their difference moves by s - t only, and hides no change of the drive.
    """
    (own, systematic, alias), (its_own, its_systematic, its_alias) = (
        _select_six(*_split_covariance(*pair)) for pair in (one, other)
    )
    wide = max(systematic.shape[1], its_systematic.shape[1])
    systematic, its_systematic = (np.pad(s, ((0, 0), (0, wide - s.shape[1]))) for s in (systematic, its_systematic))
    difference = systematic - its_systematic
    part, its_part = _select_unshared_doubts(one[0], systematic), _select_unshared_doubts(other[0], its_systematic)
    unshared = part @ part.T + its_part @ its_part.T + np.diag(alias**2 + its_alias**2)
    return own + its_own + difference @ difference.T + np.diag((alias - its_alias) ** 2) + UNSHARED**2 * unshared


def compute_change_covariance(window: Window, estimate: Estimate) -> Float:
    """Return the covariance (6, 6) for comparing an estimate with earlier ones of the same drive.

    How set-points step within long samples is the same in all of them, and hides no change.
    """
    own, systematic, alias = _select_six(*_split_covariance(window, estimate))
    part = _select_unshared_doubts(window, systematic)
    return own + part @ part.T + np.diag(alias**2)


def _select_unshared_doubts(window: Window, systematic: Float) -> Float:
    """Return the doubts (k, q) that may differ partly between windows of one drive: not how set-points step."""
    return systematic[:, :2] if has_unknown_setpoint_steps(window) else systematic


def _select_six(own: Float, systematic: Float, alias: Float) -> tuple[Float, Float, Float]:
    six = len(PARAMETERS)
    return own[:six, :six], systematic[:six], alias[:six]


def _split_covariance(window: Window, estimate: Estimate) -> tuple[Float, Float, Float]:
    """Return the covariance (k, k) of a window's own chance, and the doubts (k, q) and (k,) that it shares."""
    size = len(estimate.names)
    systematic = np.zeros((size, 0))
    if estimate.systematic is not None:  # covers the first names only
        systematic = np.pad(estimate.systematic, ((0, size - len(estimate.systematic)), (0, 0)))
    slow = window.slow_voltage
    period = window.dt_s if slow is None else slow.period_s
    alias = np.zeros(size)
    six = len(PARAMETERS)
    alias[:six] = estimate_aliasing_doubt(window.voltage_sampling, period) * np.abs(estimate.values[:six])
    return estimate.covariance - systematic @ systematic.T - np.diag(alias**2), systematic, alias
