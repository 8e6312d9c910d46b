"""Checks standstill: sensors must read zero speed and u = R i, and friction must hold no more than it drags."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fdhil.identification import (
    LikelihoodFit,
    NoiseLevels,
    build_estimate,
    compute_term_voltage_v,
    fill_forward,
    invert_symmetric,
    smooth_samples,
)
from fdhil.records import Reason, Window
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.table_assessment import TableAssessment
from fdhil.validation.window_fit import WindowFit

Rows = np.ndarray[tuple[int], np.dtype[np.intp]]

ROWS = 12
SURE = BUDGET["standstill"].deviations
LEAST_SPEED = 0.004  # of the rapid speed
LEAST_CURRENT = 0.01  # of the peak current
SETTLING_S, RISING_S = 0.010, 0.020  # at the ends of standstill, in which the current follows from or for a move
HOLDING_SHARE = 1.15  # a drive at rest may hold as much as dry friction drags, and no more
LEAST_TORQUE = 0.01


def check_sensor_offsets(fitted: WindowFit) -> Iterator[Reason]:
    """Yield the sensors whose zero is contradicted by the samples at standstill."""
    window, fit, noise = fitted.window, fitted.aligned_fit, fitted.signals.noise
    rows = np.flatnonzero(fitted.signals.standstill)
    if rows.size < ROWS or not fitted.signals.has_voltage:
        return
    speed = float(np.mean(window.speed_rad_s[rows]))
    limit = max(SURE * noise.speed_rad_s / np.sqrt(rows.size), LEAST_SPEED * window.rapid_speed_rad_s)
    if abs(speed) > limit:
        text = f"speed reads {speed:+.3g} rad/s at standstill, limit {limit:.2g}"
        yield Reason("CalibrationSuspect", text, "set the zero of the speed sensor at standstill")
    yield from _compare_current_with_voltage(window, fit, noise, rows, fitted.lost_voltage_v)


def check_standstill_friction(table: TableAssessment) -> Iterator[Reason]:
    """Yield friction at standstill, or at the beginning of a move, that the model lacks."""
    fitted, signals = table.fitted, table.signals
    rows = np.flatnonzero(signals.standstill)
    if rows.size < ROWS or not signals.has_voltage:
        return
    yield from _check_holding_torque(fitted.window, fitted.aligned_fit, rows)
    if (late := fitted.breakaway) is not None:
        yield table.append_cost(late.build_reason(), table.compute_breakaway_um(late))


def _compare_current_with_voltage(
    window: Window, fit: LikelihoodFit, noise: NoiseLevels, rows: Rows, lost_v: float
) -> Iterator[Reason]:
    """At standstill u = R i + L di/dt: the zero of current or voltage is off where they contradict each other.

    ``lost_v`` of the recorded voltage may not reach the motor.
    """
    if window.voltage_v is None:
        return
    peak = float(np.nanmax(np.abs(window.current_a)))
    resistance, inductance, torque_constant = fit.theta[:3]
    voltage = window.voltage_v + compute_term_voltage_v(fit.problem.motions[0], fit.theta)
    settled, rising = round(SETTLING_S / window.dt_s), round(RISING_S / window.dt_s)
    for part in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        still = part[settled:-rising]
        if still.size < ROWS:
            continue
        current, quarter = window.current_a[still], still.size // 4
        lasted_s = (still.size - quarter) * window.dt_s
        rise = (current[-quarter:].mean() - current[:quarter].mean()) / lasted_s
        excess = float(current.mean() - (voltage[still].mean() - inductance * rise) / resistance)
        crept = float(np.ptp(window.position_mm[still[[0, -1]]])) / window.pitch_mm * 2 * np.pi
        doubts = (
            np.hypot(noise.current_a, noise.voltage_v / resistance) / np.sqrt(still.size),
            inductance / resistance * noise.current_a * np.sqrt(2 / quarter) / lasted_s,
            torque_constant / resistance * crept / (still.size * window.dt_s),
        )
        limit = max(SURE * float(np.linalg.norm(doubts)), LEAST_CURRENT * peak)
        limit += lost_v / float(resistance)
        if abs(excess) > limit and abs(excess) > SURE * _compute_resistance_std_share(fit) * abs(float(current.mean())):
            text = f"at standstill the current reads {excess:+.3g} A more than voltage and resistance make"
            yield Reason("CalibrationSuspect", text, "set the zeros of current and voltage sensor at standstill")
            return


def _compute_resistance_std_share(fit: LikelihoodFit) -> float:
    return build_estimate(fit).get_std("R") / float(fit.theta[0])


def _check_holding_torque(window: Window, fit: LikelihoodFit, rows: Rows) -> Iterator[Reason]:
    """Report a shaft at rest although K i exceeds Cd: the model lacks friction or a load."""
    held = float(fit.theta[2]) * float(np.median(smooth_samples(fill_forward(window.current_a), window.dt_s)[rows]))
    peak = abs(fit.theta[2]) * float(np.nanmax(np.abs(window.current_a)))
    spread = float(np.sqrt(invert_symmetric(fit.information)[0][5, 5]))
    limit = HOLDING_SHARE * max(fit.theta[5], 0.0) + SURE * spread + LEAST_TORQUE * peak
    if abs(held) <= limit:
        return
    rests = f"the shaft rests under {abs(held):.3g} N.m, though dry friction is {fit.theta[5]:.3g} N.m"
    if held * window.direction < 0.0:  # a torque against this direction holds the shaft
        text = f"{rests} in this direction: a load, or friction that differs by direction"
        yield Reason("ValidationFailed", text, "identify rapids of both directions")
    else:
        yield Reason("ValidationFailed", f"{rests} (Stribeck)", "lubricate the slide-way, or check for a clamped axis")
