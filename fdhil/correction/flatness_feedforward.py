"""Plans an on-line feed-forward: the drive is flat, speed and torque follow from its position ([ROT 99], [DES]).

With w = r' 2 pi / pitch, equation [2] gives the torque Jt w' + ft w + Cd sign(w) that follows the path, and the model's
terms; sent as torque offset (0x60B2), it leaves only the model's error to the speed loop. The speed offset (0x60B1) is
the part of the speed that the drive's own feed-forward lacks, or feeds forward half a cycle too early. The position
offset (0x60B0) stays 0. A planned path needs two rows of look-ahead.

On line only the past is known: there speed and acceleration are those of a polynomial through the last targets that the
NC has sent, by least squares, extrapolated by one cycle and the current loop's lag. That makes each offset a weighted
sum of targets: integers, cheap enough for every SYNC.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdhil.config import Axis, MachineConfig
from fdhil.correction.correction_method import MethodPlan
from fdhil.prediction import average_friction, split_resisting_torque
from fdhil.records import Float, Parameters, Prediction, Trajectory

STILL_RAD_S = 1e-6
PER_MILLE = 1e-3  # 0x60B2 counts in 0.1 % of the rated torque
ONE = 1 << 24  # the weights' scale
AHEAD_CYCLES = 1.0  # from the newest known target to the one that the offset is sent with
SPEED_ROWS, SPEED_ORDER = 8, 2
ACCELERATION_ROWS, ACCELERATION_ORDER = 20, 4
DRY_INCREMENTS = 0.5  # per cycle: full dry friction from this speed on; below, rounding determines the direction
FEEDFORWARD_EARLY_CYCLES = 0.5  # by which the drive's own speed feed-forward leads the speed at its row


def plan_feedforward(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, _before: Prediction
) -> MethodPlan:
    """Return speed and torque offsets (n,) of every axis, in whole counts of the drive's objects."""
    speed, torque = {}, {}
    for axis in reference.axes:
        path = np.asarray(reference.position_mm[axis])
        speed[axis], torque[axis] = compute_feedforward_offsets(path, models[axis], config.axis[axis], reference.dt_s)
    zero = np.zeros(reference.time_s.size)
    return MethodPlan(dict.fromkeys(reference.axes, zero), speed_offset_rad_s=speed, torque_offset_nm=torque)


def compute_feedforward_offsets(
    reference_mm: Float, parameters: Parameters, axis: Axis, dt_s: float
) -> tuple[Float, Float]:
    """Return the speed offset (rad/s) and torque offset (N.m), (n,) each, of one axis.

    The torque offset is in the drive's own torque: the drive converts N.m to current with the nominal torque constant.
    """
    p = parameters
    lead = compute_current_lead_s(parameters, axis)
    demanded = np.gradient(reference_mm, dt_s) * 2 * np.pi / axis.screw_pitch_mm
    acceleration = np.gradient(demanded, dt_s)
    turning = np.where(np.abs(demanded) > STILL_RAD_S, demanded, 0.0)
    smooth, dry = split_resisting_torque(p, turning, reference_mm * 2 * np.pi / axis.screw_pitch_mm)
    # a load acts at rest too: there the speed loop's integral holds it
    current = (p.Jt * acceleration + smooth + dry - p.get_term("load")) / p.K
    times = np.arange(reference_mm.size) * dt_s
    early = np.interp(times + lead, times, current)
    # the drive's own feed-forward is the acceleration of the next row, held: half a cycle ahead as well
    own = axis.regulators.torque_feedforward * axis.nominal.Jt / axis.nominal.K
    early -= own * np.interp(times + 0.5 * dt_s, times, acceleration)
    # the drive feeds forward the slope of the cycle that begins: half a cycle ahead of the speed at its row
    ahead = np.diff(reference_mm, append=reference_mm[-1]) / dt_s * 2 * np.pi / axis.screw_pitch_mm
    speed = demanded - axis.regulators.speed_feedforward * ahead
    count = 2 * np.pi / axis.drive.increments_per_rev
    torque_count = PER_MILLE * axis.nominal.K * axis.drive.rated_current_a
    return (
        np.asarray(np.rint(speed / count) * count),
        np.asarray(np.rint(early * axis.nominal.K / torque_count) * torque_count),
    )


def compute_current_lead_s(parameters: Parameters, axis: Axis) -> float:
    """Return the lead of the current command: the current loop's lag and half a hold."""
    return parameters.L / axis.regulators.current_kp + 0.5 * axis.regulators.speed_period_s


def compute_derivative_weights(rows: int, order: int, ahead: float, which: int) -> Float:
    """Return (rows,) weights, newest first: the ``which``-th derivative, per cycle, ``ahead`` cycles from the newest.

    A polynomial of ``order`` is fitted to the rows by least squares.
    """
    powers = np.vander(-np.arange(float(rows)), order + 1, increasing=True)
    at = [math.perm(k, which) * ahead ** (k - which) if k >= which else 0.0 for k in range(order + 1)]
    return np.asarray(np.array(at) @ np.linalg.pinv(powers))


def derive_feedforward_law(parameters: Parameters, axis: Axis, sync_period_s: float) -> Mapping[str, Any]:
    """Return the law of one axis in the guard's form: ``speed``, ``torque``, ``pace`` weights and ``dry``.

    In the drive's counts: increments/s, 0.1 % of the rated torque. The drive's own feed-forward is left to it. Friction
    is the mean of both directions; a load is held by the drive's own integral.
    """
    p, g, period = average_friction(parameters), axis.regulators, sync_period_s
    later = AHEAD_CYCLES + compute_current_lead_s(p, axis) / period
    speed_now = compute_derivative_weights(SPEED_ROWS, SPEED_ORDER, AHEAD_CYCLES, 1) / period
    speed_later = compute_derivative_weights(SPEED_ROWS, SPEED_ORDER, later, 1) / period
    bend_now, bend_later = (
        compute_derivative_weights(ACCELERATION_ROWS, ACCELERATION_ORDER, ahead, 2) / period**2
        for ahead in (AHEAD_CYCLES, later)
    )
    early = FEEDFORWARD_EARLY_CYCLES * period * g.speed_feedforward
    rad = 2 * math.pi / axis.drive.increments_per_rev
    count_a = PER_MILLE * axis.drive.rated_current_a
    inertia = p.Jt / p.K - g.torque_feedforward * axis.nominal.Jt / axis.nominal.K
    return {
        "speed": _quantise_weights(_add_weights((1 - g.speed_feedforward) * speed_now, -early * bend_now)),
        "torque": _quantise_weights(
            _add_weights(inertia * rad / count_a * bend_later, p.ft / p.K * rad / count_a * speed_later)
        ),
        "pace": _quantise_weights(speed_later * period / DRY_INCREMENTS),
        "dry": round(p.Cd / p.K / count_a),
    }


def _add_weights(one: Float, other: Float) -> Float:
    total = np.zeros(max(one.size, other.size))
    total[: one.size] += one
    total[: other.size] += other
    return total


def _quantise_weights(weights: Float) -> list[int]:
    """Omit the newest row's weight: distances are counted from it, and the sum of all weights is 0."""
    scaled: Sequence[float] = (weights[1:] * ONE).tolist()
    return [round(weight) for weight in scaled]
