"""The accepted windows of one drive together, and whether they agree with each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from fdhil.config import Identification
from fdhil.identification.covariance import aliasing
from fdhil.identification.estimators import chosen
from fdhil.identification.identifiability import unphysical, untold
from fdhil.records import PARAMETERS, Estimate, Float, Reason, Verdict, Window, WindowOutcome, frozen

BEYOND_CHANCE = 5.0
# of a doubt that windows of one drive share, what may still differ between them: its size depends on the regulators,
# which are the same, and a little on the move
UNSHARED = 0.2
MODEL_SHARE = 0.003  # how well equal drives agree at any noise: the voltage's course within a sample is not known
UNEXPLAINED = 30.0  # chi-square of 5 degrees of freedom: 2e-5 by chance
GAINS: Mapping[str, Float] = {  # powers of R, L, K, Jt, ft, Cd
    "voltage": np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
    "current": np.array([-1.0, -1.0, 0.0, 1.0, 1.0, 1.0]),
    "speed": np.array([0.0, 0.0, -1.0, -2.0, -2.0, -1.0]),
}
LEAST_GAIN_CHANGE = 0.02
LEAST_CHANGE: Mapping[str, float] = {"R": 0.02, "L": 0.03, "K": 0.01, "Jt": 0.02, "ft": 0.15, "Cd": 0.10}


def pool(
    outcomes: Sequence[WindowOutcome], settings: Identification, *, refit: bool = True
) -> tuple[Estimate | None, Verdict]:
    """Estimate from the accepted windows together; None and a refusal when there is none, or when they disagree.

    With ``refit`` all samples are fitted once more. Without it the windows' own estimates are weighted by their
    information, which is as good when each window tells all six parameters, and takes no time: for a running machine.
    """
    if not outcomes:
        reason = Reason(
            "NoWindow", "the recording holds no rapid move", "record moves at 60 % of the rapid speed or more"
        )
        return None, Verdict(False, None, (reason,))
    accepted = [o for o in outcomes if o.verdict.accepted]
    if not accepted:
        seen = dict.fromkeys(r for o in outcomes for r in o.verdict.reasons)
        return None, Verdict(False, None, tuple(seen))
    fits = [o.verdict.fit_percent for o in accepted if o.verdict.fit_percent is not None]
    if len(accepted) == 1 and accepted[0].estimate is not None:
        return accepted[0].estimate, Verdict(True, accepted[0].verdict.fit_percent)
    told = [(o.window, o.estimate) for o in accepted if o.estimate is not None]
    try:
        estimate = None if refit else weighted(told)
        if estimate is None:
            estimate = chosen(settings)[1]([o.window for o in accepted], settings)
    except (np.linalg.LinAlgError, FloatingPointError, ZeroDivisionError, OverflowError) as error:
        return None, Verdict(
            False, None, (Reason("SolverFailed", f"the solver gave up ({error})", "look at the windows"),)
        )
    slow = any(o.window.slow_voltage is not None for o in accepted)
    reasons = untold(estimate, slow=slow) + unphysical(estimate)
    reasons += _moved(told)
    return estimate, Verdict(not reasons, min(fits, default=None), tuple(reasons))


def weighted(told: Sequence[tuple[Window, Estimate]]) -> Estimate | None:
    """Return the estimates weighted by the inverse covariance of each window's own chance; None when one lacks a value.

    What windows share (the systematic part, and what instants of the voltage miss) does not average away: it goes
    through the same weights.
    """
    first = told[0][1]
    scale = np.where(first.values != 0.0, np.abs(first.values), 1.0)  # the parameters differ by orders of magnitude
    information = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    pull = np.zeros(len(PARAMETERS))
    shared = np.zeros((len(PARAMETERS), 2 + len(PARAMETERS)))
    for window, estimate in told:
        if not (np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()):
            return None
        own, systematic, alias = _parts(window, estimate)
        weight = np.linalg.inv(own / np.outer(scale, scale))
        information += weight
        pull += weight @ (estimate.values / scale)
        shared += weight @ (np.column_stack([systematic, np.diag(alias)]) / scale[:, None])
    covariance = np.linalg.inv(information)
    doubts = (covariance @ shared) * scale[:, None]
    return replace(
        first,
        values=frozen(covariance @ pull * scale),
        covariance=frozen(covariance * np.outer(scale, scale) + doubts @ doubts.T),
        residuals={},
        delay_s=None,
        delay_std_s=None,
        systematic=frozen(doubts[:, :2]),
    )


def _moved(told: Sequence[tuple[Window, Estimate]]) -> list[Reason]:
    """Return a reason for each parameter that differs between windows beyond chance and by enough to matter.

    One sensor's gain moves several parameters at once, each in its own proportion: where that explains all of it, the
    sensor is the reason, even where no parameter alone moves enough to tell.
    """
    reasons: list[Reason] = []
    worst = (0, 0)
    estimates = [estimate for _, estimate in told]
    for k, name in enumerate(PARAMETERS):
        values = np.array([e.value(name) for e in estimates])
        if np.count_nonzero(np.isfinite(values)) < 2:
            continue  # a slow voltage may leave R and L open
        low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
        apart = float(values[high] - values[low])
        chance = BEYOND_CHANCE * float(np.sqrt(difference_covariance(told[low], told[high])[k, k]))
        if apart > max(chance, LEAST_CHANGE[name] * abs(float(np.nanmedian(values)))):
            worst = worst if reasons else (min(low, high), max(low, high))
            code = "LoadChanged" if name == "Jt" else "ParameterJump"
            text = f"{name} moves from {values[low]:.4g} to {values[high]:.4g} between the windows"
            reasons.append(Reason(code, text, "identify the windows before and after the change apart"))
    if len(reasons) == 1:
        return reasons
    suspected = [(told[worst[0]], told[worst[1]])] if reasons else list(pairwise(told))
    sensors = [reason for pair in suspected if (reason := gain_change(*pair)) is not None]
    return sensors[:1] or reasons


def difference_covariance(one: tuple[Window, Estimate], other: tuple[Window, Estimate]) -> Float:
    """Return the covariance (6, 6) of the difference between what two windows of one drive tell.

    What is not known of the voltage's course within its samples is the regulators' doing and the same in both: with s
    and t what it does to either estimate, it moves their difference by s - t only, and hides no change of the drive.
    """
    (own, systematic, alias), (its_own, its_systematic, its_alias) = _parts(*one), _parts(*other)
    apart = systematic - its_systematic
    unshared = systematic @ systematic.T + its_systematic @ its_systematic.T + np.diag(alias**2 + its_alias**2)
    covariance: Float = own + its_own + apart @ apart.T + np.diag((alias - its_alias) ** 2) + UNSHARED**2 * unshared
    return covariance


def _parts(window: Window, estimate: Estimate) -> tuple[Float, Float, Float]:
    """Return the covariance (6, 6) of a window's own chance, and the doubts (6, 2) and (6,) that it shares."""
    size = len(PARAMETERS)
    systematic = np.zeros((size, 2)) if estimate.systematic is None else estimate.systematic
    slow = window.slow_voltage
    period = window.dt_s if slow is None else slow.period_s
    alias = aliasing(window.voltage_sampling, period) * np.abs(estimate.values)
    return estimate.covariance - systematic @ systematic.T - np.diag(alias**2), systematic, alias


def gain_change(one: tuple[Window, Estimate], other: tuple[Window, Estimate]) -> Reason | None:
    """Return the reason when one sensor's gain explains all that differs between two estimates; None when none does.

    With g the factor of a sensor's gain, [1] and [2] hold again for parameters times g to the powers of ``GAINS``.
    """
    before, after = one[1], other[1]
    names = [name for name in PARAMETERS if before.value(name) > 0 and after.value(name) > 0]
    if len(names) < len(PARAMETERS) - 1:  # friction may be nil
        return None
    rows = [PARAMETERS.index(name) for name in names]
    moved = np.log(after.values[rows] / before.values[rows])
    apart = difference_covariance(one, other) / np.outer(before.values, after.values)
    spread = apart[np.ix_(rows, rows)] + np.diag(np.full(len(rows), MODEL_SHARE**2))
    weight: Float = np.asarray(np.linalg.inv(spread), dtype=np.float64)
    singles = np.eye(len(rows))
    patterns = {name: powers[rows] for name, powers in GAINS.items()}
    left = {name: _unexplained(moved, weight, pattern)[1] for name, pattern in patterns.items()}
    sensor = min(left, key=lambda name: left[name])
    if left[sensor] > min(UNEXPLAINED, *(_unexplained(moved, weight, single)[1] for single in singles)):
        return None
    amplitude = _unexplained(moved, weight, patterns[sensor])[0]
    deviation = float(patterns[sensor] @ weight @ patterns[sensor]) ** -0.5
    share = float(np.expm1(amplitude))
    if abs(amplitude) < BEYOND_CHANCE * deviation or abs(share) < LEAST_GAIN_CHANGE:
        return None
    text = f"the gain of {sensor} changes by {share:+.2%} between the windows: that alone explains what moves"
    return Reason("CalibrationSuspect", text, f"check the {sensor} sensor and its wiring")


def _unexplained(moved: Float, weight: Float, pattern: Float) -> tuple[float, float]:
    """Return the best amplitude of a pattern, and the chi-square that it leaves."""
    amplitude = float(pattern @ weight @ moved / (pattern @ weight @ pattern))
    rest = moved - amplitude * pattern
    return amplitude, float(rest @ weight @ rest)
