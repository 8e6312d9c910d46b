"""Pools the windows of one recording, and validates them by moves that the model was not identified on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification.demand_lead import with_demand_on_time
from fdhil.identification.loops import identify_loops
from fdhil.pipeline.analysis import own
from fdhil.pipeline.own_loops import better_axis
from fdhil.pipeline.pooling import pool
from fdhil.records import Estimate, HeldOut, LoopEstimate, Reason, Verdict, Window, WindowOutcome, frozen
from fdhil.validation.agreement import WINDING, is_of_winding
from fdhil.validation.held_out import Move, held_out_reason, is_predicted, predict_held_out, worst_of
from fdhil.validation.presliding import with_presliding
from fdhil.validation.replay import Replay
from fdhil.validation.weight import LOOPS_DIFFER

OF_ONE_MOVE = frozenset({LOOPS_DIFFER, "ValidationFailed"})
"""Codes of a window whose own model does not explain its replay: moves one way do not separate load and friction."""


SCALE_UNPROVEN = Reason(
    "ScaleUnproven",
    "no data sheet is known: current and voltage in another scale (peak or RMS of a phase) scale K, Jt, ft and Cd",
    "give --config with the motor's nominal K and Jt",
)


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
    estimate, verdict = pool(outcomes, settings)
    mine = own(outcomes[0].window, axis) if outcomes else None
    if mine is None and verdict.accepted:
        verdict = replace(verdict, warnings=(*verdict.warnings, SCALE_UNPROVEN))
    if mine is None or sync_period_s is None:
        return HeldOutPool(outcomes, estimate, verdict, None, loops)
    best = better_axis(mine, loops) or mine
    trial = [_accepted(o) if _is_doubtful(o) else o for o in outcomes]
    if any(map(_is_doubtful, outcomes)) and (all_moves := pool(trial, settings)[0]) is not None:
        predicted = _judged(trial, all_moves, best, sync_period_s)[1]
        if not all(is_predicted(p, settings) for o, p in zip(trial, predicted, strict=True) if o.verdict.accepted):
            windows = [_on_time(o, mine, sync_period_s) for o in trial if o.verdict.accepted]
            plants = [all_moves.parameters()] * len(windows)
            found = identify_loops(windows, plants, mine, settings, sync_period_s)
            if (better := better_axis(mine, found)) is not None:
                best, loops = better, found
                predicted = _judged(trial, all_moves, best, sync_period_s)[1]
        kept = [t if is_predicted(p, settings) else o for o, t, p in zip(outcomes, trial, predicted, strict=True)]
        outcomes = kept
        estimate, verdict = pool(outcomes, settings)
    estimate, predicted = _judged(outcomes, estimate, best, sync_period_s)
    held = worst_of(predicted)
    reason = None if held is None else held_out_reason(held, settings)
    if reason is not None and verdict.accepted:
        verdict = replace(verdict, accepted=False, reasons=(reason,))
    elif held is not None and reason is None and all(map(is_of_winding, verdict.reasons)):
        if verdict.reasons and estimate is not None:
            estimate = _with_spread(estimate, outcomes)
        verdict = replace(verdict, accepted=True, reasons=(), warnings=(*verdict.warnings, *verdict.reasons))
    return HeldOutPool(outcomes, estimate, verdict, held, loops)


def _with_spread(estimate: Estimate, outcomes: Sequence[WindowOutcome]) -> Estimate:
    covariance = estimate.covariance.copy()
    for name in WINDING:
        values = [o.estimate.value(name) for o in outcomes if o.verdict.accepted and o.estimate is not None]
        k = estimate.names.index(name)
        covariance[k, k] += float(np.nanvar(values))
    return replace(estimate, covariance=frozen(covariance))


def _judged(
    outcomes: Sequence[WindowOutcome], estimate: Estimate | None, axis: Axis, sync_period_s: float
) -> tuple[Estimate | None, list[Replay | None]]:
    """Return the pool with its presliding, and each accepted outcome's replay by the pool of the others."""
    moves: list[Move] = [
        (_on_time(o, axis, sync_period_s), o.estimate)
        for o in outcomes
        if o.verdict.accepted and o.estimate is not None
    ]
    if estimate is None or not moves:
        return estimate, [None] * len(outcomes)
    estimate = with_presliding(estimate, [window for window, _ in moves], axis, sync_period_s)
    replays = iter(predict_held_out(moves, estimate, axis, sync_period_s))
    return estimate, [next(replays) if o.verdict.accepted and o.estimate is not None else None for o in outcomes]


def _on_time(outcome: WindowOutcome, axis: Axis, sync_period_s: float) -> Window:
    """Return the window with the demand that the drive follows, where the recorded one is ahead of it."""
    if all(warning.code != "SampleTiming" for warning in outcome.verdict.warnings):
        return outcome.window
    return with_demand_on_time(outcome.window, axis, sync_period_s)[0]


def _is_doubtful(outcome: WindowOutcome) -> bool:
    """Return whether a window was refused for its own model's replay alone: others may separate load and friction."""
    codes = {reason.code for reason in outcome.verdict.reasons}
    return outcome.estimate is not None and LOOPS_DIFFER in codes and codes <= OF_ONE_MOVE


def _accepted(outcome: WindowOutcome) -> WindowOutcome:
    verdict = outcome.verdict
    warnings = (*verdict.warnings, *verdict.reasons)
    return replace(outcome, verdict=replace(verdict, accepted=True, reasons=(), warnings=warnings))
