"""The compiled loops of the closed-loop model. Plain numbers in, plain numbers out; no lock is held while they run.

All compiled code of the drives is in this file, whatever their structure: numba's cache of a compiled function is
renewed when its own file changes, not when that of a function it calls does.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from fdhil.records import Float

# places in the state vector: what every drive has, then what structures and options add
CURRENT, SPEED, POSITION, SPEED_INTEGRAL, CURRENT_INTEGRAL, CURRENT_DEMAND = range(6)
POSITION_INTEGRAL, SET_POINT_BEFORE, POSITION_BEFORE, FILTERED, WAITING = 6, 7, 8, 9, 15
MOST_WAITING = 4
STATES = WAITING + MOST_WAITING
# what a run records at each SYNC instant: the share of the cycle's steps with a limit acting, the peaks, the state
ROW_LIMITED, ROW_PEAK_CURRENT, ROW_PEAK_VOLTAGE, ROW_STATE = range(4)
# places in the gains, see fdhil.model.loops.gains
KV, KFF, SPEED_KP, SPEED_KI, CURRENT_MAX, CURRENT_KP, CURRENT_KI, VOLTAGE_MAX, PERIOD, HALF_STEP_MM = range(10)
POSITION_KI, ACCELERATION, DECAY, RAD_PER_MM, SPEED_CYCLES_PER_S = range(10, 15)
GAINS = 15
# the laws from set-point to current demand
CASCADE, PID = range(2)


def _cascade_plain(place: float, rate: float, state: Float, gains: Float) -> tuple[float, float, float]:
    """P or PI on position, PI on speed: return the current demand and both integrals if no limit acts.

    ``place`` mm and ``rate`` rad/s are the set-point and the speed that is fed forward.
    """
    lag = place - state[POSITION]
    integral = state[POSITION_INTEGRAL] + gains[POSITION_KI] * lag
    error = gains[KV] * lag + integral + rate - state[SPEED]
    candidate = state[SPEED_INTEGRAL] + gains[SPEED_KI] * error
    return gains[SPEED_KP] * error + candidate, candidate, integral


def _pid_plain(place: float, rate: float, state: Float, gains: Float) -> tuple[float, float, float]:
    """PID on position: return the current demand, the speed integral it does not have, and its own integral.

    The derivative is the difference of Kff times set-point less position over one cycle; ``rate`` rad/s adds to it.
    """
    lag = place - state[POSITION]
    integral = state[POSITION_INTEGRAL] + gains[POSITION_KI] * lag
    moved = gains[KFF] * (place - state[SET_POINT_BEFORE]) - gains[RAD_PER_MM] * (
        state[POSITION] - state[POSITION_BEFORE]
    )
    state[SET_POINT_BEFORE] = place
    state[POSITION_BEFORE] = state[POSITION]
    speed = gains[KV] * lag + integral + gains[SPEED_CYCLES_PER_S] * moved + rate
    return gains[SPEED_KP] * speed, 0.0, integral


def _filter_plain(place: float, rate: float, bend: float, order: int, decay: float, state: Float) -> None:
    """Put set-point, speed and acceleration through ``order`` equal first-order filters, in place in the state."""
    for n in range(order):
        at = FILTERED + 3 * n
        place = decay * state[at] + (1.0 - decay) * place
        rate = decay * state[at + 1] + (1.0 - decay) * rate
        bend = decay * state[at + 2] + (1.0 - decay) * bend
        state[at], state[at + 1], state[at + 2] = place, rate, bend


def _current_cycles_plain(
    demand_a: float, limited: bool, plant: Float, gains: Float, n_current: int, delay: int, state: Float
) -> tuple[int, float]:
    """Run the current loop and the plant for one speed cycle: return the steps with a limit acting, the peak voltage.

    ``limited``: the current demand is at its limit. The voltage acts ``delay`` steps after it was computed.
    """
    phi_ii, phi_iw, phi_wi, phi_ww, phi_xi, phi_xw = plant[0], plant[1], plant[2], plant[3], plant[4], plant[5]
    i_u, w_u, x_u, i_t, w_t, x_t = plant[6], plant[7], plant[8], plant[9], plant[10], plant[11]
    still, still_u, torque_constant, dry = plant[12], plant[13], plant[14], plant[15]
    kp, ki, voltage_max, half_step_mm = gains[CURRENT_KP], gains[CURRENT_KI], gains[VOLTAGE_MAX], gains[HALF_STEP_MM]
    i, w, x, integral = state[CURRENT], state[SPEED], state[POSITION], state[CURRENT_INTEGRAL]
    steps = 0
    peak = 0.0
    for _ in range(n_current):
        error = demand_a - i
        candidate = integral + ki * error
        raw = kp * error + candidate
        u = min(max(raw, -voltage_max), voltage_max)
        peak = max(peak, abs(raw))
        if u == raw:
            integral = candidate
            if limited:
                steps += 1
        else:
            steps += 1
        for d in range(delay):
            u, state[WAITING + d] = state[WAITING + d], u
        torque = torque_constant * i
        if w == 0.0 and abs(torque) <= dry:
            i = still * i + still_u * u
            continue
        # one friction sign per step: that of the motion, or where the torque will start it
        if w > 0.0 or (w == 0.0 and torque > 0.0):
            friction = -dry
        else:
            friction = dry
        w_next = phi_wi * i + phi_ww * w + w_u * u + w_t * friction
        if w_next * friction > 0.0:  # the sign changed: the table stops for this step
            x += half_step_mm * w
            i = phi_ii * i + phi_iw * w + i_u * u + i_t * friction
            w = 0.0
        else:
            x += phi_xi * i + phi_xw * w + x_u * u + x_t * friction
            i = phi_ii * i + phi_iw * w + i_u * u + i_t * friction
            w = w_next
    state[CURRENT], state[SPEED], state[POSITION], state[CURRENT_INTEGRAL] = i, w, x, integral
    return steps, peak


_cascade: Callable[..., tuple[float, float, float]] = njit(cache=True, nogil=True)(_cascade_plain)
_pid: Callable[..., tuple[float, float, float]] = njit(cache=True, nogil=True)(_pid_plain)
_filter: Callable[..., None] = njit(cache=True, nogil=True)(_filter_plain)
_current_cycles: Callable[..., tuple[int, float]] = njit(cache=True, nogil=True)(_current_cycles_plain)


def _between_plain(values: Float, k: int, part: float) -> float:
    """Return the value ``part`` of the way from row k to k + 1, held beyond the end."""
    last = values.size - 1
    low = values[min(k, last)]
    return float(low + (values[min(k + 1, last)] - low) * part)


_between: Callable[[Float, int, float], float] = njit(cache=True, nogil=True)(_between_plain)


def _run_plain(
    reference: Float,
    speed_offset: Float,
    current_offset: Float,
    first: int,
    rows: int,
    plant: Float,
    gains: Float,
    shape: tuple[int, int, int, int, int, int],
    state: Float,
) -> Float:
    """Run SYNC cycles ``first`` .. ``first + rows - 1``; return (rows, 3 + kept) as seen at the start of each cycle.

    ``reference`` (n,) mm is held beyond its end; ``speed_offset`` rad/s and ``current_offset`` A are (n,) or empty.
    ``plant`` (16,) and ``gains`` (GAINS,): see :mod:`fdhil.model.loops`. ``shape``: law, states kept of each row, speed
    cycles per SYNC cycle, current cycles per speed cycle, order of the set-point filter, current cycles of delay.
    ``state`` (STATES,) is written.
    """
    law, kept, n_speed, n_current, order, delay = shape
    last = reference.size - 1
    out = np.empty((rows, ROW_STATE + kept))
    kff, period, current_max = gains[KFF], gains[PERIOD], gains[CURRENT_MAX]
    for row in range(rows):
        k = first + row
        r0, r1, r2 = reference[min(k, last)], reference[min(k + 1, last)], reference[min(k + 2, last)]
        rise = r1 - r0
        slope = rise / period
        bend = (r2 - r1) / period - slope
        peak_current, peak_voltage, limited = 0.0, 0.0, 0
        for n in range(kept):
            out[row, ROW_STATE + n] = state[n]
        for m in range(n_speed):
            part = m / n_speed
            place, rate, acceleration = r0 + rise * part, slope + bend * part, bend / period
            if order > 0:
                _filter(place, rate, acceleration, order, gains[DECAY], state)
                at = FILTERED + 3 * (order - 1)
                place, rate, acceleration = state[at], state[at + 1], state[at + 2]
            more = _between(speed_offset, k, part) if speed_offset.size > 0 else 0.0
            if law == CASCADE:
                raw, speed_integral, position_integral = _cascade(place, kff * rate + more, state, gains)
            else:
                raw, speed_integral, position_integral = _pid(place, more, state, gains)
            raw += gains[ACCELERATION] * acceleration
            if current_offset.size > 0:
                raw += _between(current_offset, k, part)
            peak_current = max(peak_current, abs(raw))
            demand_a = min(max(raw, -current_max), current_max)
            if demand_a == raw:  # all integrals stand while the limit acts
                state[SPEED_INTEGRAL], state[POSITION_INTEGRAL] = speed_integral, position_integral
            state[CURRENT_DEMAND] = demand_a
            steps, peak = _current_cycles(demand_a, demand_a != raw, plant, gains, n_current, delay, state)
            limited += steps
            peak_voltage = max(peak_voltage, peak)
        out[row, ROW_LIMITED], out[row, ROW_PEAK_CURRENT], out[row, ROW_PEAK_VOLTAGE] = (
            limited,
            peak_current,
            peak_voltage,
        )
    return out


run: Callable[..., Float] = njit(cache=True, nogil=True)(_run_plain)
