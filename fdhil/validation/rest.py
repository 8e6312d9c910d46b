"""Checks standstill: sensors must read zero speed and u = R i, and friction must hold no more than it drags."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fdhil.identification.courses import voltage_terms_v
from fdhil.identification.estimators import maximum_likelihood
from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.filtering import moving_mean
from fdhil.identification.motion import UNKNOWN, Noise
from fdhil.identification.normal import inverse_of
from fdhil.identification.windows import carried, smooth
from fdhil.records import Reason, Window
from fdhil.validation.evidence import Evidence
from fdhil.validation.significance import BUDGET

Rows = np.ndarray[tuple[int], np.dtype[np.intp]]

ROWS = 12
SURE = BUDGET["standstill"].deviations
LEAST_SPEED = 0.004  # of the rapid speed
LEAST_CURRENT = 0.01  # of the peak current
SETTLING_S, RISING_S = 0.010, 0.020  # at the ends of standstill, in which the current follows from or for a move
HOLDING_SHARE = 1.15  # a drive at rest may hold as much as dry friction drags, and no more
LEAST_TORQUE = 0.01
LEAST_BREAKAWAY = 0.02  # of the peak torque
AFTER_S = 0.015
HELD_SHARE = 0.7  # of dry friction: what surely does not move the shaft
LONGEST_BREAKAWAY_S = 0.060


def rest_faults(evidence: Evidence) -> Iterator[Reason]:
    """Yield the sensors whose zero the rows at standstill contradict."""
    window, fit, noise = evidence.window, evidence.on_time, evidence.noise
    rows = np.flatnonzero(evidence.at_rest)
    if rows.size < ROWS or (window.voltage_v is None and window.slow_voltage is None):
        return
    speed = float(np.mean(window.speed_rad_s[rows]))
    limit = max(SURE * noise.speed_rad_s / np.sqrt(rows.size), LEAST_SPEED * window.rapid_speed_rad_s)
    if abs(speed) > limit:
        text = f"speed reads {speed:+.3g} rad/s at standstill, limit {limit:.2g}"
        yield Reason("CalibrationSuspect", text, "set the zero of the speed sensor at standstill")
    yield from _contradiction(window, fit, noise, rows, evidence.lost_v)


def friction_at_rest(evidence: Evidence) -> Iterator[Reason]:
    """Yield what friction holds at standstill, or takes to begin to move, that the model does not have."""
    window, fit = evidence.window, evidence.on_time
    rows = np.flatnonzero(evidence.at_rest)
    if rows.size < ROWS or (window.voltage_v is None and window.slow_voltage is None):
        return
    yield from _holding(window, fit, rows)
    yield from breakaway(window, fit)


def _contradiction(window: Window, fit: Fit, noise: Noise, rows: Rows, lost_v: float) -> Iterator[Reason]:
    """At standstill u = R i + L di/dt: the zero of current or voltage is off where they contradict each other.

    ``lost_v`` of the recorded voltage may not reach the motor.
    """
    if window.voltage_v is None:
        return
    peak = float(np.nanmax(np.abs(window.current_a)))
    resistance, inductance, torque_constant = fit.theta[:3]
    voltage = window.voltage_v + voltage_terms_v(fit.problem.motions[0], fit.theta)
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
        if abs(excess) > limit and abs(excess) > SURE * _resistance_share(fit) * abs(float(current.mean())):
            text = f"at standstill the current reads {excess:+.3g} A more than voltage and resistance make"
            yield Reason("CalibrationSuspect", text, "set the zeros of current and voltage sensor at standstill")
            return


def _resistance_share(fit: Fit) -> float:
    """Return the standard deviation of the resistance as a share of it."""
    return maximum_likelihood.finish(fit).std("R") / float(fit.theta[0])


def breakaway(window: Window, fit: Fit) -> Iterator[Reason]:
    """Yield a reason where the move takes more impulse to begin than [2] says: friction is higher at low speed.

    From rest, Jt w(t) is the integral of what K i exceeds dry friction by, less viscous friction. The current's noise
    averages out in that integral, so the speed it predicts for the first surely moving rows is sharp.
    """
    motion, theta = fit.problem.motions[0], fit.theta
    sure = np.flatnonzero(np.abs(motion.mode) == 1)
    if sure.size < 2 * AFTER_S / window.dt_s:
        return
    begin, side = int(sure[0]), int(motion.mode[sure[0]])
    end = begin + round(AFTER_S / window.dt_s)
    still = _rest_before(fit, begin, side)
    if still is None:
        return
    torque = side * theta[2] * motion.current[still:end]
    speed = side * motion.speed[still:end]
    net = np.where(np.arange(still, end) < begin, np.maximum(torque - theta[5], 0.0), torque - theta[5])
    net = net - theta[4] * np.maximum(speed, 0.0)
    predicted = np.concatenate([[0.0], np.cumsum((net[1:] + net[:-1]) / 2)]) * window.dt_s / theta[3]
    late = predicted[begin - still :] - speed[begin - still :]
    spread = fit.problem.noises[0].speed_rad_s / np.sqrt(late.size)
    lasted = (begin - still) * window.dt_s
    excess = float(np.mean(late)) * theta[3] / lasted
    sure_by = SURE * spread * theta[3] / lasted
    peak = theta[2] * float(np.abs(motion.current).max())
    if abs(excess) > sure_by + LEAST_BREAKAWAY * peak:
        text = (
            f"beginning to move takes {excess:+.3g} N.m more over {1e3 * lasted:.0f} ms than friction drags (Stribeck)"
        )
        yield Reason("ValidationFailed", text, "lubricate the slide-way, or check for a clamp or backlash")


def _rest_before(fit: Fit, begin: int, side: int) -> int | None:
    """Return the last row before the move at which the torque surely holds the shaft at rest; None without one."""
    motion, noise = fit.problem.motions[0], fit.problem.noises[0]
    rows = max(8, round(0.010 / motion.dt_s))
    first = max(rows, begin - round(LONGEST_BREAKAWAY_S / motion.dt_s))
    width = 2 * round(0.0005 / motion.dt_s) + 1
    torque = side * fit.theta[2] * moving_mean(motion.current, width)
    holding = np.flatnonzero(torque[first:begin] < HELD_SHARE * fit.theta[5])
    if holding.size == 0:
        return None
    row = first + int(holding[-1])
    quiet = abs(float(motion.speed[row - rows : row + 1].mean())) < 4 * noise.speed_rad_s / np.sqrt(rows)
    unknown = bool((motion.mode[row - rows : row + 1] == UNKNOWN).all())
    return row if quiet and unknown and row < begin - 1 else None


def _holding(window: Window, fit: Fit, rows: Rows) -> Iterator[Reason]:
    """A shaft that sticks although K i exceeds Cd has friction, or bears a load, that the model does not have."""
    held = float(fit.theta[2]) * float(np.median(smooth(carried(window.current_a), window.dt_s)[rows]))
    peak = abs(fit.theta[2]) * float(np.nanmax(np.abs(window.current_a)))
    spread = float(np.sqrt(inverse_of(fit.information)[0][5, 5]))
    limit = HOLDING_SHARE * max(fit.theta[5], 0.0) + SURE * spread + LEAST_TORQUE * peak
    if abs(held) <= limit:
        return
    told = f"the shaft rests under {abs(held):.3g} N.m, though dry friction is {fit.theta[5]:.3g} N.m"
    if held * window.direction < 0.0:  # what pushes against this direction holds the shaft
        text = f"{told} in this direction: a load, or friction that differs by direction"
        yield Reason("ValidationFailed", text, "identify rapids of both directions")
    else:
        yield Reason("ValidationFailed", f"{told} (Stribeck)", "lubricate the slide-way, or check for a clamped axis")
