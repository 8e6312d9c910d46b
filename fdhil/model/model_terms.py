"""Packs the optional terms of [DES] [1] and [2], see :class:`fdhil.records.Parameters`, for the kernels."""

from __future__ import annotations

import math
import re
from functools import lru_cache

import numpy as np

from fdhil.config import Axis
from fdhil.model import closed_loop_kernels
from fdhil.records import Float, Parameters, make_read_only_view

_RIPPLE = re.compile(r"ripple_(?:screw|motor)_(\d+)")
_SENSORS = ("speed_delay",)  # terms of the reported signals, without effect on the motion
TABLE_SHARE = 0.5  # default share of the inertia on the table side of the spring


def compute_friction_torque(parameters: Parameters, speed_rad_s: Float, angle_rad: Float) -> Float:
    """Return the torque (n,) in N.m against the positive direction of a motor at speeds and angles (n,).

    It is load + side (C + stribeck exp(-(w / stribeck_speed)^2)) + f w + ripples, with side = sign(w), 0 at rest; the
    angle is 2 pi x / pitch.
    """
    speed, angle = (np.ascontiguousarray(values, dtype=np.float64) for values in (speed_rad_s, angle_rad))
    return closed_loop_kernels.compute_friction_torque(
        make_read_only_view(speed), make_read_only_view(angle), pack_terms(parameters)
    )


def rad_per_mm(axis: Axis) -> float:
    """Return the motor angle per mm of table travel."""
    return 2 * math.pi / axis.screw_pitch_mm


def compute_full_dead_time_a(axis: Axis) -> float:
    """Return the current above which the inverter's dead time takes its full voltage.

    It is half of the current ripple caused by switching once per cycle: below it both transistors conduct in turn, and
    the losses cancel.
    """
    g = axis.regulators
    return g.voltage_limit_v * g.current_period_s / (4 * axis.nominal.L)


def compute_dead_time_v(parameters: Parameters, axis: Axis, current_a: float) -> float:
    """Return the voltage lost to the dead time."""
    share = max(-1.0, min(1.0, current_a / compute_full_dead_time_a(axis)))
    return parameters.get_term("dead_time") * share


def has_kernel_terms(parameters: Parameters) -> bool:
    """Whether a drive needs the kernel's steps with terms; the plain ones are faster."""
    return any(name not in _SENSORS for name, _ in parameters.terms)


def has_spring(parameters: Parameters) -> bool:
    """Whether motor and table are separate masses."""
    return parameters.get_term("resonance") > 0.0


def has_presliding(parameters: Parameters) -> bool:
    """Whether dry friction builds up over a displacement (presliding)."""
    return parameters.get_term("presliding_um") > 0.0


@lru_cache(maxsize=256)
def pack_terms(parameters: Parameters) -> Float:
    """Return (13 + 3 ripples,) the terms in the kernels' order."""
    p, values = parameters, np.zeros(closed_loop_kernels.RIPPLES)
    values[closed_loop_kernels.LOAD] = p.get_term("load")
    values[closed_loop_kernels.DRY_POSITIVE] = p.get_term("coulomb_positive", p.Cd)
    values[closed_loop_kernels.DRY_NEGATIVE] = p.get_term("coulomb_negative", p.Cd)
    values[closed_loop_kernels.VISCOUS] = p.ft
    values[closed_loop_kernels.VISCOUS_POSITIVE] = p.get_term("viscous_positive", p.ft)
    values[closed_loop_kernels.VISCOUS_NEGATIVE] = p.get_term("viscous_negative", p.ft)
    values[closed_loop_kernels.STRIBECK] = p.get_term("stribeck")
    values[closed_loop_kernels.STRIBECK_SPEED] = p.get_term("stribeck_speed")
    values[closed_loop_kernels.DEAD_TIME] = p.get_term("dead_time")
    values[closed_loop_kernels.PRESLIDING] = p.get_term("presliding_um")
    values[closed_loop_kernels.SPRING], values[closed_loop_kernels.DAMPER] = compute_spring(p)
    ripples = [
        (float(found[1]), amplitude, p.get_term(f"{name}_phase"))
        for name, amplitude in p.terms
        if (found := _RIPPLE.fullmatch(name))
    ]
    return make_read_only_view(np.concatenate([values, *ripples]))


def add_resonance(parameters: Parameters, axis: Axis) -> Parameters:
    """Return the model with the resonance of the axis' section, unless it has its own."""
    if axis.resonance_hz is None or "resonance" in dict(parameters.terms):
        return parameters
    return parameters.replace_values(resonance=axis.resonance_hz, resonance_damping=axis.resonance_damping)


def compute_spring(parameters: Parameters) -> tuple[float, float]:
    """Return stiffness in N.m/rad and damping in N.m.s between motor and table; 0 where they are one mass.

    ``resonance`` is that of both masses against each other with the motor free: the peak from motor torque to motor
    speed. With the motor held, the table resonates at sqrt(1 - share) of it; ``resonance_share`` of Jt is the table's.
    """
    share, whole = parameters.get_term("resonance_share", TABLE_SHARE), 2 * math.pi * parameters.get_term("resonance")
    reduced = parameters.Jt * share * (1.0 - share)
    return whole**2 * reduced, 2 * parameters.get_term("resonance_damping") * whole * reduced


@lru_cache(maxsize=64)
def compute_two_mass_step(parameters: Parameters, pitch_mm: float, step_s: float) -> Float:
    """Return (2, 5, 8) the exact step of motor and table, free and with the table held.

    Rows: current, speed and position of the motor, speed and position of the table. Columns: the same, then voltage,
    torque on the motor, torque on the table. Positions are in mm. All viscous friction acts on the motor.
    """
    p = parameters
    share = p.get_term("resonance_share", TABLE_SHARE)
    mm_per_rad, (k, d) = pitch_mm / (2 * math.pi), compute_spring(p)
    motor, table = p.Jt * (1 - share), p.Jt * share
    a = np.zeros((8, 8))
    a[0, [0, 1, 5]] = -p.R / p.L, -p.K / p.L, 1 / p.L
    a[1, [0, 1, 2, 3, 4, 6]] = p.K, -p.ft - d, -k / mm_per_rad, d, k / mm_per_rad, 1.0
    a[1] /= motor
    a[2, 1] = a[4, 3] = mm_per_rad
    a[3, [1, 2, 3, 4, 7]] = np.array([d, k / mm_per_rad, -d, -k / mm_per_rad, 1.0]) / table
    held = a.copy()
    held[3] = held[4] = 0.0
    return make_read_only_view(np.array([compute_matrix_exponential(one * step_s)[:5] for one in (a, held)]))


def compute_matrix_exponential(a: Float) -> Float:
    """Return exp(a) of a small matrix by its Taylor series, scaled so that it converges to the last bit."""
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(a).sum(axis=1).max()), 1e-12) / 0.5)))
    scaled = a / 2.0**halvings
    result = term = np.eye(len(a))
    for order in range(1, 19):
        term = term @ scaled / order
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result
