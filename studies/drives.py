"""Random feed drives as machines have them, their regulators set for them, and rapids of jerk-limited demand.

It shares no numerics with the package it judges. The drive is stepped every 31.25 us by Heun's rule under a held
voltage: position, speed and current regulator, motor and table with a dead band between them, Coulomb, viscous and
Stribeck friction, and a load torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
Rng = np.random.Generator
STEP_S = 3.125e-5
SPEED_STEPS = 8
CYCLE_STEPS = 32
CYCLE_S = STEP_S * CYCLE_STEPS


@dataclass(frozen=True, slots=True)
class Drive:
    """True parameters (SI), regulators, and what the model does not have.

    ``backlash_rad`` is the dead band between motor and table in motor angle, ``motor_share`` the motor's part of
    inertia and friction; ``stribeck`` (N.m) is what friction adds at standstill, gone beyond ``stribeck_speed``.
    """

    R: float
    L: float
    K: float
    Jt: float
    ft: float
    Cd: float
    pitch_m: float
    position_gain: float
    feedforward: float
    speed_hz: float
    current_hz: float
    current_limit: float
    voltage_limit: float
    stribeck: float = 0.0
    stribeck_speed: float = 1.0
    backlash_rad: float = 0.0
    motor_share: float = 0.5

    def truth(self) -> dict[str, float]:
        """Return the six parameters by symbol."""
        return {name: getattr(self, name) for name in ("R", "L", "K", "Jt", "ft", "Cd")}

    def vector(self) -> Array:
        """Return the kernel's argument."""
        kp_s = 2 * math.pi * self.speed_hz * self.Jt / self.K
        kp_c = 2 * math.pi * self.current_hz * self.L
        return np.array([
            self.R, self.L, self.K, self.Jt, self.ft, self.Cd, self.pitch_m / (2 * math.pi),
            self.position_gain, self.feedforward,
            kp_s, kp_s * 2 * math.pi * self.speed_hz / 5, self.current_limit,
            kp_c, 2 * math.pi * self.current_hz * self.R, self.voltage_limit,
            self.stribeck, self.stribeck_speed, self.backlash_rad, self.motor_share,
        ])  # fmt: skip


@dataclass(frozen=True, slots=True)
class Move:
    """A rapid as the NC plans it: distance (m), speed (m/s), acceleration (m/s2), smoothing (s), direction."""

    distance: float
    speed: float
    acceleration: float
    smoothing: float
    direction: int


@dataclass(frozen=True, slots=True)
class Signals:
    """What was recorded, noise free: rows ``dt_s`` apart, SI units; ``voltage`` means and ``voltage_instant``."""

    dt_s: float
    voltage: Array
    voltage_instant: Array
    current: Array
    speed: Array
    position: Array
    demand: Array


def draw_drive(rng: Rng, speed: float, acceleration: float) -> Drive:
    """Draw a drive that can follow ``speed`` (m/s) and ``acceleration`` (m/s2); sizes over decades, shares as usual."""
    pitch = float(rng.choice([0.005, 0.01, 0.016, 0.02, 0.025, 0.04]))
    w, alpha = speed / pitch * 2 * math.pi, acceleration / pitch * 2 * math.pi
    emf, current = log_uniform(rng, 15.0, 250.0), log_uniform(rng, 3.0, 150.0)
    k = emf / w
    dry = rng.uniform(0.03, 0.20)  # of the accelerating torque
    viscous = dry * rng.uniform(0.3, 2.0)
    torque = k * current / (1 + dry + viscous)
    r = emf / current * log_uniform(rng, 0.1, 0.7)
    return Drive(
        R=r,
        L=r * log_uniform(rng, 0.003, 0.02),
        K=k,
        Jt=torque / alpha,
        ft=torque * viscous / w,
        Cd=torque * dry,
        pitch_m=pitch,
        position_gain=rng.uniform(20, 60),
        feedforward=float(rng.choice([1.0, 1.0, rng.uniform(0, 1)])),
        speed_hz=rng.uniform(20, 50),
        current_hz=rng.uniform(200, 450),
        current_limit=1.5 * current,
        voltage_limit=2.0 * (emf + r * current),
    )


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform between ``low`` and ``high``."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_move(rng: Rng) -> Move:
    """Draw a rapid that stays at full speed for 150 to 600 ms."""
    speed, acceleration = log_uniform(rng, 0.15, 1.0), rng.uniform(1.5, 8.0)
    smoothing = float(rng.choice([0.005, 0.01, 0.02, 0.04, 0.06]))
    distance = speed * (speed / acceleration + rng.uniform(0.15, 0.6) + 2 * smoothing)
    return Move(distance, speed, acceleration, smoothing, int(rng.choice([1, -1])))


def compute_path_speeds(move: Move, rate_of: Callable[[Array], Array] | None = None) -> Array:
    """Return the path speed (m/s, 1 ms rows) of a move, smoothed twice; ``rate_of`` maps time to the override."""
    ramp = min(move.speed / move.acceleration, math.sqrt(move.distance / move.acceleration))
    top = ramp * move.acceleration
    duration = move.distance / top + ramp
    t = np.arange(0.0, duration + CYCLE_S, CYCLE_S)
    if rate_of is not None:  # the path's own time runs slower
        t = np.arange(0.0, 4 * duration, CYCLE_S)
        rate = np.clip(rate_of(t), 0.0, 1.0)
        path = np.concatenate([[0.0], np.cumsum(rate)[:-1]]) * CYCLE_S
        shape = np.clip(np.minimum(path, duration - path) * move.acceleration, 0, top) * rate
    else:
        shape = np.clip(np.minimum(t, duration - t) * move.acceleration, 0, top)
    return smooth_moving_average(
        np.concatenate([shape, np.zeros(round(2.5 * move.smoothing / CYCLE_S))]), move.smoothing
    )


def smooth_moving_average(shape: Array, seconds: float) -> Array:
    """Return ``shape`` after two causal moving averages, of ``seconds`` and half of that (an NC's jerk limit)."""
    for part in (seconds, seconds / 2):
        width = max(1, round(part / CYCLE_S))
        shape = np.convolve(shape, np.ones(width) / width)[: shape.size]
    return shape


def demand_of(parts: list[Array]) -> Array:
    """Return the demand (m) of path speeds in sequence."""
    return np.concatenate([[0.0], np.cumsum(np.concatenate(parts)) * CYCLE_S])


def make_standstill(seconds: float) -> Array:
    """Return path speeds of standstill."""
    return np.zeros(round(seconds / CYCLE_S))


def _friction_plain(p: Array, w: float) -> float:
    return float(p[5] + p[15] * np.exp(-((w / p[16]) ** 2)))


_friction: Callable[[Array, float], float] = njit(cache=True, nogil=True)(_friction_plain)


def _pi_plain(gain: float, rate: float, limit: float, total: float, e: float) -> tuple[float, float]:
    candidate = total + rate * e
    raw = gain * e + candidate
    out = min(max(raw, -limit), limit)
    return out, candidate if raw == out else total


_pi: Callable[[float, float, float, float, float], tuple[float, float]] = njit(cache=True, nogil=True)(_pi_plain)


def _step_plain(p: Array, i: float, w: float, u: float, side: float, load: float, share: float) -> tuple[float, float]:
    """Advance current and speed of the part ``share`` of the inertia by Heun's rule; a reversal stops at 0."""
    h = STEP_S
    drag = share * _friction(p, w) * side + load
    di = (u - p[0] * i - p[2] * w) / p[1]
    dw = (p[2] * i - share * p[4] * w - drag) / (share * p[3])
    i1, w1 = i + h * di, w + h * dw
    di1 = (u - p[0] * i1 - p[2] * w1) / p[1]
    dw1 = (p[2] * i1 - share * p[4] * w1 - drag) / (share * p[3])
    w2 = w + h / 2 * (dw + dw1)
    if w2 * side < 0.0:
        w2 = 0.0
    return i + h / 2 * (di + di1), w2


_step: Callable[..., tuple[float, float]] = njit(cache=True, nogil=True)(_step_plain)


def _run_plain(p: Array, r: Array, load: Array, every: int) -> tuple[Array, ...]:
    n = r.size
    rows = n * CYCLE_STEPS // every
    out = np.zeros((5, rows))
    h, to_m = STEP_S, p[6]
    i, w, theta = 0.0, 0.0, r[0] / to_m
    table, v, contact = theta, 0.0, 1.0  # the table rests on the flank that a positive move drives
    theta += p[17] / 2
    sum_s, sum_c, i_demand = 0.0, 0.0, 0.0
    whole = p[17] == 0.0
    for step in range(rows * every):  # no row is begun that would not be whole
        k = step // CYCLE_STEPS
        s = (step % CYCLE_STEPS) / CYCLE_STEPS
        if step % SPEED_STEPS == 0:
            now, then, after = r[k], r[min(k + 1, n - 1)], r[min(k + 2, n - 1)]
            rate = p[8] * ((then - now) * (1 - s) + (after - then) * s) / CYCLE_S
            e = (p[7] * (now + (then - now) * s - table * to_m) + rate) / to_m - w
            i_demand, sum_s = _pi(p[9], p[10] * SPEED_STEPS * h, p[11], sum_s, e)
        u, sum_c = _pi(p[12], p[13] * h, p[14], sum_c, i_demand - i)
        if step % every == 0:
            row = step // every
            out[1, row], out[2, row], out[3, row], out[4, row] = u, i, w, table * to_m
        out[0, step // every] += u / every
        share = 1.0 if contact != 0.0 else p[18]
        pull = load[k] if contact != 0.0 else 0.0
        torque = p[2] * i - pull
        if w == 0.0 and abs(torque) <= share * _friction(p, 0.0):
            i += h * (u - p[0] * i) / p[1] * (1 - h * p[0] / (2 * p[1]))
            w_new = 0.0
        else:
            side = np.sign(w) if w != 0.0 else np.sign(torque)
            i, w_new = _step(p, i, w, u, side, pull, share)
        theta += h * (w + w_new) / 2
        if whole:
            w, table = w_new, theta
            continue
        rest_share = 1.0 - p[18]
        if contact != 0.0:
            force = rest_share * (p[3] * (w_new - w) / h + p[4] * w + p[5] * np.sign(w)) + pull
            table, v, w = theta - contact * p[17] / 2, w_new, w_new
            if force * contact < 0.0:
                contact = 0.0
            continue
        w = w_new
        slowed = v - h * (rest_share * (p[4] * v + p[5] * np.sign(v)) + load[k]) / (rest_share * p[3])
        slowed = 0.0 if slowed * v <= 0.0 else slowed
        table += h * (v + slowed) / 2
        v = slowed
        gap = theta - table
        if abs(gap) >= p[17] / 2:
            contact = np.sign(gap)
            w = v = p[18] * w + rest_share * v  # inelastic
            table = theta - contact * p[17] / 2
    return out[0], out[1], out[2], out[3], out[4]


_run: Callable[..., tuple[Array, ...]] = njit(cache=True, nogil=True)(_run_plain)


def simulate_loop(drive: Drive, demand: Array, dt_s: float, load: Array | None = None) -> Signals:
    """Simulate the closed loop; rows every ``dt_s`` (a multiple of 31.25 us); ``load`` (n,) N.m per 1 ms cycle."""
    torque = np.zeros(demand.size) if load is None else load
    mean_u, now_u, current, speed, position = _run(drive.vector(), demand, torque, round(dt_s / STEP_S))
    wanted = np.interp(np.arange(mean_u.size) * dt_s, np.arange(demand.size) * CYCLE_S, demand)
    return Signals(dt_s, mean_u, now_u, current, speed, position, wanted)


def reverse_move(move: Move) -> Move:
    """Return the way back."""
    return replace(move, direction=-move.direction)
