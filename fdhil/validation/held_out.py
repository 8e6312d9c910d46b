"""Validates a pooled model by moves that it was not identified on: the residual of their following error.

Each move is predicted by the pool of the others, so that no model is validated by its own data. A correction by the
model leaves that residual, too: the same drive, predicted through the same loops.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification.between import between
from fdhil.identification.physical_bounds import bounded
from fdhil.identification.pooling import member, pooled
from fdhil.records import Estimate, HeldOut, Parameters, Reason, Window
from fdhil.validation.presliding import TERM
from fdhil.validation.replay import Replay, replay_setpoints

Move = tuple[Window, Estimate]


def predict_held_out(moves: Sequence[Move], model: Estimate, axis: Axis, sync_period_s: float) -> list[Replay | None]:
    """Return each move replayed by the pool of the others; None where its samples cannot be compared.

    ``model`` is the pool of all: its presliding is used, and it predicts where the pool of the others is not a valid
    drive. A single move is predicted by ``model`` itself.
    """
    members = [member(window, estimate, k) for k, (window, estimate) in enumerate(moves)]
    build_up = {TERM: model.value(TERM)} if TERM in model.names else {}
    found = []
    for k, (window, _) in enumerate(moves):
        rest = [m for m in members if m.place != k]
        without = bounded(pooled(rest, model, between(rest))).parameters().changed(**build_up) if rest else None
        usable = without if without is not None and _is_drive(without) else model.parameters()
        found.append(replay_setpoints(window, usable, axis, sync_period_s))
    return found


def _is_drive(p: Parameters) -> bool:
    return bool(np.isfinite([p.K, p.Jt, p.ft, p.Cd]).all() and min(p.K, p.Jt) > 0.0)


def worst_of(predicted: Sequence[Replay | None]) -> HeldOut | None:
    """Return the residual of the worst move; None where none could be compared."""
    compared = [one for one in predicted if one is not None]
    if not compared:
        return None
    worst = max(compared, key=lambda one: one.unexplained_um)
    most_um = max(float(np.abs(one.difference_um).max()) for one in compared)
    return HeldOut(len(compared), worst.unexplained_um, most_um, worst.measured_um)


def is_predicted(found: Replay | None, settings: Identification) -> bool:
    """Return whether a model predicts a move that it was not identified on to the tolerance."""
    return found is not None and found.unexplained_um <= settings.tolerance_for(found.measured_um)


def held_out_reason(found: HeldOut, settings: Identification) -> Reason | None:
    """Return why a model is not validated if it does not predict the moves that it was not identified on."""
    limit_um = settings.tolerance_for(found.following_um)
    if found.rms_um <= limit_um:
        return None
    text = (
        f"identified on the other moves, the model leaves {found.rms_um:.3g} um RMS of a following error of "
        f"{found.following_um:.3g} um, limit {limit_um:.3g} um: it does not predict moves that it was not identified on"
    )
    return Reason("ValidationFailed", text, "record more rapids in both directions, at several speeds and lengths")
