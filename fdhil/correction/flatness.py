"""Plans an on-line feed-forward: the drive is flat, speed and torque follow from its position ([ROT 99], [DES]).

With w = r' 2 pi / pitch, equation [2] gives the torque Jt w' + ft w + Cd sign(w) that follows the path, and the model's
terms; sent as torque offset (0x60B2), it leaves only the model's error to the speed loop. The speed offset (0x60B1) is
the part of the speed that the drive's own feed-forward lacks, or feeds forward half a cycle too early. The position
offset (0x60B0) stays 0. Each row needs two rows of look-ahead.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fdhil.config import Axis, MachineConfig
from fdhil.correction.method import Plan
from fdhil.prediction.model_terms import resisting
from fdhil.records import Float, Parameters, Prediction, Trajectory

STILL_RAD_S = 1e-6
PER_MILLE = 1e-3  # 0x60B2 counts in 0.1 % of the rated torque


def plan(reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, _before: Prediction) -> Plan:
    """Return speed and torque offsets (n,) of every axis, in whole counts of the drive's objects."""
    speed, torque = {}, {}
    for axis in reference.axes:
        path = np.asarray(reference.position_mm[axis])
        speed[axis], torque[axis] = offsets(path, models[axis], config.axis[axis], reference.dt_s)
    zero = np.zeros(reference.time_s.size)
    return Plan(dict.fromkeys(reference.axes, zero), speed_offset_rad_s=speed, torque_offset_nm=torque)


def offsets(reference_mm: Float, parameters: Parameters, axis: Axis, dt_s: float) -> tuple[Float, Float]:
    """Return the speed offset (rad/s) and torque offset (N.m), (n,) each, of one axis.

    The torque offset is in the drive's own torque: the drive converts N.m to current with the nominal torque constant.
    """
    p = parameters
    lead = lead_s(parameters, axis)
    demanded = np.gradient(reference_mm, dt_s) * 2 * np.pi / axis.screw_pitch_mm
    acceleration = np.gradient(demanded, dt_s)
    turning = np.where(np.abs(demanded) > STILL_RAD_S, demanded, 0.0)
    smooth, dry = resisting(p, turning, reference_mm * 2 * np.pi / axis.screw_pitch_mm)
    # a load acts at rest too: there the speed loop's integral holds it
    current = (p.Jt * acceleration + smooth + dry - p.term("load")) / p.K
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


def lead_s(parameters: Parameters, axis: Axis) -> float:
    """Return the lead of the current command: the current loop's lag and half a hold."""
    return parameters.L / axis.regulators.current_kp + 0.5 * axis.regulators.speed_period_s
