"""The accepted windows of one drive together, and whether they agree with each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from fdhil.config import Identification
from fdhil.identification.estimators import chosen
from fdhil.identification.identifiability import unphysical
from fdhil.records import PARAMETERS, Estimate, Reason, Verdict, WindowOutcome

BEYOND_CHANCE = 5.0
LEAST_CHANGE: Mapping[str, float] = {"R": 0.02, "L": 0.03, "K": 0.01, "Jt": 0.02, "ft": 0.15, "Cd": 0.10}


def pool(outcomes: Sequence[WindowOutcome], settings: Identification) -> tuple[Estimate | None, Verdict]:
    """Estimate from the accepted windows together; None and a refusal when there is none, or when they disagree."""
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
        estimate = chosen(settings)[1]([o.window for o in accepted], settings)
    except (np.linalg.LinAlgError, FloatingPointError, ZeroDivisionError, OverflowError) as error:
        return None, Verdict(
            False, None, (Reason("SolverFailed", f"the solver gave up ({error})", "look at the windows"),)
        )
    reasons = list({r.text: r for r in estimate.missing.values()}.values()) + unphysical(estimate)
    reasons += _moved([o.estimate for o in accepted if o.estimate is not None])
    return estimate, Verdict(not reasons, min(fits, default=None), tuple(reasons))


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
