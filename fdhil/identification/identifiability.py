"""Withholds parameters that the data do not determine: each gets a reason instead of a value."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fdhil.identification.physical_bounds import find_significant_violations
from fdhil.records import PARAMETERS, Estimate, Float, Reason, Result

CONDITION_LIMIT = 1e6
MOST_SHOWN_PERCENT = 999_999
RELATIVE_STD_LIMIT: Mapping[str, float] = {"R": 0.10, "L": 0.25, "K": 0.05, "Jt": 0.10, "ft": 0.5, "Cd": 0.5}
FRICTION_SHARE, TORQUE_SHARE = 0.25, 0.02
SIGNALS = "check the scale, sign, timing and order of these signals"
DETERMINED_BY_VOLTAGE = frozenset({"R", "L"})
PHYSICAL: Mapping[str, tuple[float, float]] = {
    "R": (1e-3, 1e3),
    "L": (1e-6, 10.0),
    "K": (1e-3, 100.0),
    "Jt": (1e-7, 100.0),
    "ft": (-np.inf, 10.0),
    "Cd": (-1e3, 1e3),  # in one direction with a load, which may assist
}

CURRENT_AND_SPEED = "current and speed"
ESTIMATED_FROM: Mapping[str, str] = {  # the signals of [1] and [2] that determine a parameter
    "R": "voltage and current",
    "L": "voltage and current",
    "K": "voltage and speed",
    "Jt": CURRENT_AND_SPEED,
    "ft": CURRENT_AND_SPEED,
    "Cd": CURRENT_AND_SPEED,
}


def is_admissible(theta: Float) -> bool:
    """Return whether R, L, K and Jt of ``theta`` = [R, L, K, Jt, ...] are above 0 and all is finite."""
    return bool(np.isfinite(theta).all() and (theta[:4] > 0).all())


def create_empty_estimate(method: str, result: Result, reason: Reason) -> Estimate:
    """Return an estimate without values, each missing for ``reason``."""
    k = len(PARAMETERS)
    return Estimate(
        method=method,
        names=PARAMETERS,
        values=np.full(k, np.nan),
        covariance=np.full((k, k), np.nan),
        residuals={},
        result=result,
        missing=dict.fromkeys(PARAMETERS, reason),
    )


def withhold_unidentifiable(estimate: Estimate, condition: float, top_rad_s: float, top_nm: float = 0.0) -> Estimate:
    """Return the estimate with its result set, and NaN with a reason for each parameter that the data do not determine.

    ``condition`` is that of the regressor with columns of equal length, ``top_rad_s`` the largest speed, ``top_nm`` the
    largest torque in the data.
    """
    if not np.isfinite(condition) or condition > CONDITION_LIMIT:
        text = f"the regressor is rank deficient (condition number {condition:.1e})"
        reason = Reason("RankDeficient", text, "record a rapid with acceleration and cruise")
        return create_empty_estimate(estimate.method, Result.ILL_CONDITIONED, reason)
    if not (np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()):
        return create_empty_estimate(
            estimate.method, Result.NOT_FINITE, Reason("NotFinite", "the fit is not finite", "record again")
        )
    missing = _find_uncertain_parameters(estimate, top_rad_s, top_nm)
    values, covariance = estimate.values.copy(), estimate.covariance.copy()
    for name in missing:
        k = estimate.names.index(name)
        values[k] = covariance[k, :] = covariance[:, k] = np.nan
    result = Result.UNDER_EXCITED if missing else estimate.result
    return replace(estimate, values=values, covariance=covariance, missing=missing, result=result)


def _find_uncertain_parameters(estimate: Estimate, top_rad_s: float, top_nm: float) -> dict[str, Reason]:
    missing = {}
    friction = abs(estimate.get_value("ft")) * top_rad_s + abs(estimate.get_value("Cd"))
    # a friction coefficient may be zero: its interval is compared with the total friction torque, or, since a weight
    # may balance it in one direction, with the drive's torque
    matters = max(FRICTION_SHARE * friction, TORQUE_SHARE * top_nm)
    least = {"ft": matters / max(top_rad_s, 1e-300), "Cd": matters}
    for name, limit in RELATIVE_STD_LIMIT.items():
        value, std = estimate.get_value(name), estimate.get_std(name)
        size = max(abs(value), least.get(name, 0.0))
        share = std / size if size else np.inf
        if share > limit:
            shown = f"{min(100 * share, MOST_SHOWN_PERCENT):.0f} %"
            text = f"the standard deviation of {name} is {shown} of its size, limit {100 * limit:.0f} %"
            advice = f"record rapids at other speeds and in both directions, or check {ESTIMATED_FROM[name]}"
            missing[name] = Reason("LowExcitation", text, advice)
    return missing


def list_missing_reasons(estimate: Estimate, *, slow: bool) -> list[Reason]:
    """Return the reasons why an estimate with missing parameters is not accepted, each once.

    Only the voltage's waveform determines R and L. A ``slow`` sensor may leave them open in a good window: they are
    null with their reasons, and the other parameters remain valid.
    """
    if slow and set(estimate.missing) <= DETERMINED_BY_VOLTAGE and estimate.result is Result.UNDER_EXCITED:
        return []
    return list({r.text: r for r in estimate.missing.values()}.values())


def find_unphysical_values(estimate: Estimate, *, one_way: bool = False) -> list[Reason]:
    """Return a reason for each value outside the range of feed drives; a NaN has its own reason.

    Friction may be negligible, so only a significantly negative one is unphysical. In ``one_way`` moves a constant load
    is part of Cd and may exceed all friction.
    """
    reasons = []
    for name, (low, high) in PHYSICAL.items():
        value = estimate.get_value(name)
        if np.isfinite(value) and not low <= value <= high:
            text = f"{name} = {value:.4g} lies outside {max(low, 0):.3g} to {high:.3g}: {ESTIMATED_FROM[name]} disagree"
            reasons.append(Reason("Unphysical", text, SIGNALS))
    for bound, value in find_significant_violations(estimate.names, estimate.values, estimate.covariance):
        if one_way and "Cd" in bound.weights:
            continue
        name = " + ".join(bound.weights)
        high = PHYSICAL[name][1] if name in PHYSICAL else np.inf
        text = f"{name} = {value:.4g} lies outside {bound.least:.3g} to {high:.3g}: {CURRENT_AND_SPEED} disagree"
        advice = f"record rapids in both directions, as a weight may move the axis; else {SIGNALS}"
        reasons.append(Reason("Unphysical", text, advice))
    return reasons
