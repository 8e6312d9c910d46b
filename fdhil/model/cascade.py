"""The cascade with every option a drive may have: PI position, PID speed, acceleration fed forward, filter, delay.

With all options 0 it is the default structure, bit for bit but for the order of additions. A structure of its own is
one more file like this one: a ``simulate`` of the same contract, listed in ``tables.REGULATORS``.
"""

from __future__ import annotations

import math

import numpy as np

from fdhil.config import Axis
from fdhil.model import kernels, p_pi_pi
from fdhil.model.closed_loop import Commands, Response, State
from fdhil.model.p_pi_pi import loop_gains, plant_step
from fdhil.records import Float, Parameters


def options(axis: Axis) -> Float:
    """Return (6,) the options as :func:`fdhil.model.kernels.cascade` takes them."""
    g = axis.regulators
    rad_per_mm = 2 * math.pi / axis.screw_pitch_mm
    return np.array(
        [
            g.position_ki_per_s2 * rad_per_mm * g.speed_period_s,
            g.speed_kd / g.speed_period_s,
            g.acceleration_feedforward * axis.nominal.Jt / axis.nominal.K,
            math.exp(-g.speed_period_s / g.setpoint_filter_s) if g.setpoint_filter_s > 0 else 0.0,
            g.current_delay_cycles,
            rad_per_mm,
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
    out = kernels.cascade(
        commands.reference_mm,
        commands.speed_offset_rad_s,
        commands.torque_offset_nm / axis.nominal.K,
        first,
        rows,
        plant_step(parameters, axis.screw_pitch_mm, g.current_period_s),
        loop_gains(axis, sync_period_s),
        options(axis),
        n_speed,
        n_current,
        end,
    )
    return Response.from_rows(out, n_speed * n_current, sync_period_s, end)


def rest_loop(axis: Axis, sync_period_s: float, increment_mm: float) -> tuple[float, float, float, float] | None:
    """Return what an offset does to the speed loop of a table at rest; None where the position loop integrates too."""
    if axis.regulators.position_ki_per_s2 > 0:
        return None
    return p_pi_pi.rest_loop(axis, sync_period_s, increment_mm)
