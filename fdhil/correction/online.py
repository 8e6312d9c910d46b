"""Derives the on-line feed-forward's law: speed and torque offsets as weights of the last targets sent by an NC.

The drive is flat ([DES], conclusion): speed and torque follow from its position. On line only the past is known, so
speed and acceleration are those of a polynomial through the last targets, by least squares, extrapolated by one cycle
and the current loop's lag. That makes each offset a weighted sum of targets: integers, cheap enough for every SYNC.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdhil.config import Axis
from fdhil.correction.flatness import PER_MILLE, lead_s
from fdhil.prediction.model_terms import mean_friction
from fdhil.records import Float, Parameters

ONE = 1 << 24  # the weights' scale
AHEAD_CYCLES = 1.0  # from the newest known target to the one that the offset is sent with
SPEED_ROWS, SPEED_ORDER = 8, 2
ACCELERATION_ROWS, ACCELERATION_ORDER = 20, 4
DRY_INCREMENTS = 0.5  # per cycle: full dry friction from this speed on; below, rounding determines the direction
FEEDFORWARD_EARLY_CYCLES = 0.5  # by which the drive's own speed feed-forward leads the speed at its row


def derivative_weights(rows: int, order: int, ahead: float, which: int) -> Float:
    """Return (rows,) weights, newest first: the ``which``-th derivative, per cycle, ``ahead`` cycles from the newest.

    A polynomial of ``order`` is fitted to the rows by least squares.
    """
    powers = np.vander(-np.arange(float(rows)), order + 1, increasing=True)
    at = [math.perm(k, which) * ahead ** (k - which) if k >= which else 0.0 for k in range(order + 1)]
    return np.asarray(np.array(at) @ np.linalg.pinv(powers))


def law(parameters: Parameters, axis: Axis, sync_period_s: float) -> Mapping[str, Any]:
    """Return the law of one axis in the guard's form: ``speed``, ``torque``, ``pace`` weights and ``dry``.

    In the drive's counts: increments/s, 0.1 % of the rated torque. The drive's own feed-forward is left to it. Friction
    is the mean of both directions; a load is held by the drive's own integral.
    """
    p, g, period = mean_friction(parameters), axis.regulators, sync_period_s
    later = AHEAD_CYCLES + lead_s(p, axis) / period
    speed_now = derivative_weights(SPEED_ROWS, SPEED_ORDER, AHEAD_CYCLES, 1) / period
    speed_later = derivative_weights(SPEED_ROWS, SPEED_ORDER, later, 1) / period
    bend_now, bend_later = (
        derivative_weights(ACCELERATION_ROWS, ACCELERATION_ORDER, ahead, 2) / period**2
        for ahead in (AHEAD_CYCLES, later)
    )
    early = FEEDFORWARD_EARLY_CYCLES * period * g.speed_feedforward
    rad = 2 * math.pi / axis.drive.increments_per_rev
    count_a = PER_MILLE * axis.drive.rated_current_a
    inertia = p.Jt / p.K - g.torque_feedforward * axis.nominal.Jt / axis.nominal.K
    return {
        "speed": _whole(_added((1 - g.speed_feedforward) * speed_now, -early * bend_now)),
        "torque": _whole(_added(inertia * rad / count_a * bend_later, p.ft / p.K * rad / count_a * speed_later)),
        "pace": _whole(speed_later * period / DRY_INCREMENTS),
        "dry": round(p.Cd / p.K / count_a),
    }


def _added(one: Float, other: Float) -> Float:
    total = np.zeros(max(one.size, other.size))
    total[: one.size] += one
    total[: other.size] += other
    return total


def _whole(weights: Float) -> list[int]:
    """Omit the newest row's weight: distances are counted from it, and the sum of all weights is 0."""
    scaled: Sequence[float] = (weights[1:] * ONE).tolist()
    return [round(weight) for weight in scaled]
