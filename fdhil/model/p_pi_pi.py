"""The default regulators: P on position with speed feed-forward, PI on speed, PI on current ([DES] figure 1).

Each PI integrates first: candidate = integral + ki h e, output = clip(kp e + candidate); where the clip acts, the old
integral is kept.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from fdhil.config import Axis
from fdhil.model import kernels
from fdhil.model.closed_loop import Commands, Response, State
from fdhil.records import Float, Parameters


@lru_cache(maxsize=64)
def plant_step(parameters: Parameters, pitch_mm: float, step_s: float) -> Float:
    """Return (16,) the exact step of [i, w, x] under constant voltage and friction torque, [DES] eqs. 1 and 2.

    Order: phi_ii, phi_iw, phi_wi, phi_ww, phi_xi, phi_xw, voltage on i, w, x, torque on i, w, x, then the still
    motor's decay and voltage gain, K and Cd. x is in mm.
    """
    p = parameters
    mm_per_rad = pitch_mm / (2 * math.pi)
    a = np.zeros((5, 5))
    a[0, :2] = -p.R / p.L, -p.K / p.L
    a[0, 3] = 1 / p.L
    a[1, :2] = p.K / p.Jt, -p.ft / p.Jt
    a[1, 4] = 1 / p.Jt
    a[2, 1] = mm_per_rad
    e = _exponential(a * step_s)
    still = math.exp(-p.R / p.L * step_s)
    still_u = -math.expm1(-p.R / p.L * step_s) / p.R
    moving = (e[0, 0], e[0, 1], e[1, 0], e[1, 1], e[2, 0], e[2, 1], *e[:3, 3], *e[:3, 4])
    step = np.array([*moving, still, still_u, p.K, p.Cd])
    step.setflags(write=False)
    return step


def _exponential(a: Float) -> Float:
    """Return exp(a) of a small matrix by Taylor's series, halved until it converges to the last bit."""
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(a).sum(axis=1).max()), 1e-12) / 0.5)))
    scaled = a / 2.0**halvings
    result = term = np.eye(len(a))
    for order in range(1, 19):
        term = term @ scaled / order
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result


def loop_gains(axis: Axis, sync_period_s: float) -> Float:
    """Return (10,) the gains as :func:`fdhil.model.kernels.p_pi_pi` takes them."""
    g = axis.regulators
    rad_per_mm = 2 * math.pi / axis.screw_pitch_mm
    return np.array(
        [
            g.position_gain_per_s * rad_per_mm,
            g.speed_feedforward * rad_per_mm,
            g.speed_kp,
            g.speed_ki * g.speed_period_s,
            g.current_limit_a,
            g.current_kp,
            g.current_ki * g.current_period_s,
            g.voltage_limit_v,
            sync_period_s,
            0.5 * g.current_period_s / rad_per_mm,
        ]
    )


def simulate(
    parameters: Parameters, axis: Axis, sync_period_s: float, commands: Commands, state: State, first: int, rows: int
) -> Response:
    """Run ``rows`` SYNC cycles from row ``first`` on; the contract of every regulator structure."""
    g = axis.regulators
    n_speed = round(sync_period_s / g.speed_period_s)
    n_current = round(g.speed_period_s / g.current_period_s)
    end = np.array(state, dtype=np.float64)
    out = kernels.p_pi_pi(
        commands.reference_mm,
        commands.speed_offset_rad_s,
        commands.torque_offset_nm / axis.nominal.K,
        first,
        rows,
        plant_step(parameters, axis.screw_pitch_mm, g.current_period_s),
        loop_gains(axis, sync_period_s),
        n_speed,
        n_current,
        end,
    )
    return Response.from_rows(out, n_speed * n_current, sync_period_s, end)


def rest_loop(axis: Axis, sync_period_s: float, increment_mm: float) -> tuple[float, float, float, float]:
    """Return what an offset does to the speed loop of a table at rest, per increment.

    Speed error per increment of offset and per increment a cycle of its rate (rad/s), kp, and ki times the period.
    """
    g = axis.regulators
    rad = 2 * math.pi / axis.screw_pitch_mm * increment_mm
    return (
        g.position_gain_per_s * rad,
        g.speed_feedforward * rad / sync_period_s,
        g.speed_kp,
        g.speed_ki * sync_period_s,
    )
