"""Names a sensor whose gain is wrong all along, which the recording cannot tell, against the data sheet.

The model looks the same when one signal is multiplied by a constant: each parameter is then multiplied by a power of
that constant (``GAINS``). Only known values tell. A gain is named where several of R, L, K and Jt lie farther from the
data sheet than it may be off, and the gain of one signal alone takes all of them back within.
"""

from __future__ import annotations

import math

import numpy as np

from fdhil.records import PARAMETERS, Estimate, Float, Parameters, Reason
from fdhil.validation.agreement import GAINS
from fdhil.validation.significance import BUDGET

TOLERANCE = 0.15  # of a data sheet's R (cold), L, K, and of an inertia that was computed
COMPARED = ("R", "L", "K", "Jt")  # friction is no value of a data sheet
LEAST_BEYOND = 2  # one alone is a warm winding, a saturated core, another load


def gain_error(estimate: Estimate, nominal: Parameters) -> Reason | None:
    """Return the signal whose constant gain explains how the estimate differs from the data sheet, None for none."""
    known = [name for name in COMPARED if name not in estimate.given]  # what is given tells of no sensor
    told = [name for name in known if estimate.value(name) > 0 and np.isfinite(estimate.std(name))]
    if len(told) < LEAST_BEYOND:
        return None
    rows = [PARAMETERS.index(name) for name in told]
    values = np.array([estimate.value(name) for name in told])
    apart = np.log(values / [getattr(nominal, name) for name in told])
    sure = BUDGET["data sheet"].deviations
    allowed = math.log1p(TOLERANCE) + sure * np.array([estimate.std(name) for name in told]) / values
    if np.count_nonzero(np.abs(apart) > allowed) < LEAST_BEYOND:
        return None
    explained = {signal: _amplitude(apart, allowed, powers[rows]) for signal, powers in GAINS.items()}
    found = [(rest, signal, amplitude) for signal, (amplitude, rest) in explained.items() if amplitude != 0.0]
    if not found:
        return None
    _, signal, amplitude = min(found)
    shifts = ", ".join(f"{name} {math.expm1(shift):+.0%}" for name, shift in zip(told, apart, strict=True))
    text = (
        f"the {signal} is read {math.exp(amplitude):.2f} times as large as it is: that alone explains {shifts} against "
        f"the data sheet, which may be {TOLERANCE:.0%} off"
    )
    return Reason("CalibrationSuspect", text, f"check the scale of the {signal}, or correct the nominal values")


def _amplitude(apart: Float, allowed: Float, pattern: Float) -> tuple[float, float]:
    """Return the logarithm of the gain that explains what is apart, and what it leaves; 0 when it does not explain it.

    It must be more than values within what is allowed can make.
    """
    square = float(pattern @ pattern)
    if square == 0.0:
        return 0.0, math.inf
    amplitude = float(pattern @ apart) / square
    rest = np.abs(apart - amplitude * pattern)
    if (rest > allowed).any() or abs(amplitude) * square <= float(np.abs(pattern) @ allowed):
        return 0.0, math.inf
    return amplitude, float(np.linalg.norm(rest))
