"""Integrates an axis with the effects of real machines, one SYNC cycle at a time; compiled part of :mod:`.reality`.

Two masses, motor with screw and table, or one where the screw is stiff (x: speeds w and angles a, SI units):

    L di/dt    = u acting - R i - K w
    Jm dw/dt   = K i - spring - ripples - friction       spring = k d + c (w - wt), d = a - at beyond the backlash
    Jt' dwt/dt = spring - load - friction

Dry friction sticks, or acts through bristles z (LuGre: Canudas and others 1995):

    level   = C (1 +- asymmetry) (1 + ripple sin a) (1 + static exp(-(w/ws)^2))
    F       = level sign(w)      or      s0 z + s1 dz/dt,   dz/dt = w - s0 |w| z / level

Each current cycle is one step of the midpoint rule with a constant sign of sticking friction: the error is about 1e-5
of the motion, far below an increment. The bristles, which are stiff at speed, advance by half a step before and after
it in closed form.
"""

import math

import numba
import numpy as np

from fdhil.records import Float
from fdhil.sim.drive.plant_physics import CURRENT_LIMIT, VOLTAGE_LIMIT, Command

MOST_DELAY = 32
# indices of the state
(
    CURRENT, SPEED, ANGLE, TABLE_SPEED, TABLE, BRISTLE, TABLE_BRISTLE, SPEED_INTEGRAL, CURRENT_INTEGRAL, SEEN_SPEED,
    ENCODER, BUS, PLACE, RATE, PLACE_2, RATE_2, WAITING,
) = range(17)  # fmt: skip
STATES = WAITING + MOST_DELAY
# indices of the plant: R to K, then inertia, viscous and dry friction of the motor and of the table behind the screw
(
    R, L, K, JM, JT, FM, FT, CM, CT, STATIC, STATIC_SPEED, ASYMMETRY, VISCOUS_ASYMMETRY, WAVE, SIGN, BRISTLES,
    BRISTLE_DAMPING, BRAKE, SCREW, SCREW_ORDER, SCREW_PHASE, MOTOR, MOTOR_ORDER, MOTOR_PHASE, STIFFNESS, DAMPER,
    HALF_BACKLASH, DEAD, DEAD_CURRENT, SAG, BUS_PART, PITCH, PITCH_RATE, PLANT,
) = range(34)  # fmt: skip
# indices of the loops
(
    KV, KFF, KPS, KIS, I_MAX, KPC, KIC, U_MAX, INC_PER_RAD, N_SPEED, N_CURRENT, FILTER_PART, FILTER_ORDER,
    SPEED_PART, DELAY, ENCODER_STEP, ON_TABLE, OF_ENCODER, CURRENT_GAIN, CURRENT_OFFSET, LOOPS,
) = range(21)  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _compute_dry_friction(p: Float, share: float, w: float, a: float, side: float) -> float:
    """Return the dry friction (N.m) of a body with ``share`` of it, moving in direction ``side`` at speed ``w``."""
    fades = p[STATIC] * math.exp(-((w / p[STATIC_SPEED]) ** 2)) if p[STATIC] != 0.0 else 0.0
    wave = p[WAVE] * math.sin(p[SIGN] * a) if p[WAVE] != 0.0 else 0.0
    return float(share * (1.0 + side * p[ASYMMETRY]) * (1.0 + wave) * (1.0 + fades))


@numba.njit(cache=True, nogil=True)
def _compute_viscous_friction(p: Float, share: float, w: float) -> float:
    side = 1.0 if w > 0.0 else -1.0
    return float(share * w * (1.0 + side * p[VISCOUS_ASYMMETRY]))


@numba.njit(cache=True, nogil=True)
def _compute_bristle_friction(p: Float, share: float, w: float, a: float, z: float, inertia: float) -> float:
    """Return the friction (N.m) of bristles deflected by ``z`` rad; zero where friction sticks instead."""
    if p[BRISTLES] == 0.0 or share == 0.0:
        return 0.0
    s0 = p[BRISTLES] * share
    slip = w - s0 * abs(w) * z / _compute_dry_friction(p, share, w, a, 1.0 if w >= 0.0 else -1.0)
    return float(s0 * z + p[BRISTLE_DAMPING] * math.sqrt(s0 * inertia) * slip)


@numba.njit(cache=True, nogil=True)
def _compute_bristle_deflection(p: Float, share: float, w: float, a: float, z: float, time_s: float) -> float:
    """Return the deflection of the bristles after ``time_s`` at this speed."""
    if p[BRISTLES] == 0.0 or share == 0.0 or w == 0.0:
        return z
    end = _compute_dry_friction(p, share, w, a, 1.0 if w > 0.0 else -1.0) / (p[BRISTLES] * share)
    goal = end if w > 0.0 else -end
    return float(goal + (z - goal) * math.exp(-abs(w) * time_s / end))


@numba.njit(cache=True, nogil=True)
def _compute_spring_torque(p: Float, x: Float) -> float:
    """Return the torque (N.m) transmitted by the screw from motor to table."""
    if p[STIFFNESS] == 0.0:
        return 0.0
    bend = x[ANGLE] - x[TABLE]
    half = p[HALF_BACKLASH]
    if abs(bend) < half:
        return 0.0
    return float(p[STIFFNESS] * (bend - math.copysign(half, bend)) + p[DAMPER] * (x[SPEED] - x[TABLE_SPEED]))


@numba.njit(cache=True, nogil=True)
def _compute_driving_torques(p: Float, x: Float, current: float, load: float) -> tuple[float, float]:
    """Return the torques on motor and table (N.m) without sticking friction."""
    w, a, spring = x[SPEED], x[ANGLE], _compute_spring_torque(p, x)
    ripples = p[SCREW] * math.sin(p[SCREW_ORDER] * a + p[SCREW_PHASE]) if p[SCREW] != 0.0 else 0.0
    if p[MOTOR] != 0.0:
        ripples += p[MOTOR] * math.sin(p[MOTOR_ORDER] * a + p[MOTOR_PHASE])
    motor = p[K] * current - spring - ripples - _compute_viscous_friction(p, p[FM], w)
    motor -= _compute_bristle_friction(p, p[CM], w, a, x[BRISTLE], p[JM])
    if p[STIFFNESS] == 0.0:
        return motor - load, 0.0
    wt = x[TABLE_SPEED]
    table = spring - load - _compute_viscous_friction(p, p[FT], wt)
    return motor, table - _compute_bristle_friction(p, p[CT], wt, x[TABLE], x[TABLE_BRISTLE], p[JT])


@numba.njit(cache=True, nogil=True)
def _compute_holding_friction(p: Float, share: float, w: float, a: float, side: float, brake: float) -> float:
    """Return the friction that sticks (N.m): dry friction without bristles, and a closed brake."""
    return brake if p[BRISTLES] != 0.0 else brake + _compute_dry_friction(p, share, w, a, side)


@numba.njit(cache=True, nogil=True)
def _determine_motion_sign(p: Float, share: float, w: float, a: float, push: float, brake: float) -> float:
    """Return the sign of the present or imminent motion of a body; 0 where it sticks."""
    if w != 0.0:
        return 1.0 if w > 0.0 else -1.0
    side = 1.0 if push > 0.0 else -1.0
    return side if abs(push) > _compute_holding_friction(p, share, 0.0, a, side, brake) else 0.0


@numba.njit(cache=True, nogil=True)
def _compute_motor_voltage(p: Float, u: float, current: float) -> float:
    """Return the motor voltage for an inverter demand ``u``, already scaled by the DC link."""
    return float(u - p[DEAD] * min(max(current / p[DEAD_CURRENT], -1.0), 1.0))


@numba.njit(cache=True, nogil=True)
def _compute_derivatives(
    p: Float, x: Float, u: float, load: float, brake: float, side: float, table_side: float, off: bool, out: Float
) -> None:
    """Fill ``out`` (5,) with the derivatives of current, motor speed and angle, table speed and angle."""
    current = 0.0 if off else x[CURRENT]
    push, table_push = _compute_driving_torques(p, x, current, load)
    out[CURRENT] = 0.0 if off else (_compute_motor_voltage(p, u, current) - p[R] * current - p[K] * x[SPEED]) / p[L]
    out[SPEED] = 0.0
    if side != 0.0:
        out[SPEED] = (push - side * _compute_holding_friction(p, p[CM], x[SPEED], x[ANGLE], side, brake)) / p[JM]
    out[ANGLE], out[TABLE] = x[SPEED], x[TABLE_SPEED]
    out[TABLE_SPEED] = 0.0
    if p[STIFFNESS] != 0.0 and table_side != 0.0:
        held = _compute_holding_friction(p, p[CT], x[TABLE_SPEED], x[TABLE], table_side, 0.0)
        out[TABLE_SPEED] = (table_push - table_side * held) / p[JT]


@numba.njit(cache=True, nogil=True)
def _update_bristles(p: Float, x: Float, time_s: float) -> None:
    x[BRISTLE] = _compute_bristle_deflection(p, p[CM], x[SPEED], x[ANGLE], x[BRISTLE], time_s)
    x[TABLE_BRISTLE] = _compute_bristle_deflection(p, p[CT], x[TABLE_SPEED], x[TABLE], x[TABLE_BRISTLE], time_s)


@numba.njit(cache=True, nogil=True)
def _step_real_plant(
    p: Float, x: Float, u: float, load: float, off: bool, h: float, trial: Float, slope: Float
) -> None:
    """Advance the first seven states by one step under voltage ``u``; ``trial`` (7,), ``slope`` (5,) are scratch."""
    brake = p[BRAKE] if off else 0.0
    _update_bristles(p, x, 0.5 * h)
    if off:
        x[CURRENT] = 0.0
    push, table_push = _compute_driving_torques(p, x, x[CURRENT], load)
    side = _determine_motion_sign(p, p[CM], x[SPEED], x[ANGLE], push, brake)
    table_side = _determine_motion_sign(p, p[CT], x[TABLE_SPEED], x[TABLE], table_push, 0.0)
    w, wt, a, at = x[SPEED], x[TABLE_SPEED], x[ANGLE], x[TABLE]
    for n in range(7):
        trial[n] = x[n]
    _compute_derivatives(p, trial, u, load, brake, side, table_side, off, slope)
    for n in range(5):
        trial[n] += 0.5 * h * slope[n]
    _compute_derivatives(p, trial, u, load, brake, side, table_side, off, slope)
    for n in range(5):
        x[n] += h * slope[n]
    if x[SPEED] * side < 0.0 and _compute_holding_friction(p, p[CM], 0.0, a, side, brake) > 0.0:
        x[SPEED], x[ANGLE] = 0.0, a + 0.5 * w * h
    if p[STIFFNESS] == 0.0:
        half = p[HALF_BACKLASH]
        x[TABLE_SPEED], x[TABLE] = x[SPEED], min(max(at, x[ANGLE] - half), x[ANGLE] + half)
    elif x[TABLE_SPEED] * table_side < 0.0 and _compute_holding_friction(p, p[CT], 0.0, at, table_side, 0.0) > 0.0:
        x[TABLE_SPEED], x[TABLE] = 0.0, at + 0.5 * wt * h
    _update_bristles(p, x, 0.5 * h)


@numba.njit(cache=True, nogil=True)
def compute_table_angle(p: Float, x: Float) -> float:
    """Return the table position as a shaft angle, including the pitch error."""
    a = x[TABLE]
    return float(a + p[PITCH] * math.sin(a) + p[PITCH_RATE] * a)


@numba.njit(cache=True, nogil=True)
def compute_encoder_angle(p: Float, g: Float, x: Float, on_table: bool) -> float:
    """Return the reading of the encoder at the table or at the motor, rad."""
    angle = compute_table_angle(p, x) if on_table else x[ANGLE]
    step = float(g[ENCODER_STEP])
    return angle if step == 0.0 else float(step * np.rint(angle / step))


@numba.njit(cache=True, nogil=True)
def _run_position_and_speed_loop(
    p: Float, g: Float, x: Float, place: float, rate: float, more: float, current: float
) -> float:
    """Run position and speed loop once; return the current demand (A) before its limit."""
    for n in range(int(g[FILTER_ORDER])):
        at = PLACE + 2 * n
        x[at] += g[FILTER_PART] * (place - x[at])
        x[at + 1] += g[FILTER_PART] * (rate - x[at + 1])
        place, rate = x[at], x[at + 1]
    position = np.rint(compute_encoder_angle(p, g, x, g[ON_TABLE] != 0.0) * g[INC_PER_RAD])
    speed = x[SPEED]
    if g[OF_ENCODER] != 0.0:
        encoder = compute_encoder_angle(p, g, x, False)
        speed = (encoder - x[ENCODER]) * g[OF_ENCODER]
        x[ENCODER] = encoder
    x[SEEN_SPEED] += g[SPEED_PART] * (speed - x[SEEN_SPEED])
    error = (g[KV] * (place - position) + g[KFF] * rate) / g[INC_PER_RAD] + more - x[SEEN_SPEED]
    candidate = x[SPEED_INTEGRAL] + g[KIS] * error
    raw = g[KPS] * error + candidate + current
    if abs(raw) <= g[I_MAX]:
        x[SPEED_INTEGRAL] = candidate
    return float(raw)


@numba.njit(cache=True, nogil=True)
def _run_current_loop(g: Float, x: Float, wanted: float) -> float:
    """Run the current loop once; return the voltage demand (V) before its limit."""
    error = wanted - (g[CURRENT_GAIN] * x[CURRENT] + g[CURRENT_OFFSET])
    candidate = x[CURRENT_INTEGRAL] + g[KIC] * error
    raw = g[KPC] * error + candidate
    if abs(raw) <= g[U_MAX]:
        x[CURRENT_INTEGRAL] = candidate
    return float(raw)


@numba.njit(cache=True, nogil=True)
def simulate_real_cycle(
    x: Float, g: Float, p: Float, voltage: Float, enabled: bool, command: Command, load: float, h: float
) -> tuple[float, float, int]:
    """Run one SYNC cycle; return the mean motor voltage, the mean demanded voltage, and the limits that acted.

    ``x`` (STATES,) and ``voltage`` (n,), the motor voltage in each current step, are written. ``g`` (LOOPS,) and ``p``
    (PLANT,) are packed by :class:`fdhil.sim.drive.real_plant.RealPlantPhysics`; ``command`` and loops are those of
    :func:`fdhil.sim.drive.plant_physics.simulate_sync_cycle`.
    """
    p0, p1, f0, f1, v0, v1, c0, c1 = command
    n_speed, n_current, delay = int(g[N_SPEED]), int(g[N_CURRENT]), int(g[DELAY])
    trial, slope = np.zeros(7), np.zeros(5)
    asked_total, total, limits, wanted = 0.0, 0.0, 0, 0.0
    for m in range(n_speed):
        if enabled:
            part = m / n_speed
            place, rate = p0 + (p1 - p0) * part, f0 + (f1 - f0) * part
            raw = _run_position_and_speed_loop(p, g, x, place, rate, v0 + (v1 - v0) * part, c0 + (c1 - c0) * part)
            wanted = min(max(raw, -g[I_MAX]), g[I_MAX])
            limits |= CURRENT_LIMIT if wanted != raw else 0
        for c in range(n_current):
            asked = p[K] * x[SPEED]  # an open motor shows its back-EMF
            first = asked
            if enabled:
                raw = _run_current_loop(g, x, wanted)
                asked = min(max(raw, -g[U_MAX]), g[U_MAX])
                limits |= VOLTAGE_LIMIT if asked != raw else 0
            u = asked
            for d in range(delay):
                u, x[WAITING + d] = x[WAITING + d], u
            u *= x[BUS]
            if enabled:
                first = _compute_motor_voltage(p, u, x[CURRENT])
            _step_real_plant(p, x, u, load, not enabled, h, trial, slope)
            acting = 0.5 * (first + (_compute_motor_voltage(p, u, x[CURRENT]) if enabled else p[K] * x[SPEED]))
            power = max(0.0, acting * x[CURRENT])
            x[BUS] += p[BUS_PART] * (1.0 - p[SAG] * power - x[BUS])
            voltage[m * n_current + c] = acting
            total += acting
            asked_total += asked
    count = n_speed * n_current
    return total / count, asked_total / count, limits
