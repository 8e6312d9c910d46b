"""The accepted windows of one drive together, and whether they agree with each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fdhil.config import Identification
from fdhil.identification.estimators import chosen
from fdhil.identification.identifiability import unphysical
from fdhil.records import PARAMETERS, Estimate, Reason, Verdict, WindowOutcome, frozen

BEYOND_CHANCE = 5.0
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
        seen = {r.code: r for o in outcomes for r in o.verdict.reasons}
        return None, Verdict(False, None, tuple(seen.values()))
    fits = [o.verdict.fit_percent for o in accepted if o.verdict.fit_percent is not None]
    if len(accepted) == 1 and accepted[0].estimate is not None:
        return accepted[0].estimate, Verdict(True, accepted[0].verdict.fit_percent)
    try:
        estimate = None if refit else weighted([o.estimate for o in accepted if o.estimate is not None])
        if estimate is None:
            estimate = chosen(settings)[1]([o.window for o in accepted], settings)
    except (np.linalg.LinAlgError, FloatingPointError, ZeroDivisionError, OverflowError) as error:
        return None, Verdict(
            False, None, (Reason("SolverFailed", f"the solver gave up ({error})", "look at the windows"),)
        )
    reasons = list({r.text: r for r in estimate.missing.values()}.values()) + unphysical(estimate)
    reasons += _moved([o.estimate for o in accepted if o.estimate is not None])
    return estimate, Verdict(not reasons, min(fits, default=None), tuple(reasons))


def weighted(estimates: Sequence[Estimate]) -> Estimate | None:
    """Return the estimates weighted by their information (inverse covariance); None when one of them lacks a value."""
    first = np.abs(estimates[0].values)
    scale = np.where(first > 0, first, 1.0)  # the parameters differ by orders of magnitude
    information = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    pull = np.zeros(len(PARAMETERS))
    for estimate in estimates:
        if not (np.isfinite(estimate.values).all() and np.isfinite(estimate.covariance).all()):
            return None
        weight = np.linalg.inv(estimate.covariance / np.outer(scale, scale))
        information += weight
        pull += weight @ (estimate.values / scale)
    covariance = np.linalg.inv(information)
    return replace(
        estimates[0],
        values=frozen(covariance @ pull * scale),
        covariance=frozen(covariance * np.outer(scale, scale)),
        residuals={},
        delay_s=None,
    )


def _moved(estimates: Sequence[Estimate]) -> Iterator[Reason]:
    """Yield a reason for each parameter that differs between windows beyond chance and by enough to matter."""
    for name in PARAMETERS:
        values = np.array([e.value(name) for e in estimates])
        stds = np.array([e.std(name) for e in estimates])
        low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
        apart = float(values[high] - values[low])
        chance = BEYOND_CHANCE * float(np.hypot(stds[low], stds[high]))
        if apart > max(chance, LEAST_CHANGE[name] * abs(float(np.nanmedian(values)))):
            code = "LoadChanged" if name == "Jt" else "ParameterJump"
            text = f"{name} moves from {values[low]:.4g} to {values[high]:.4g} between the windows"
            yield Reason(code, text, "identify the windows before and after the change apart")
