"""Detects a constant gain error of a sensor, which no recording shows, by comparison with the data sheet.

The model looks the same when one signal is multiplied by a constant: each parameter is then multiplied by a power of
that constant (``GAINS``). Only known values reveal it. A gain error is reported if several of R, L, K and Jt lie
farther from the data sheet than its tolerance, and the gain of one signal alone brings all of them back within.
"""

from __future__ import annotations

import math

import numpy as np

from fdhil.records import PARAMETERS, Estimate, Float, Parameters, Reason
from fdhil.validation.estimate_agreement import GAINS
from fdhil.validation.false_alarm_budget import BUDGET

TOLERANCE = 0.15  # of a data sheet's R (cold), L, K, and of a computed inertia
FRICTION_TOLERANCE = 0.30  # the same, where friction is compared too
WINDING, TORQUES = ("R", "L", "K"), ("Jt", "ft", "Cd")
COMPARED = (*WINDING, "Jt")  # a data sheet does not list friction
# factor of K and Jt, and the recorded values that cause it
CONVENTIONS = (
    (2 / 3, "peak values of a phase, or dq values of the same amplitude"),
    (3 / 2, "larger than those that keep the power, by 1.22 each"),
    (1 / 3, "RMS values of a phase"),
)
CONVENTION_TOLERANCE = 0.08  # to which a data sheet's K agrees with one of them
LEAST_BEYOND = 2  # a single one is a warm winding, a saturated core, another load


def detect_gain_error(estimate: Estimate, nominal: Parameters) -> Reason | None:
    """Return the signals whose constant gain explains how the estimate differs from the data sheet; None for none.

    Without a voltage, K of the estimate comes from the data sheet: then inertia and friction reveal the current's gain.
    """
    blind = set(WINDING) <= set(estimate.given)  # given values show no sensor's gain
    compared, tolerance = (TORQUES, FRICTION_TOLERANCE) if blind else (COMPARED, TOLERANCE)
    names = [name for name in compared if estimate.get_value(name) > 0 and np.isfinite(estimate.get_std(name))]
    names = [name for name in names if name not in estimate.given and getattr(nominal, name) > 0]
    if len(names) < LEAST_BEYOND:
        return None
    rows = [PARAMETERS.index(name) for name in names]
    values = np.array([estimate.get_value(name) for name in names])
    apart = np.log(values / [getattr(nominal, name) for name in names])
    sure = BUDGET["data sheet"].deviations
    shared = np.zeros(len(rows)) if estimate.systematic is None else np.square(estimate.systematic[rows]).sum(axis=1)
    chance = np.array([estimate.get_std(name) for name in names]) ** 2 - shared
    allowed = math.log1p(tolerance) + (sure * np.sqrt(np.maximum(chance, 0.0)) + np.sqrt(shared)) / values
    if np.count_nonzero(np.abs(apart) > allowed) < LEAST_BEYOND:
        return None
    suspects = [("current",)] if blind else [*((signal,) for signal in GAINS), ("voltage", "current")]
    found = [
        (signals, _fit_gains(apart, allowed, np.column_stack([GAINS[s][rows] for s in signals])))
        for signals in suspects
    ]
    known = [(len(signals), rest, signals, gains) for signals, (gains, rest) in found if gains is not None]
    if not known:
        return None
    _, _, signals, gains = min(known)
    shifts = ", ".join(f"{name} {math.expm1(shift):+.0%}" for name, shift in zip(names, apart, strict=True))
    read = " and ".join(f"the {s} is read {g:.2f} times as large as it is" for s, g in zip(signals, gains, strict=True))
    text = f"{read}: that alone explains {shifts} against the data sheet, which may be {tolerance:.0%} off"
    advice = f"check the scale of the {' and the '.join(signals)}, or correct the nominal values"
    return Reason("CalibrationSuspect", text, advice)


def detect_scale_convention(estimate: Estimate, nominal: Parameters) -> Reason | None:
    """Return the convention by which a three-phase motor's current and voltage are recorded, if not the model's.

    The torque of a motor is its power over its speed, so that K of [1] is K of [2], in values that keep the power. Peak
    values of a phase, or RMS ones, do not: K, Jt, ft and Cd are then off by one factor, and R and L by none.
    """
    names = [name for name in COMPARED if name not in estimate.given and getattr(nominal, name) > 0]
    apart = {name: estimate.get_value(name) / getattr(nominal, name) for name in names}
    if set(names) != set(COMPARED) or not all(ratio > 0.0 for ratio in apart.values()):
        return None
    share, inertia = math.log(apart["K"]), math.log(apart["Jt"])
    if abs(share) < math.log1p(TOLERANCE) or abs(share - inertia) > math.log1p(TOLERANCE):
        return None
    if any(abs(math.log(apart[name])) > math.log1p(FRICTION_TOLERANCE) for name in ("R", "L")):
        return None
    factor, which = min(CONVENTIONS, key=lambda one: abs(share - math.log(one[0])))
    if abs(share - math.log(factor)) > math.log1p(CONVENTION_TOLERANCE):
        return None
    text = (
        f"K and Jt are {apart['K']:.2f} and {apart['Jt']:.2f} times those of the data sheet, R and L are as there: "
        f"current and voltage are {which}, and K, Jt, ft and Cd are {factor:.3g} times what they are"
    )
    advice = "set the scales of current and voltage so that their product is the power"
    return Reason("CalibrationSuspect", text, advice)


def _fit_gains(apart: Float, allowed: Float, patterns: Float) -> tuple[tuple[float, ...] | None, float]:
    """Return the gains (q,) that explain all differences, and the residual; None where they do not explain them.

    Each gain must exceed what values within their tolerance can produce.
    """
    inverse = np.linalg.pinv(patterns / allowed[:, None]) / allowed
    amplitudes = inverse @ apart
    rest = np.abs(apart - patterns @ amplitudes) / allowed
    if (rest > 1.0).any() or (np.abs(amplitudes) <= np.abs(inverse) @ allowed).any():
        return None, math.inf
    return tuple(np.exp(amplitudes).tolist()), float(np.linalg.norm(rest))
