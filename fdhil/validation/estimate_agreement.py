"""Checks that methods agree on one window, and the windows of one drive with each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, pairwise

import numpy as np

from fdhil.identification import FRICTION_PARAMETERS, LEAST_JUMP, compute_difference_covariance
from fdhil.records import PARAMETERS, Estimate, Float, Reason, Window
from fdhil.validation.false_alarm_budget import BUDGET

BEYOND_CHANCE = BUDGET["between windows"].deviations
MODEL_SHARE = 0.003  # agreement of equal drives at any noise: the voltage's course within a sample is unknown
UNEXPLAINED = 30.0  # chi-square of 5 degrees of freedom: 2e-5 by chance
GAINS: Mapping[str, Float] = {  # powers of R, L, K, Jt, ft, Cd
    "voltage": np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
    "current": np.array([-1.0, -1.0, 0.0, 1.0, 1.0, 1.0]),
    "speed": np.array([0.0, 0.0, -1.0, -2.0, -2.0, -1.0]),
}
LEAST_GAIN_CHANGE = 0.02
WARMING = ("R", *FRICTION_PARAMETERS)
WINDING_PARAMETERS = ("R", "L")
LEAST_CHANGE: Mapping[str, float] = {"R": 0.02, "L": 0.03, "K": 0.01, "Jt": 0.02, "ft": 0.15, "Cd": 0.10}

Pair = tuple[tuple[Window, Estimate], tuple[Window, Estimate]]


def find_deviating_values(estimate: Estimate, likeliest: Float) -> Iterator[Reason]:
    """Yield a reason for each value that its own interval separates from the ``likeliest`` (6,) of the same window.

    The structure is tested about the likeliest values: the values of another method are accepted as far as they agree.
    """
    for name, best in zip(PARAMETERS, likeliest, strict=True):
        value, std = estimate.get_value(name), estimate.get_std(name)
        if abs(value - best) > max(BEYOND_CHANCE * std, LEAST_CHANGE[name] * abs(best)):
            text = (
                f"{name} = {value:.4g} by {estimate.method} lies {abs(value - best) / std:.1f} of its standard "
                f"deviations from {best:.4g}, which fits the window best"
            )
            yield Reason("ValidationFailed", text, "identify by maximum_likelihood")


def find_parameter_jumps(estimates: Sequence[tuple[Window, Estimate]]) -> list[Reason]:
    """Return a reason for each parameter that differs between windows beyond chance and by enough to matter.

    L, K and Jt are the same in all windows, given in order. A drift by temperature is no jump: R is compared with the
    window before, friction with that before in the same direction, since a load and the screw change it in the other.
    One sensor's gain changes several parameters at once, each in its own proportion: where that explains all of it, the
    sensor is the reason, even where no single parameter changes significantly.
    """
    reasons: list[Reason] = []
    worst: Pair | None = None
    for name in PARAMETERS:
        pair = _find_largest_jump(estimates, name)
        if pair is None:
            continue
        worst = worst or pair
        code = "LoadChanged" if name == "Jt" else "ParameterJump"
        before, after = (estimate.get_value(name) for _, estimate in pair)
        text = f"{name} changes from {before:.4g} to {after:.4g} between the windows"
        reasons.append(Reason(code, text, "identify the windows before and after the change separately"))
    if len(reasons) == 1:
        return reasons
    suspected = [worst] if worst is not None else [*pairwise(estimates), *_pair_by_direction(estimates)]
    sensors = [reason for pair in suspected if (reason := detect_gain_change(*pair)) is not None]
    return sensors[:1] or reasons


def is_winding_jump(reason: Reason) -> bool:
    """Return whether a reason reports a jump of R or L: the current loop hides that at the table."""
    return reason.code == "ParameterJump" and reason.text.split(" ", 1)[0] in WINDING_PARAMETERS


def _find_largest_jump(estimates: Sequence[tuple[Window, Estimate]], name: str) -> Pair | None:
    """Return the two windows, in order, between which a parameter changes most, if that is a jump."""
    known = [(w, e) for w, e in estimates if np.isfinite(e.get_value(name))]  # a slow voltage may leave R and L open
    if len(known) < 2:
        return None
    pairs = list(combinations(known, 2)) if name not in WARMING else list(pairwise(known))
    if name in FRICTION_PARAMETERS:
        pairs = list(_pair_by_direction(known))
    if not pairs:
        return None
    one, other = max(pairs, key=lambda pair: abs(pair[1][1].get_value(name) - pair[0][1].get_value(name)))
    k = PARAMETERS.index(name)
    chance = BEYOND_CHANCE * float(np.sqrt(compute_difference_covariance(one, other)[k, k]))
    share = LEAST_JUMP[name] if name in WARMING else LEAST_CHANGE[name]
    least = share * abs(float(np.median([e.get_value(name) for _, e in known])))
    return (one, other) if abs(other[1].get_value(name) - one[1].get_value(name)) > max(chance, least) else None


def _pair_by_direction(estimates: Sequence[tuple[Window, Estimate]]) -> Iterator[Pair]:
    for direction in (1, -1):
        yield from pairwise([(w, e) for w, e in estimates if w.direction == direction])


def detect_gain_change(one: tuple[Window, Estimate], other: tuple[Window, Estimate]) -> Reason | None:
    """Return the reason if one sensor's gain explains all differences between two estimates; None if none does.

    With g the factor of a sensor's gain, [1] and [2] hold again for parameters times g to the powers of ``GAINS``.
    """
    before, after = one[1], other[1]
    names = [name for name in PARAMETERS if before.get_value(name) > 0 and after.get_value(name) > 0]
    if len(names) < len(PARAMETERS) - 1:  # friction may be zero
        return None
    if one[0].direction != other[0].direction:  # load and screw change friction by direction
        names = [name for name in names if name not in FRICTION_PARAMETERS]
    rows = [PARAMETERS.index(name) for name in names]
    moved = np.log(after.values[rows] / before.values[rows])
    apart = compute_difference_covariance(one, other) / np.outer(before.values[:6], after.values[:6])
    spread = apart[np.ix_(rows, rows)] + np.diag(np.full(len(rows), MODEL_SHARE**2))
    weight: Float = np.asarray(np.linalg.inv(spread), dtype=np.float64)
    singles = np.eye(len(rows))
    patterns = {name: powers[rows] for name, powers in GAINS.items()}
    left = {name: _fit_pattern(moved, weight, pattern)[1] for name, pattern in patterns.items()}
    sensor = min(left, key=lambda name: left[name])
    if left[sensor] > min(UNEXPLAINED, *(_fit_pattern(moved, weight, single)[1] for single in singles)):
        return None
    amplitude = _fit_pattern(moved, weight, patterns[sensor])[0]
    deviation = float(patterns[sensor] @ weight @ patterns[sensor]) ** -0.5
    share = float(np.expm1(amplitude))
    if abs(amplitude) < BEYOND_CHANCE * deviation or abs(share) < LEAST_GAIN_CHANGE:
        return None
    text = f"the gain of {sensor} changes by {share:+.2%} between the windows: that alone explains all changes"
    return Reason("CalibrationSuspect", text, f"check the {sensor} sensor and its wiring")


def _fit_pattern(moved: Float, weight: Float, pattern: Float) -> tuple[float, float]:
    """Return the best amplitude of a pattern, and the chi-square of the residuals."""
    amplitude = float(pattern @ weight @ moved / (pattern @ weight @ pattern))
    rest = moved - amplitude * pattern
    return amplitude, float(rest @ weight @ rest)
