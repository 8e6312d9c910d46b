"""Prepares what all regulator structures share: the plant's exact step, the kernel's gains, the drive to run.

Each PI integrates first: candidate = integral + ki h e, output = clip(kp e + candidate); where the clip acts, the old
integral is kept. Every structure has four options: acceleration fed forward as current, a filter on the set-point (and
on the speed and acceleration fed forward), a filter on the speed feedback, and a delay of the current loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fdhil.config import Axis
from fdhil.model import closed_loop_kernels, model_terms
from fdhil.model.closed_loop import Commands, Response, State
from fdhil.model.model_terms import compute_matrix_exponential
from fdhil.model.multi_cycle_step import compute_cycle_map
from fdhil.records import Float, Parameters, make_read_only_view

_NO_LEAP = make_read_only_view(np.empty((0, closed_loop_kernels.LEAP_COLUMNS)))


@lru_cache(maxsize=64)
def compute_plant_step(parameters: Parameters, pitch_mm: float, step_s: float) -> Float:
    """Return (16,) the exact step of [i, w, x] under constant voltage and friction torque, [DES] eqs. 1 and 2.

    Order: phi_ii, phi_iw, phi_wi, phi_ww, phi_xi, phi_xw, voltage on i, w, x, torque on i, w, x, then decay and voltage
    gain of the motor at standstill, K and Cd. x is in mm.
    """
    p = parameters
    mm_per_rad = pitch_mm / (2 * math.pi)
    a = np.zeros((5, 5))
    a[0, :2] = -p.R / p.L, -p.K / p.L
    a[0, 3] = 1 / p.L
    a[1, :2] = p.K / p.Jt, -p.ft / p.Jt
    a[1, 4] = 1 / p.Jt
    a[2, 1] = mm_per_rad
    e = compute_matrix_exponential(a * step_s)
    still = math.exp(-p.R / p.L * step_s)
    still_u = -math.expm1(-p.R / p.L * step_s) / p.R
    moving = (e[0, 0], e[0, 1], e[1, 0], e[1, 1], e[2, 0], e[2, 1], *e[:3, 3], *e[:3, 4])
    step = np.array([*moving, still, still_u, p.K, p.Cd])
    step.setflags(write=False)
    return step


def pack_gains(axis: Axis, sync_period_s: float) -> Float:
    """Return (GAINS,) the gains in the order of :mod:`fdhil.model.closed_loop_kernels`."""
    g = axis.regulators
    rad_per_mm = model_terms.rad_per_mm(axis)
    values = np.zeros(closed_loop_kernels.GAINS)
    values[closed_loop_kernels.KV] = g.position_gain_per_s * rad_per_mm
    values[closed_loop_kernels.KFF] = g.speed_feedforward * rad_per_mm
    values[closed_loop_kernels.SPEED_KP] = g.speed_kp
    values[closed_loop_kernels.SPEED_KI] = g.speed_ki * g.speed_period_s
    values[closed_loop_kernels.CURRENT_MAX] = g.current_limit_a
    values[closed_loop_kernels.CURRENT_KP] = g.current_kp
    values[closed_loop_kernels.CURRENT_KI] = g.current_ki * g.current_period_s
    values[closed_loop_kernels.VOLTAGE_MAX] = g.voltage_limit_v
    values[closed_loop_kernels.PERIOD] = sync_period_s
    values[closed_loop_kernels.HALF_STEP_MM] = 0.5 * g.current_period_s / rad_per_mm
    values[closed_loop_kernels.POSITION_KI] = g.position_ki_per_s2 * rad_per_mm * g.speed_period_s
    values[closed_loop_kernels.ACCELERATION] = g.torque_feedforward * rad_per_mm * axis.nominal.Jt / axis.nominal.K
    values[closed_loop_kernels.DECAY] = (
        math.exp(-g.speed_period_s / g.setpoint_filter_s) if g.setpoint_filter_s > 0 else 0.0
    )
    values[closed_loop_kernels.RAD_PER_MM] = rad_per_mm
    values[closed_loop_kernels.FULL_DEAD_TIME_A] = model_terms.compute_full_dead_time_a(axis)
    values[closed_loop_kernels.SPEED_CYCLES_PER_S] = 1.0 / g.speed_period_s
    if g.structure == "linuxcnc_pid":
        values[closed_loop_kernels.POSITION_KI] = g.position_ki_per_s2 * rad_per_mm * sync_period_s
        values[closed_loop_kernels.DERIVATIVE], values[closed_loop_kernels.FF0] = (
            g.position_derivative,
            g.position_feedforward_per_s,
        )
        values[closed_loop_kernels.FF2], values[closed_loop_kernels.FF3] = (
            g.acceleration_feedforward_s,
            g.jerk_feedforward_s2,
        )
        values[closed_loop_kernels.DEADBAND_MM], values[closed_loop_kernels.OUTPUT_MAX] = (
            g.deadband_mm,
            g.output_limit_mm_s * rad_per_mm,
        )
        values[closed_loop_kernels.PREVIOUS_TARGET], values[closed_loop_kernels.SPEED_LOOP] = (
            g.error_previous_target,
            g.pid_output == "speed",
        )
    values[closed_loop_kernels.SPEED_DECAY] = (
        math.exp(-g.speed_period_s / g.speed_filter_s) if g.speed_filter_s > 0 else 0.0
    )
    return values


@dataclass(frozen=True, slots=True)
class DriveModel:
    """One axis prepared to be run: the arguments of its kernel."""

    plant: Float
    leap: Float
    masses: Float | None
    gains: Float
    terms: Float | None
    shape: tuple[int, int, int, int, int, int]
    sync_period_s: float
    nominal_k: float

    def run(self, commands: Commands, state: State, first: int = 0, rows: int | None = None) -> Response:
        """Run ``rows`` SYNC cycles (default: all) from sample ``first``; ``state`` (STATES,) is not written."""
        end = state.copy()
        torque = commands.torque_offset_nm
        out = closed_loop_kernels.run_sync_cycles(
            make_read_only_view(commands.reference_mm),
            make_read_only_view(commands.speed_offset_rad_s),
            torque / self.nominal_k if torque.size else torque,
            first,
            commands.reference_mm.size - first if rows is None else rows,
            self.plant,
            make_read_only_view(self.leap),
            self.masses,
            self.gains,
            self.terms,
            self.shape,
            end,
        )
        _, _, n_speed, n_current, _, _ = self.shape
        limited = out[closed_loop_kernels.ROW_LIMITED] / (n_speed * n_current)
        return Response(out[closed_loop_kernels.ROW_STATE :], limited, end, self.sync_period_s, self.masses is not None)


def prepare_drive_model(law: int, places: int, parameters: Parameters, axis: Axis, sync_period_s: float) -> DriveModel:
    """Prepare an axis with a law of the kernel that uses the first ``places`` elements of the state."""
    g = axis.regulators
    n_speed = round(sync_period_s / g.speed_period_s)
    n_current = round(g.speed_period_s / g.current_period_s)
    order = g.setpoint_filter_order if g.setpoint_filter_s > 0 else 0
    more = model_terms.has_kernel_terms(parameters)
    plant, values = (
        compute_plant_step(parameters, axis.screw_pitch_mm, g.current_period_s),
        pack_gains(axis, sync_period_s),
    )
    kp, ki = values[closed_loop_kernels.CURRENT_KP], values[closed_loop_kernels.CURRENT_KI]
    steps_only = (
        g.current_delay_cycles > 0 or model_terms.has_spring(parameters) or model_terms.has_presliding(parameters)
    )
    through = (
        _NO_LEAP
        if steps_only
        else compute_cycle_map(_normalise_dry_friction(plant) if more else plant, kp, ki, n_current)
    )
    return DriveModel(
        plant,
        through,
        model_terms.compute_two_mass_step(parameters, axis.screw_pitch_mm, g.current_period_s)
        if model_terms.has_spring(parameters)
        else None,
        values,
        model_terms.pack_terms(parameters) if more else None,
        (law, _count_states(places, parameters, axis), n_speed, n_current, order, g.current_delay_cycles),
        sync_period_s,
        axis.nominal.K,
    )


def _normalise_dry_friction(plant: Float) -> Float:
    """Return the plant with 1 N.m of dry friction, so that a map scales with any torque."""
    return np.append(plant[:-1], 1.0)


def _count_states(places: int, parameters: Parameters, axis: Axis) -> int:
    """Return how many elements of the state a drive uses: those of its structure, options and terms."""
    g = axis.regulators
    if g.current_delay_cycles:
        return closed_loop_kernels.WAITING + g.current_delay_cycles
    if model_terms.has_spring(parameters) or model_terms.has_presliding(parameters):
        return closed_loop_kernels.NEXT
    if g.speed_filter_s > 0:
        return closed_loop_kernels.TABLE
    return closed_loop_kernels.SPEED_FILTERED if g.setpoint_filter_s > 0 else places
