"""Pools the accepted windows of one drive, refuses a pool that disagrees, and validates it by held-out moves."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification import (
    NO_BETWEEN_VARIANCE,
    BetweenWindowVariance,
    PoolMember,
    align_demand_to_drive,
    bound_estimate,
    build_pool_member,
    estimate_between_window_variance,
    find_unphysical_values,
    identify_loops,
    list_missing_reasons,
    pool_estimates,
    select_estimator,
)
from fdhil.pipeline.identified_loops import adopt_loops
from fdhil.pipeline.window_analysis import GAVE_UP, build_solver_reason, select_matching_axis
from fdhil.records import (
    PARAMETERS,
    Estimate,
    HeldOut,
    LoopEstimate,
    Reason,
    Verdict,
    Window,
    WindowOutcome,
    freeze_array,
)
from fdhil.validation import (
    LOOPS_DIFFER,
    WINDING_PARAMETERS,
    Move,
    Replay,
    check_held_out_limit,
    find_parameter_jumps,
    fit_presliding,
    is_predicted,
    is_winding_jump,
    predict_held_out,
    summarise_worst,
)

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
OF_ONE_MOVE = frozenset({LOOPS_DIFFER, "ValidationFailed"})
"""Codes of a window whose own model does not explain its replay: moves one way do not separate load and friction."""
SCALE_UNPROVEN = Reason(
    "ScaleUnproven",
    "no data sheet is known: current and voltage in another scale (peak or RMS of a phase) scale K, Jt, ft and Cd",
    "give --config with the motor's nominal K and Jt",
)


def pool_windows(
    outcomes: Sequence[WindowOutcome], settings: Identification, *, refit: bool = True
) -> tuple[Estimate | None, Verdict]:
    """Estimate from the accepted windows together; None and a refusal if there is none, or if they disagree.

    With ``refit`` all samples are fitted once more, if the windows determine the same six parameters. Without it the
    windows' own estimates are pooled, which is as good if each window determines all six, and takes no time.
    """
    if not outcomes:
        advice = "record moves at 60 % of the rapid speed or more, or identify from any move with --any-move"
        return None, Verdict(False, None, (Reason("NoWindow", "the recording holds no rapid move", advice),))
    members = [
        build_pool_member(o.window, o.estimate, k) for k, o in enumerate(outcomes) if o.verdict.accepted and o.estimate
    ]
    estimate, verdict = estimate_together(outcomes, members, members, settings, refit=refit)
    estimate = estimate and _add_resistance_drift(estimate, members)
    refuted = _check_loop_refutations(outcomes) if verdict.accepted else []
    return estimate, replace(verdict, accepted=False, reasons=tuple(refuted)) if refuted else verdict


def _add_resistance_drift(estimate: Estimate, members: Sequence[PoolMember]) -> Estimate:
    apart = estimate_between_window_variance(members)
    if not apart.walk.get(WARMING):
        return estimate
    covariance, k = estimate.covariance.copy(), estimate.names.index(WARMING)
    places = [m.place for m in members]
    covariance[k, k] += apart.walk[WARMING] * apart.sizes[WARMING] ** 2 * (max(places) - min(places))
    return replace(estimate, covariance=freeze_array(covariance))


def estimate_together(
    outcomes: Sequence[WindowOutcome],
    members: Sequence[PoolMember],
    history: Sequence[PoolMember],
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
    reasons = list(check_both_directions(outcomes))
    estimate = estimates[0][1]
    if len(estimates) > 1:
        try:
            estimate = _estimate_pool(
                estimates, members, estimate_between_window_variance(history), settings, refit=refit
            )
        except GAVE_UP as error:
            return None, Verdict(False, None, (build_solver_reason(error, "inspect the windows"),))
        # with a slow voltage, or without one, R and L may be undetermined
        slow = any(window.slow_voltage is not None or window.voltage_v is None for window, _ in estimates)
        reasons += list_missing_reasons(estimate, slow=slow)
    beyond = find_unphysical_values(estimate)
    return (estimate if beyond else bound_estimate(estimate)), _build_verdict(
        accepted, [*reasons, *beyond, *find_parameter_jumps(estimates)]
    )


def _estimate_pool(
    estimates: WindowEstimates,
    members: Sequence[PoolMember],
    apart: BetweenWindowVariance,
    settings: Identification,
    *,
    refit: bool,
) -> Estimate:
    """Return the estimate of all samples if the windows are of one kind, else the mixed model's."""
    first = estimates[0][1]
    quick = pool_estimates(members, first, apart)
    whole = all(set(PARAMETERS) <= set(m.names) for m in members)
    voltageless = all(window.voltage_v is None and window.slow_voltage is None for window, _ in estimates)
    if voltageless or quick.terms or apart.surely or (whole and not refit):
        return quick
    again = select_estimator(settings)[1]([window for window, _ in estimates], settings)
    same = pool_estimates(members, first, NO_BETWEEN_VARIANCE)
    if not again.names == same.names == quick.names:
        return again
    wider = np.nan_to_num(quick.covariance - same.covariance)  # zero where a slow voltage leaves R or L undetermined
    return replace(again, covariance=freeze_array(again.covariance + wider))


def check_both_directions(outcomes: Iterable[WindowOutcome]) -> list[Reason]:
    """Return the reason if windows of one direction are accepted while the model was refused in the other.

    A load that acts one way is part of dry friction then, by an unknown share.
    """
    listed = list(outcomes)
    directions = {o.window.direction for o in listed if o.verdict.accepted}
    refused = [o for o in listed if o.window.direction not in directions and is_model_refused(o)]
    if len(directions) != 1 or not refused:
        return []
    way = "positive" if refused[0].window.direction > 0 else "negative"
    cause = refused[0].verdict.reasons[0]
    text = (
        f"no move in the {way} direction is accepted ({cause.code}), "
        "and friction in one direction does not show that in the other"
    )
    return [Reason("OneDirection", text, cause.advice or "see why the other moves are refused")]


def _check_loop_refutations(outcomes: Sequence[WindowOutcome]) -> list[Reason]:
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


def is_model_refused(outcome: WindowOutcome) -> bool:
    """Return whether a window was refused for its drive's behaviour, not for its samples or an aborted move."""
    codes = [reason.code for reason in outcome.verdict.reasons]
    return not outcome.verdict.accepted and not any(part in code for code in codes for part in OF_THE_MOVE)


def _build_verdict(accepted: Sequence[WindowOutcome], reasons: Sequence[Reason]) -> Verdict:
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


class HeldOutPool(NamedTuple):
    """The ``outcomes`` as held-out moves show them, their pool, and its residual of moves it was not identified on.

    ``loops`` are the drive's own where the configured ones do not explain its moves.
    """

    outcomes: Sequence[WindowOutcome]
    estimate: Estimate | None
    verdict: Verdict
    held_out: HeldOut | None
    loops: LoopEstimate | None


def pool_with_held_out(
    outcomes: Sequence[WindowOutcome],
    settings: Identification,
    axis: Axis | None = None,
    loops: LoopEstimate | None = None,
    sync_period_s: float | None = None,
) -> HeldOutPool:
    """Pool the accepted windows, and validate each by the pool of the others.

    That needs the loops of the drive: ``axis`` with the ``loops`` that were identified, if they explain more. A window
    that was refused because its own model does not explain its replay is accepted if the model of the others predicts
    it to the tolerance; its reasons become warnings. If not, the loops are identified again with the pool's mechanics:
    moves in both directions separate a load from friction. A pool that does not predict each of its moves is not
    validated; one that does is not refused because the winding's R or L changes between them.
    """
    estimate, verdict = pool_windows(outcomes, settings)
    mine = select_matching_axis(outcomes[0].window, axis) if outcomes else None
    if mine is None and verdict.accepted:
        verdict = replace(verdict, warnings=(*verdict.warnings, SCALE_UNPROVEN))
    if mine is None or sync_period_s is None:
        return HeldOutPool(outcomes, estimate, verdict, None, loops)
    best = adopt_loops(mine, loops) or mine
    trial = [_accept_outcome(o) if _is_refused_by_replay(o) else o for o in outcomes]
    if any(map(_is_refused_by_replay, outcomes)) and (all_moves := pool_windows(trial, settings)[0]) is not None:
        predicted = _predict_each_move(trial, all_moves, best, sync_period_s)[1]
        if not all(is_predicted(p, settings) for o, p in zip(trial, predicted, strict=True) if o.verdict.accepted):
            windows = [_align_demand(o, mine, sync_period_s) for o in trial if o.verdict.accepted]
            plants = [all_moves.build_parameters()] * len(windows)
            found = identify_loops(windows, plants, mine, settings, sync_period_s)
            if (better := adopt_loops(mine, found)) is not None:
                best, loops = better, found
                predicted = _predict_each_move(trial, all_moves, best, sync_period_s)[1]
        kept = [t if is_predicted(p, settings) else o for o, t, p in zip(outcomes, trial, predicted, strict=True)]
        outcomes = kept
        estimate, verdict = pool_windows(outcomes, settings)
    estimate, predicted = _predict_each_move(outcomes, estimate, best, sync_period_s)
    held = summarise_worst(predicted)
    reason = None if held is None else check_held_out_limit(held, settings)
    if reason is not None and verdict.accepted:
        verdict = replace(verdict, accepted=False, reasons=(reason,))
    elif held is not None and reason is None and all(map(is_winding_jump, verdict.reasons)):
        if verdict.reasons and estimate is not None:
            estimate = _add_winding_spread(estimate, outcomes)
        verdict = replace(verdict, accepted=True, reasons=(), warnings=(*verdict.warnings, *verdict.reasons))
    return HeldOutPool(outcomes, estimate, verdict, held, loops)


def _add_winding_spread(estimate: Estimate, outcomes: Sequence[WindowOutcome]) -> Estimate:
    covariance = estimate.covariance.copy()
    for name in WINDING_PARAMETERS:
        values = [o.estimate.get_value(name) for o in outcomes if o.verdict.accepted and o.estimate is not None]
        k = estimate.names.index(name)
        covariance[k, k] += float(np.nanvar(values))
    return replace(estimate, covariance=freeze_array(covariance))


def _predict_each_move(
    outcomes: Sequence[WindowOutcome], estimate: Estimate | None, axis: Axis, sync_period_s: float
) -> tuple[Estimate | None, list[Replay | None]]:
    """Return the pool with its presliding, and each accepted outcome's replay by the pool of the others."""
    moves: list[Move] = [
        (_align_demand(o, axis, sync_period_s), o.estimate)
        for o in outcomes
        if o.verdict.accepted and o.estimate is not None
    ]
    if estimate is None or not moves:
        return estimate, [None] * len(outcomes)
    estimate = fit_presliding(estimate, [window for window, _ in moves], axis, sync_period_s)
    replays = iter(predict_held_out(moves, estimate, axis, sync_period_s))
    return estimate, [next(replays) if o.verdict.accepted and o.estimate is not None else None for o in outcomes]


def _align_demand(outcome: WindowOutcome, axis: Axis, sync_period_s: float) -> Window:
    """Return the window with the demand that the drive follows, where the recorded one is ahead of it."""
    if all(warning.code != "SampleTiming" for warning in outcome.verdict.warnings):
        return outcome.window
    return align_demand_to_drive(outcome.window, axis, sync_period_s)[0]


def _is_refused_by_replay(outcome: WindowOutcome) -> bool:
    """Return whether a window was refused for its own model's replay alone: others may separate load and friction."""
    codes = {reason.code for reason in outcome.verdict.reasons}
    return outcome.estimate is not None and LOOPS_DIFFER in codes and codes <= OF_ONE_MOVE


def _accept_outcome(outcome: WindowOutcome) -> WindowOutcome:
    verdict = outcome.verdict
    warnings = (*verdict.warnings, *verdict.reasons)
    return replace(outcome, verdict=replace(verdict, accepted=True, reasons=(), warnings=warnings))
