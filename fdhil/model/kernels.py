"""The compiled loops of the closed-loop model. Plain numbers in, plain numbers out; no lock is held while they run."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from fdhil.records import Float

# places in the state vector (6,)
CURRENT, SPEED, POSITION, SPEED_INTEGRAL, CURRENT_INTEGRAL, CURRENT_DEMAND = range(6)
# what a run records at each SYNC instant: the share of the cycle's steps with a limit acting, the peaks, the state
ROW_LIMITED, ROW_PEAK_CURRENT, ROW_PEAK_VOLTAGE, ROW_STATE = range(4)


def _p_pi_pi_plain(
    reference: Float,
    speed_offset: Float,
    current_offset: Float,
    first: int,
    rows: int,
    plant: Float,
    gains: Float,
    n_speed: int,
    n_current: int,
    state: Float,
) -> Float:
    """Run SYNC cycles ``first`` .. ``first + rows - 1`` and return (rows, 9) as seen at the start of each cycle.

    ``reference`` (n,) mm is held beyond its end; ``speed_offset`` rad/s and ``current_offset`` A are (n,) or empty.
    ``plant`` (16,): the exact step of [i, w, x], see :func:`fdhil.model.p_pi_pi.plant_step`. ``gains`` (13,): Kv and
    Kff already times 2 pi / pitch, speed kp, ki h, limit, current kp, ki h, limit, SYNC period. ``state`` is written.
    """
    last = reference.size - 1
    out = np.empty((rows, 9))
    phi_ii, phi_iw, phi_wi, phi_ww, phi_xi, phi_xw = plant[0], plant[1], plant[2], plant[3], plant[4], plant[5]
    i_u, w_u, x_u, i_t, w_t, x_t = plant[6], plant[7], plant[8], plant[9], plant[10], plant[11]
    still, still_u, torque_constant, dry = plant[12], plant[13], plant[14], plant[15]
    kv, kff, speed_kp, speed_ki, current_max = gains[0], gains[1], gains[2], gains[3], gains[4]
    current_kp, current_ki, voltage_max, period, half_step_mm = gains[5], gains[6], gains[7], gains[8], gains[9]
    i, w, x, speed_integral, current_integral = state[0], state[1], state[2], state[3], state[4]
    demand_a = state[5]
    has_speed = speed_offset.size > 0
    has_current = current_offset.size > 0
    for row in range(rows):
        k = first + row
        r0 = reference[min(k, last)]
        r1 = reference[min(k + 1, last)]
        r2 = reference[min(k + 2, last)]
        rise = r1 - r0
        slope = rise / period
        bend = (r2 - r1) / period - slope
        peak_current = 0.0
        peak_voltage = 0.0
        limited = 0
        out[row, 3] = i
        out[row, 4] = w
        out[row, 5] = x
        out[row, 6] = speed_integral
        out[row, 7] = current_integral
        out[row, 8] = demand_a
        for m in range(n_speed):
            part = m / n_speed
            demand = kv * (r0 + rise * part - x) + kff * (slope + bend * part)
            if has_speed:
                v0 = speed_offset[min(k, last)]
                demand += v0 + (speed_offset[min(k + 1, last)] - v0) * part
            error = demand - w
            candidate = speed_integral + speed_ki * error
            raw = speed_kp * error + candidate
            if has_current:
                c0 = current_offset[min(k, last)]
                raw += c0 + (current_offset[min(k + 1, last)] - c0) * part
            peak_current = max(peak_current, abs(raw))
            demand_a = min(max(raw, -current_max), current_max)
            current_limited = demand_a != raw
            if not current_limited:
                speed_integral = candidate
            for _ in range(n_current):
                error = demand_a - i
                candidate = current_integral + current_ki * error
                raw = current_kp * error + candidate
                u = min(max(raw, -voltage_max), voltage_max)
                peak_voltage = max(peak_voltage, abs(raw))
                if u == raw:
                    current_integral = candidate
                    if current_limited:
                        limited += 1
                else:
                    limited += 1
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
        out[row, 0] = limited
        out[row, 1] = peak_current
        out[row, 2] = peak_voltage
    state[0], state[1], state[2], state[3], state[4] = i, w, x, speed_integral, current_integral
    state[5] = demand_a
    return out


p_pi_pi: Callable[..., Float] = njit(cache=True, nogil=True)(_p_pi_pi_plain)


# places in the cascade's state behind those of p_pi_pi
POSITION_INTEGRAL, SPEED_ERROR, FILTER_LAG, FILTERED_SPEED, WAITING = 6, 7, 8, 9, 10


def _cascade_plain(
    reference: Float,
    speed_offset: Float,
    current_offset: Float,
    first: int,
    rows: int,
    plant: Float,
    gains: Float,
    extra: Float,
    n_speed: int,
    n_current: int,
    state: Float,
) -> Float:
    """Run SYNC cycles as :func:`p_pi_pi` does, with the options of ``extra`` (6,); return (rows, 3 + state.size).

    ``extra``: position ki h, speed kd / h, A per rad/s2 of the demand's acceleration, decay of the set-point filter in
    a speed cycle (0: none), computing delay in current cycles, rad per mm. The voltages that wait end the state.
    """
    last = reference.size - 1
    out = np.empty((rows, 3 + state.size))
    dry, delay = plant[15], int(extra[4])
    decay, period = extra[3], gains[8]
    for row in range(rows):
        k = first + row
        r0, r1, r2 = reference[min(k, last)], reference[min(k + 1, last)], reference[min(k + 2, last)]
        rise = r1 - r0
        slope = rise / period
        bend = (r2 - r1) / period - slope
        feed = extra[2] * extra[5] * bend / period
        peak_current, peak_voltage, limited = 0.0, 0.0, 0
        out[row, 3:] = state
        for m in range(n_speed):
            part = m / n_speed
            state[9] = decay * state[9] + (1.0 - decay) * (slope + bend * part)
            lag = r0 + rise * part - state[8] - state[2]
            state[8] = (state[8] + rise / n_speed) * decay
            place = state[6] + extra[0] * lag
            demand = gains[0] * lag + place + gains[1] * state[9]
            if speed_offset.size > 0:
                v0 = speed_offset[min(k, last)]
                demand += v0 + (speed_offset[min(k + 1, last)] - v0) * part
            error = demand - state[1]
            candidate = state[3] + gains[3] * error
            raw = gains[2] * error + candidate + extra[1] * (error - state[7]) + feed
            if current_offset.size > 0:
                c0 = current_offset[min(k, last)]
                raw += c0 + (current_offset[min(k + 1, last)] - c0) * part
            state[7] = error
            peak_current = max(peak_current, abs(raw))
            demand_a = min(max(raw, -gains[4]), gains[4])
            current_limited = demand_a != raw
            if not current_limited:  # all integrals stand while the limit acts
                state[3] = candidate
                state[6] = place
            for _ in range(n_current):
                error = demand_a - state[0]
                candidate = state[4] + gains[6] * error
                raw = gains[5] * error + candidate
                u = min(max(raw, -gains[7]), gains[7])
                peak_voltage = max(peak_voltage, abs(raw))
                if u == raw:
                    state[4] = candidate
                if u != raw or current_limited:
                    limited += 1
                for d in range(delay):
                    waiting = state[WAITING + d]
                    state[WAITING + d] = u
                    u = waiting
                i, w = state[0], state[1]
                torque = plant[14] * i
                if w == 0.0 and abs(torque) <= dry:
                    state[0] = plant[12] * i + plant[13] * u
                    continue
                friction = -dry if w > 0.0 or (w == 0.0 and torque > 0.0) else dry
                w_next = plant[2] * i + plant[3] * w + plant[7] * u + plant[10] * friction
                state[0] = plant[0] * i + plant[1] * w + plant[6] * u + plant[9] * friction
                if w_next * friction > 0.0:
                    state[1] = 0.0
                    state[2] += gains[9] * w
                else:
                    state[1] = w_next
                    state[2] += plant[4] * i + plant[5] * w + plant[8] * u + plant[11] * friction
        out[row, 0], out[row, 1], out[row, 2] = limited, peak_current, peak_voltage
    return out


cascade: Callable[..., Float] = njit(cache=True, nogil=True)(_cascade_plain)
