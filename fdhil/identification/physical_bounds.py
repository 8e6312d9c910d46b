"""Bounds estimates to physically possible drives, by the constrained maximum of their normal likelihood.

The covariance is kept: the interval is that of the data.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.model import ParameterBound, list_bounds
from fdhil.records import Estimate, Float, freeze_array

SIGNIFICANT = 3.0  # standard deviations beyond a bound
_FRICTION = ("Cd", "stribeck")


def bound_estimate(estimate: Estimate, direction: int | None = None) -> Estimate:
    """Return the estimate within all physical bounds; the estimate itself where it respects them.

    In moves of one ``direction`` a constant load is part of the dry friction: what makes that significantly negative is
    reported as ``load``.
    """
    if direction is not None:
        estimate = _separate_load(estimate, direction)
    names, values = estimate.names, estimate.values
    within = project_to_bounds(names, values, estimate.covariance)
    return estimate if within is values else replace(estimate, values=freeze_array(within))


def project_to_bounds(names: Sequence[str], values: Float, covariance: Float) -> Float:
    """Return the likeliest values (k,) within the bounds, for the covariance (k, k); ``values`` itself if unchanged."""
    usable = np.isfinite(values) & np.isfinite(np.diag(covariance))
    rows = [k for k in range(len(names)) if usable[k]]
    known = [names[k] for k in rows]
    listed = [b for b in list_bounds(known) if set(b.weights) <= set(known)]
    start = values[rows]
    if not _find_violated_bounds(listed, known, start):
        return values
    own = covariance[np.ix_(rows, rows)]
    within = values.copy()
    within[rows] = _solve_active_set(listed, known, start, own)
    return within


def find_significant_violations(
    names: Sequence[str], values: Float, covariance: Float
) -> list[tuple[ParameterBound, float]]:
    """Return the bounds that values (k,) violate significantly, each with the sum that should not be below it."""
    named = _map_values(names, values)
    found = []
    for bound in list_bounds([name for name, value in named.items() if np.isfinite(value)]):
        row = _build_bound_row(bound, names)
        known = np.flatnonzero(row)
        std = float(np.sqrt(row[known] @ covariance[np.ix_(known, known)] @ row[known]))
        if bound.compute_violation(named) > SIGNIFICANT * std:
            found.append((bound, bound.least - bound.compute_violation(named)))
    return found


def _map_values(names: Sequence[str], values: Float) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))


def _build_bound_row(bound: ParameterBound, names: Sequence[str]) -> Float:
    return np.array([bound.weights.get(name, 0.0) for name in names])


def _find_violated_bounds(
    listed: Sequence[ParameterBound], names: Sequence[str], values: Float
) -> list[ParameterBound]:
    named = _map_values(names, values)
    return [bound for bound in listed if bound.compute_violation(named) > 0.0]


def _solve_active_set(listed: Sequence[ParameterBound], names: Sequence[str], start: Float, covariance: Float) -> Float:
    """Return the values within the bounds nearest to ``start`` in the covariance metric, by an active-set method."""
    values, active = start, list[ParameterBound]()
    for _ in range(2 * len(listed)):
        broken = [b for b in _find_violated_bounds(listed, names, values) if b not in active]
        if not broken:
            break
        active.append(max(broken, key=lambda b: b.compute_violation(_map_values(names, values))))
        while active:
            rows = np.stack([_build_bound_row(b, names) for b in active])
            missing = np.array([b.compute_violation(_map_values(names, start)) for b in active])
            pull = np.linalg.lstsq(rows @ covariance @ rows.T, missing, rcond=None)[0]
            if pull.min() >= 0.0:
                break
            active.pop(int(np.argmin(pull)))
        values = start + covariance @ rows.T @ pull if active else start
    return _snap_to_bounds(names, values, listed, active)


def _snap_to_bounds(
    names: Sequence[str], values: Float, listed: Sequence[ParameterBound], active: Sequence[ParameterBound]
) -> Float:
    """Return the values exactly on their ``active`` bounds, to the last bit."""
    named = _map_values(names, values)
    for bound in listed:
        if bound in active or bound.compute_violation(named) > 0.0:
            others = sum(weight * named[name] for name, weight in bound.weights.items() if name != bound.moves)
            named[bound.moves] = (bound.least - others) / bound.weights[bound.moves]
    return np.array([*named.values()])


def _separate_load(estimate: Estimate, direction: int) -> Estimate:
    found = find_significant_violations(estimate.names, estimate.values, estimate.covariance)
    surely = [(bound, value) for bound, value in found if set(bound.weights) <= set(_FRICTION)]
    if not surely or "load" in estimate.names:
        return estimate
    bound, pushing_nm = min(surely, key=lambda pair: pair[1])
    size = len(estimate.names)
    as_load = np.vstack([np.eye(size), direction * _build_bound_row(bound, estimate.names)])
    values = np.append(estimate.values, direction * pushing_nm)
    values[estimate.names.index("Cd")] -= pushing_nm
    systematic = estimate.systematic
    if systematic is not None:
        systematic = freeze_array(as_load @ np.pad(systematic, ((0, size - len(systematic)), (0, 0))))
    return replace(
        estimate,
        names=(*estimate.names, "load"),
        values=freeze_array(values),
        covariance=freeze_array(as_load @ estimate.covariance @ as_load.T),
        systematic=systematic,
    )
