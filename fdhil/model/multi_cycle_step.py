"""Computes a whole speed cycle of the current loop and the plant in one step.

While the current demand is constant, no voltage is clipped and the table neither reverses nor breaks loose, the steps
of the current loop are one linear map. The kernel applies that map only where bounds prove that these conditions hold
within the cycle; otherwise it steps one current cycle at a time.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from fdhil.model import closed_loop_kernels
from fdhil.records import Float

_I, _W, _J, _D, _S, _X = range(6)  # current, speed, integral, demand, friction sign, position


@lru_cache(maxsize=64)
def _compute_cycle_map(plant: tuple[float, ...], kp: float, ki: float, steps: int) -> Float:
    torque_constant, dry = plant[14], plant[15]
    resistance = (1.0 - plant[12]) / plant[13]
    moving = _build_step_matrix(np.array(plant[:12]), kp, ki, dry)
    still = np.array([plant[12], *([0.0] * 5), plant[13], *([0.0] * 5)])
    held = _build_step_matrix(still, kp, ki, 0.0)
    held[_W] = held[_X] = 0.0  # the motor stands still
    out = np.zeros((closed_loop_kernels.LEAP_ROWS, closed_loop_kernels.LEAP_COLUMNS))
    through = _compute_powers(moving, steps)
    out[closed_loop_kernels.LEAP_CURRENT : closed_loop_kernels.LEAP_WAY + 1] = through[-1, [_I, _W, _J, _X], :5]
    turned = through[:, _W, :5] - np.eye(6)[_W, :5]
    turned[:, _S] += (turned[:, _I] + turned[:, _D] + resistance * turned[:, _J]) * (dry / torque_constant)
    out[closed_loop_kernels.LEAP_TURN] = _bound_coefficients(turned[1:], resistance, torque_constant)
    voltages = _compute_voltage_rows(through[:-1], kp, ki)
    out[closed_loop_kernels.LEAP_VOLTAGE] = _bound_coefficients(voltages, resistance, torque_constant)
    through = _compute_powers(held, steps)
    out[closed_loop_kernels.HELD_CURRENT : closed_loop_kernels.HELD_INTEGRAL + 1] = through[-1, [_I, _J], :5]
    changed = through[:-1, _I, :5] - np.eye(6)[_I, :5]
    out[closed_loop_kernels.HELD_BREAK] = _bound_coefficients(changed, resistance, torque_constant)
    out[closed_loop_kernels.HELD_VOLTAGE] = _bound_coefficients(
        _compute_voltage_rows(through[:-1], kp, ki), resistance, torque_constant
    )
    out[closed_loop_kernels.LEAP_RESISTANCE, 0] = resistance
    out.setflags(write=False)
    return out


def compute_cycle_map(plant: Float, kp: float, ki: float, steps: int) -> Float:
    """Return the kernel's (LEAP_ROWS, LEAP_COLUMNS) for ``steps`` current-loop steps with gains ``kp`` V/A, ``ki`` V/A.

    ``plant`` (16,) is the exact step of :func:`fdhil.model.closed_loop_drive.compute_plant_step`. Maps act on current,
    speed, integral,
    demand and the sign of the friction. Bounds act on |current|, |speed|, |demand - current|, |integral - R i - K w|,
    1. The first coefficient of the speed-change bound acts on the current less the share taken by dry friction.
    """
    return _compute_cycle_map(tuple(plant.tolist()), kp, ki, steps)


def _build_step_matrix(plant: Float, kp: float, ki: float, dry: float) -> Float:
    """Return (6, 6) one step of [i, w, integral, demand, friction sign, position]."""
    step = np.eye(6)
    integral = np.array([-ki, 0.0, 1.0, ki, 0.0, 0.0])
    voltage = integral + np.array([-kp, 0.0, 0.0, kp, 0.0, 0.0])
    own = {_I: (plant[0], plant[1]), _W: (plant[2], plant[3]), _X: (plant[4], plant[5])}
    for row, on_u, on_t in ((_I, plant[6], plant[9]), (_W, plant[7], plant[10]), (_X, plant[8], plant[11])):
        step[row] = on_u * voltage
        step[row, [_I, _W]] += own[row]
        step[row, _S] -= on_t * dry
    step[_X, _X] = 1.0
    step[_J] = integral
    return step


def _compute_powers(step: Float, steps: int) -> Float:
    """Return the powers 0 .. ``steps`` of a step, (steps + 1, 6, 6)."""
    powers = [np.eye(6)]
    for _ in range(steps):
        powers.append(step @ powers[-1])
    return np.array(powers)


def _compute_voltage_rows(through: Float, kp: float, ki: float) -> Float:
    error = through[:, _D, :5] - through[:, _I, :5]
    return np.asarray(through[:, _J, :5] + (kp + ki) * error)


def _bound_coefficients(rows: Float, resistance: float, torque_constant: float) -> Float:
    """Return (5,) the largest of each coefficient; demand and integral are taken relative to their steady state."""
    i, w, integral, demand, side = rows.T
    apart = np.column_stack(
        [i + demand + resistance * integral, w + torque_constant * integral, demand, integral, side]
    )
    return np.asarray(np.abs(apart).max(axis=0, initial=0.0))
