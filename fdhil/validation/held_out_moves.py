"""Validates a pooled model by moves that it was not identified on, and fits its presliding to recorded moves.

Each move is predicted by the pool of the others, so that no model is validated by its own data. A correction by the
model leaves that residual, too: the same drive, predicted through the same loops. Presliding is the distance over which
dry friction builds up: the following error shows it around each start, stop and reversal, since friction that acts at
once holds the table until it breaks loose, while friction that builds up lets it creep.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification import bound_estimate, build_pool_member, estimate_between_window_variance, pool_estimates
from fdhil.records import Estimate, Float, HeldOut, Parameters, Reason, Window, freeze_array
from fdhil.validation.move_replay import Replay, replay_setpoints

TERM = "presliding_um"
TRIALS_UM = (1.0, 2.5, 6.0, 15.0, 40.0)
MOST_WINDOWS = 4  # the newest: each has a start and a stop
LEAST_SHARE = 0.1  # of the residual's square that the term must explain
LEAST_UM = 0.05  # RMS that it must explain
INDEPENDENT_S = 0.025  # over which the residual of a position loop is correlated
STEP = 0.35  # of the logarithm, for the curvature
Move = tuple[Window, Estimate]


def fit_presliding(estimate: Estimate, windows: Sequence[Window], axis: Axis, sync_period_s: float) -> Estimate:
    """Return the estimate with ``presliding_um`` if the recorded moves show it, else unchanged.

    The standard deviation is that of the replays' least squares, of samples ``INDEPENDENT_S`` apart.
    """
    chosen = list(windows)[-MOST_WINDOWS:]

    def compute_residual_um2(um: float) -> float:
        """Return the mean square of the replays' residuals, um2; infinite where none can be run."""
        parameters = estimate.build_parameters()
        parameters = parameters.replace_values(**{TERM: um}) if um > 0.0 else parameters
        found = [replay_setpoints(window, parameters, axis, sync_period_s) for window in chosen]
        known = [each.unexplained_um**2 for each in found if each is not None]
        return float(np.mean(known)) if known else math.inf

    sharp = compute_residual_um2(0.0)
    trials = [compute_residual_um2(um) for um in TRIALS_UM] if math.isfinite(sharp) else []
    if not trials or not min(trials) < sharp:
        return estimate
    near = math.log(TRIALS_UM[int(np.argmin(trials))])
    from scipy.optimize import minimize_scalar  # slow to import

    reach = (near - 1.0, near + 1.0)
    found = minimize_scalar(
        lambda log: compute_residual_um2(math.exp(log)), bounds=reach, method="bounded", options={"xatol": 0.05}
    )
    best = float(found.fun)
    if sharp - best < max(LEAST_SHARE * sharp, LEAST_UM**2):
        return estimate
    value = math.exp(float(found.x))
    around = compute_residual_um2(value * math.exp(STEP)) + compute_residual_um2(value * math.exp(-STEP)) - 2.0 * best
    seconds = sum(window.n * window.dt_s for window in chosen)
    variance = 2.0 * best * STEP**2 / (max(around, 1e-12) * max(1.0, seconds / INDEPENDENT_S))
    return _append_term(estimate, value, value * min(math.sqrt(variance), 1.0))


def _append_term(estimate: Estimate, value: float, std: float) -> Estimate:
    n = len(estimate.names)
    covariance: Float = np.zeros((n + 1, n + 1))
    covariance[:n, :n] = estimate.covariance
    covariance[n, n] = std**2
    values, shared = freeze_array(np.append(estimate.values, value)), estimate.systematic
    if shared is not None:
        shared = freeze_array(np.vstack([shared, np.zeros((1, shared.shape[1]))]))
    names = (*estimate.names, TERM)
    return replace(estimate, names=names, values=values, covariance=freeze_array(covariance), systematic=shared)


def predict_held_out(moves: Sequence[Move], model: Estimate, axis: Axis, sync_period_s: float) -> list[Replay | None]:
    """Return each move replayed by the pool of the others; None where its samples cannot be compared.

    ``model`` is the pool of all: its presliding is used, and it predicts where the pool of the others is not a valid
    drive. A single move is predicted by ``model`` itself.
    """
    members = [build_pool_member(window, estimate, k) for k, (window, estimate) in enumerate(moves)]
    build_up = {TERM: model.get_value(TERM)} if TERM in model.names else {}
    found = []
    for k, (window, _) in enumerate(moves):
        rest = [m for m in members if m.place != k]
        without = (
            bound_estimate(pool_estimates(rest, model, estimate_between_window_variance(rest)))
            .build_parameters()
            .replace_values(**build_up)
            if rest
            else None
        )
        usable = without if without is not None and _is_drive(without) else model.build_parameters()
        found.append(replay_setpoints(window, usable, axis, sync_period_s))
    return found


def _is_drive(p: Parameters) -> bool:
    return bool(np.isfinite([p.K, p.Jt, p.ft, p.Cd]).all() and min(p.K, p.Jt) > 0.0)


def summarise_worst(predicted: Sequence[Replay | None]) -> HeldOut | None:
    """Return the residual of the worst move; None where none could be compared."""
    compared = [one for one in predicted if one is not None]
    if not compared:
        return None
    worst = max(compared, key=lambda one: one.unexplained_um)
    most_um = max(float(np.abs(one.difference_um).max()) for one in compared)
    return HeldOut(len(compared), worst.unexplained_um, most_um, worst.measured_um)


def is_predicted(found: Replay | None, settings: Identification) -> bool:
    """Return whether a model predicts a move that it was not identified on to the tolerance."""
    return found is not None and found.unexplained_um <= settings.compute_tolerance_um(found.measured_um)


def check_held_out_limit(found: HeldOut, settings: Identification) -> Reason | None:
    """Return why a model is not validated if it does not predict the moves that it was not identified on."""
    limit_um = settings.compute_tolerance_um(found.following_um)
    if found.rms_um <= limit_um:
        return None
    text = (
        f"identified on the other moves, the model leaves {found.rms_um:.3g} um RMS of a following error of "
        f"{found.following_um:.3g} um, limit {limit_um:.3g} um: it does not predict moves that it was not identified on"
    )
    return Reason("ValidationFailed", text, "record more rapids in both directions, at several speeds and lengths")
