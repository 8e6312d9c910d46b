"""Pools the accepted windows of one drive: estimated together, and refused where they disagree."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from fdhil.config import Identification
from fdhil.identification.between import ALIKE, Between, Member, between
from fdhil.identification.estimators import chosen
from fdhil.identification.identifiability import unphysical, untold
from fdhil.identification.physical_bounds import bounded
from fdhil.identification.pooling import member, pooled
from fdhil.pipeline.analysis import GAVE_UP, gave_up
from fdhil.records import PARAMETERS, Estimate, Reason, Verdict, Window, WindowOutcome, frozen
from fdhil.validation.agreement import moved
from fdhil.validation.weight import LOOPS_DIFFER

# causes of refusal that do not concern the model: the samples, or the course of the move
OF_THE_MOVE = (
    "Missing",
    "Episode",
    "Stale",
    "Stuck",
    "Saturated",
    "Implausible",
    "NotFinite",
    "LoadDetected",
    "Timing",
)
WARMING = "R"
_FIGURES = re.compile(r"[-+]?[0-9][-+.0-9e]*")  # figures, in which warnings of one kind differ

WindowEstimates = list[tuple[Window, Estimate]]


def pool(
    outcomes: Sequence[WindowOutcome], settings: Identification, *, refit: bool = True
) -> tuple[Estimate | None, Verdict]:
    """Estimate from the accepted windows together; None and a refusal if there is none, or if they disagree.

    With ``refit`` all samples are fitted once more, if the windows determine the same six parameters. Without it the
    windows' own estimates are pooled, which is as good if each window determines all six, and takes no time.
    """
    if not outcomes:
        advice = "record moves at 60 % of the rapid speed or more, or identify from any move with --any-move"
        return None, Verdict(False, None, (Reason("NoWindow", "the recording holds no rapid move", advice),))
    members = [member(o.window, o.estimate, k) for k, o in enumerate(outcomes) if o.verdict.accepted and o.estimate]
    estimate, verdict = together(outcomes, members, members, settings, refit=refit)
    estimate = estimate and _with_drift(estimate, members)
    refuted = _loops_refuted(outcomes) if verdict.accepted else []
    return estimate, replace(verdict, accepted=False, reasons=tuple(refuted)) if refuted else verdict


def _with_drift(estimate: Estimate, members: Sequence[Member]) -> Estimate:
    apart = between(members)
    if not apart.walk.get(WARMING):
        return estimate
    covariance, k = estimate.covariance.copy(), estimate.names.index(WARMING)
    places = [m.place for m in members]
    covariance[k, k] += apart.walk[WARMING] * apart.sizes[WARMING] ** 2 * (max(places) - min(places))
    return replace(estimate, covariance=frozen(covariance))


def together(
    outcomes: Sequence[WindowOutcome],
    members: Sequence[Member],
    history: Sequence[Member],
    settings: Identification,
    *,
    refit: bool = False,
) -> tuple[Estimate | None, Verdict]:
    """Return the joint estimate of ``members``, the accepted among the ``outcomes``, and its verdict.

    ``history`` are all windows that show how much windows of this drive differ.
    """
    accepted = [o for o in outcomes if o.verdict.accepted and o.estimate is not None]
    if not accepted:
        seen = dict.fromkeys(r for o in outcomes for r in o.verdict.reasons)
        return None, Verdict(False, None, tuple(seen))
    estimates: WindowEstimates = [(o.window, o.estimate) for o in accepted if o.estimate is not None]
    reasons = list(one_sided(outcomes))
    estimate = estimates[0][1]
    if len(estimates) > 1:
        try:
            estimate = _estimated(estimates, members, between(history), settings, refit=refit)
        except GAVE_UP as error:
            return None, Verdict(False, None, (gave_up(error, "inspect the windows"),))
        # with a slow voltage, or without one, R and L may be undetermined
        slow = any(window.slow_voltage is not None or window.voltage_v is None for window, _ in estimates)
        reasons += untold(estimate, slow=slow)
    beyond = unphysical(estimate)
    return (estimate if beyond else bounded(estimate)), _verdict(accepted, [*reasons, *beyond, *moved(estimates)])


def _estimated(
    estimates: WindowEstimates, members: Sequence[Member], apart: Between, settings: Identification, *, refit: bool
) -> Estimate:
    """Return the estimate of all samples if the windows are of one kind, else the mixed model's."""
    first = estimates[0][1]
    quick = pooled(members, first, apart)
    whole = all(set(PARAMETERS) <= set(m.names) for m in members)
    voltageless = all(window.voltage_v is None and window.slow_voltage is None for window, _ in estimates)
    if voltageless or quick.terms or apart.surely or (whole and not refit):
        return quick
    again = chosen(settings)[1]([window for window, _ in estimates], settings)
    same = pooled(members, first, ALIKE)
    if not again.names == same.names == quick.names:
        return again
    wider = np.nan_to_num(quick.covariance - same.covariance)  # zero where a slow voltage leaves R or L undetermined
    return replace(again, covariance=frozen(again.covariance + wider))


def one_sided(outcomes: Iterable[WindowOutcome]) -> list[Reason]:
    """Return the reason if windows of one direction are accepted while the model was refused in the other.

    A load that acts one way is part of dry friction then, by an unknown share.
    """
    listed = list(outcomes)
    directions = {o.window.direction for o in listed if o.verdict.accepted}
    refused = [o for o in listed if o.window.direction not in directions and refuses_the_model(o)]
    if len(directions) != 1 or not refused:
        return []
    way = "positive" if refused[0].window.direction > 0 else "negative"
    cause = refused[0].verdict.reasons[0]
    text = (
        f"no move in the {way} direction is accepted ({cause.code}), "
        "and friction in one direction does not show that in the other"
    )
    return [Reason("OneDirection", text, cause.advice or "see why the other moves are refused")]


def _loops_refuted(outcomes: Sequence[WindowOutcome]) -> list[Reason]:
    """Return the reason if as many rapids refute the loops as were accepted with them.

    They concern the drive's loops, not its parameters: the model would be used with wrong loops.
    """
    refuting = [o for o in outcomes if [r.code for r in o.verdict.reasons] == [LOOPS_DIFFER]]
    accepted = sum(o.verdict.accepted for o in outcomes)
    if not refuting or len(refuting) < accepted:
        return []
    cause = refuting[0].verdict.reasons[0]
    text = f"{len(refuting)} rapids refute the loops with which {accepted} were accepted, and no loops explain all"
    return [Reason(LOOPS_DIFFER, f"{text}: {cause.text}", cause.advice)]


def refuses_the_model(outcome: WindowOutcome) -> bool:
    """Return whether a window was refused for its drive's behaviour, not for its samples or an aborted move."""
    codes = [reason.code for reason in outcome.verdict.reasons]
    return not outcome.verdict.accepted and not any(part in code for code in codes for part in OF_THE_MOVE)


def _verdict(accepted: Sequence[WindowOutcome], reasons: Sequence[Reason]) -> Verdict:
    """Return the pool's verdict: its own reasons, the worst of the windows' figures, each of their warnings once."""
    verdicts = [o.verdict for o in accepted]
    fits = [v.fit_percent for v in verdicts if v.fit_percent is not None]
    unexplained = [v.unexplained_um for v in verdicts if v.unexplained_um is not None]
    warnings = {_FIGURES.sub("", str(warning)): warning for v in verdicts for warning in v.warnings}
    unique = list(warnings.values())
    if len({o.window.direction for o in accepted}) == 1 and not reasons and accepted[0].window.is_rapid:
        text = "all moves are in one direction: a constant load cannot be separated from Cd"
        unique.append(Reason("OneDirection", text, "record rapids in both directions"))
    figure = max(unexplained, default=None)
    return Verdict(not reasons, min(fits, default=None), tuple(reasons), figure, tuple(unique))
