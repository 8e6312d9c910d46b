"""Pools the accepted windows of one drive: estimated together, and refused where they disagree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fdhil.config import Identification
from fdhil.identification.estimators import chosen
from fdhil.identification.identifiability import unphysical, untold
from fdhil.identification.pooling import weighted
from fdhil.identification.without_voltage import pooled
from fdhil.pipeline.analysis import GAVE_UP, gave_up
from fdhil.records import Estimate, Reason, Verdict, Window, WindowOutcome
from fdhil.validation.agreement import moved


def pool(
    outcomes: Sequence[WindowOutcome], settings: Identification, *, refit: bool = True
) -> tuple[Estimate | None, Verdict]:
    """Estimate from the accepted windows together; None and a refusal when there is none, or when they disagree.

    With ``refit`` all samples are fitted once more. Without it the windows' own estimates are weighted by their
    information, which is as good when each window tells all six parameters, and takes no time: for a running machine.
    """
    if not outcomes:
        advice = "record moves at 60 % of the rapid speed or more"
        return None, Verdict(False, None, (Reason("NoWindow", "the recording holds no rapid move", advice),))
    accepted = [o for o in outcomes if o.verdict.accepted]
    if not accepted:
        seen = dict.fromkeys(r for o in outcomes for r in o.verdict.reasons)
        return None, Verdict(False, None, tuple(seen))
    fits = [o.verdict.fit_percent for o in accepted if o.verdict.fit_percent is not None]
    if len(accepted) == 1 and accepted[0].estimate is not None:
        return accepted[0].estimate, Verdict(True, accepted[0].verdict.fit_percent)
    told = [(o.window, o.estimate) for o in accepted if o.estimate is not None]
    deaf = not any(w.voltage_v is not None or w.slow_voltage is not None for w, _ in told)
    try:
        estimate = pooled(told, settings) if deaf else None if refit else weighted(told)
        if estimate is None:
            estimate = chosen(settings)[1]([o.window for o in accepted], settings)
    except GAVE_UP as error:
        return None, Verdict(False, None, (gave_up(error, "look at the windows"),))
    slow = any(o.window.slow_voltage is not None for o in accepted)
    reasons = untold(estimate, slow=slow or deaf) + unphysical(estimate) + _moved(told, deaf)
    return estimate, Verdict(not reasons, min(fits, default=None), tuple(reasons))


def _moved(told: Sequence[tuple[Window, Estimate]], deaf: bool) -> list[Reason]:
    """Return what differs between windows; without a voltage a constant load makes friction differ by direction."""
    if not deaf:
        return moved(told)
    six = [(w, replace(e, values=e.values[:6], covariance=e.covariance[:6, :6])) for w, e in told]
    ways = ([pair for pair in six if pair[0].direction == side] for side in (1, -1))
    return [reason for way in ways if len(way) > 1 for reason in moved(way)]
