"""A feed axis written from the words of practice: field-oriented drive, two masses, bristle friction, machine bed.

It shares nothing with the package it judges, nor with the other studies. Angles and torques are those of the motor
shaft. The drive runs its loops at its own rates on quantised positions; the mechanics take trapezoidal steps of
15.625 us, and the bristle (LuGre, 1995) its exact step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
STEP_S = 1.5625e-5


class Plant(NamedTuple):
    """Motor, screw, table, slide-way and bed; SI units at the motor shaft."""

    R: float
    L: float
    K: float
    Jt: float
    ft: float
    Cd: float
    pitch_m: float = 0.01
    pole_pairs: float = 4.0
    table_share: float = 0.5
    resonance_hz: float = 250.0
    damping: float = 0.03
    backlash_rad: float = 0.0
    static: float = 0.0  # friction at rest above Cd, share of it
    static_speed: float = 5.0
    asymmetry: float = 0.0  # share of Cd by which the positive direction has more
    bristle_um: float = 2.0
    gravity_nm: float = 0.0
    ripple: float = 0.0  # share of Cd, once per turn
    cogging_nm: float = 0.0
    cogging_order: float = 24.0
    warming: float = 0.0  # share by which R rises during a recording
    bed_hz: float = 0.0
    bed_ratio: float = 10.0  # inertia of the bed over that of the table
    bed_damping: float = 0.05

    def truth(self) -> dict[str, float]:
        """Return the six parameters by symbol."""
        return {name: float(getattr(self, name)) for name in ("R", "L", "K", "Jt", "ft", "Cd")}


class Drive(NamedTuple):
    """The regulators as they are; ``structure`` 0 is a cascade, 1 a PID on position, gains as in its parameter list."""

    position_gain: float
    speed_kp: float
    speed_ki: float
    current_kp: float
    current_ki: float
    current_limit: float
    voltage_limit: float
    structure: float = 0.0
    position_ki: float = 0.0
    feedforward: float = 1.0
    inertia_feedforward: float = 0.0
    stepping: float = 0.0  # 1: the drive differentiates its own linearly interpolated set-point
    speed_steps: float = 8.0  # of 15.625 us
    current_steps: float = 4.0
    speed_filter_s: float = 0.0
    torque_filter_s: float = 0.0
    decoupling: float = 0.9  # share of the voltage across the axes d and q that the drive feeds forward
    late_voltage: float = 0.0  # 1: a voltage acts one current cycle after its current was sampled
    dead_time_v: float = 0.0
    dead_time_a: float = 0.3
    brushed: float = 0.0
    sag: float = 0.0  # share by which the bus falls at rated power, the drive not compensating
    power_w: float = 3e3
    encoder_counts: float = 2.0**20


class Motion(NamedTuple):
    """What truly happened, a sample per SYNC: rad, rad/s, A, V; voltage as asked for and at the terminals."""

    motor: Array
    table: Array
    speed: Array  # as the drive estimates it
    current: Array
    current_mean: Array
    asked: Array
    asked_mean: Array
    terminal_mean: Array


def _run_plain(p: Plant, d: Drive, r: Array, period_s: float, settle: int) -> Array:
    h = STEP_S
    steps = round(period_s / h)
    n = r.size
    out = np.zeros((8, n))
    turn = 2 * math.pi / d.encoder_counts
    table, motor = p.Jt * p.table_share, p.Jt * (1.0 - p.table_share)
    whole = 2 * math.pi * p.resonance_hz
    stiff = whole * whole * motor * table / p.Jt
    damper = 2 * p.damping * whole * motor * table / p.Jt
    sigma0 = p.Cd / (p.bristle_um * 1e-6 / p.pitch_m * 2 * math.pi)
    sigma1 = 0.5 * math.sqrt(sigma0 * p.Jt)
    bed = table * p.bed_ratio
    bed_k = (2 * math.pi * p.bed_hz) ** 2 * bed
    bed_c = 2 * p.bed_damping * 2 * math.pi * p.bed_hz * bed
    speed_steps, current_steps = int(d.speed_steps), int(d.current_steps)
    hs, hc = speed_steps * h, current_steps * h
    tm = tt = r[0]
    wm = wt = z = bristle_torque = 0.0
    yb = vb = 0.0
    iq = idd = 0.0
    sum_s = p.gravity_nm / p.K  # it stood for long: the regulators carry the weight
    sum_q = p.R * sum_s
    iq = sum_s
    tm = tt + p.gravity_nm / stiff + math.copysign(p.backlash_rad / 2, p.gravity_nm if p.gravity_nm else 1.0)
    place_sum = sum_s / d.speed_kp
    sum_d = 0.0
    last = math.floor(tm / turn + 0.5) * turn
    w_seen = 0.0
    asked_i = held_i = sum_s
    uq = ud = next_q = sum_q
    ud = next_d = 0.0
    bus = 1.0
    offset = tm - r[0]
    for step in range(-settle * steps, n * steps):
        k = max(step, 0) // steps
        s = (step % steps) / steps if step >= 0 else 0.0
        now, then = r[k], r[min(k + 1, n - 1)]
        after = r[min(k + 2, n - 1)]
        if step < 0:
            then = after = now
        if step % speed_steps == 0:
            seen = math.floor(tm / turn + 0.5) * turn
            raw = (seen - last) / hs
            last = seen
            share = 1.0 if d.speed_filter_s <= 0.0 else 1.0 - math.exp(-hs / d.speed_filter_s)
            w_seen += share * (raw - w_seen)
            v0, v1 = (then - now) / period_s, (after - then) / period_s
            rate = v0 if d.stepping > 0.0 else v0 + s * (v1 - v0)
            e = now + s * (then - now) - (seen - offset)
            push = d.inertia_feedforward * (v1 - v0) / period_s * p.Jt / p.K
            if d.structure == 0.0:
                ew = d.position_gain * e + d.feedforward * rate - w_seen
                candidate = sum_s + d.speed_ki * hs * ew
                wanted = d.speed_kp * ew + candidate + push
            else:
                candidate = place_sum + d.position_ki * hs * e
                wanted = d.speed_kp * (d.position_gain * e + d.feedforward * rate - w_seen + candidate) + push
            limited = min(max(wanted, -d.current_limit), d.current_limit)
            if limited == wanted:
                if d.structure == 0.0:
                    sum_s = candidate
                else:
                    place_sum = candidate
            asked_i = limited
            share = 1.0 if d.torque_filter_s <= 0.0 else 1.0 - math.exp(-hs / d.torque_filter_s)
            held_i += share * (asked_i - held_i)
        if step % current_steps == 0:
            if d.late_voltage > 0.0:
                uq, ud = next_q, next_d
            eq, ed = held_i - iq, -idd
            trial_q, trial_d = sum_q + d.current_ki * hc * eq, sum_d + d.current_ki * hc * ed
            across = 0.0 if d.brushed > 0.0 else d.decoupling * p.pole_pairs * w_seen * p.L
            raw_q = d.current_kp * eq + trial_q + across * idd
            raw_d = d.current_kp * ed + trial_d - across * held_i
            next_q = min(max(raw_q, -d.voltage_limit), d.voltage_limit)
            next_d = min(max(raw_d, -d.voltage_limit), d.voltage_limit)
            if next_q == raw_q:
                sum_q = trial_q
            if next_d == raw_d:
                sum_d = trial_d
            if d.late_voltage == 0.0:
                uq, ud = next_q, next_d
        bus += h / 2e-3 * (1.0 - d.sag * max(0.0, uq * iq) / d.power_w - bus)
        lost_q = lost_d = 0.0
        if d.dead_time_v > 0.0:
            if d.brushed > 0.0:
                lost_q = d.dead_time_v * min(max(iq / d.dead_time_a, -1.0), 1.0)
            else:
                for phase in range(3):
                    angle = p.pole_pairs * tm - phase * 2 * math.pi / 3
                    c, si = math.cos(angle), math.sin(angle)
                    one = math.sqrt(2.0 / 3.0) * (idd * c - iq * si)
                    fall = d.dead_time_v * min(max(one / d.dead_time_a, -1.0), 1.0)
                    lost_q -= math.sqrt(2.0 / 3.0) * si * fall
                    lost_d += math.sqrt(2.0 / 3.0) * c * fall
        tq, td = uq * bus - lost_q, ud * bus - lost_d
        if step >= 0:
            if step % steps == 0:
                out[0, k], out[1, k] = last - offset, tt
                out[2, k], out[3, k], out[5, k] = w_seen, iq, uq
            out[4, k] += iq / steps
            out[6, k] += uq / steps
            out[7, k] += tq / steps
        warm = p.R * (1.0 + p.warming * max(step, 0) / (n * steps))
        fade = math.exp(-warm * h / p.L)
        cross = 0.0 if d.brushed > 0.0 else p.pole_pairs * wm * p.L
        new_q = (tq - p.K * wm - cross * idd) / warm * (1.0 - fade) + iq * fade
        new_d = (td + cross * iq) / warm * (1.0 - fade) + idd * fade
        mean_i, iq, idd = (iq + new_q) / 2, new_q, new_d
        gap, slip = tm - tt, wm - wt
        spring = stiff * gap + damper * slip
        if p.backlash_rad > 0.0:
            half = p.backlash_rad / 2
            spring = 0.0
            if gap > half:
                spring = max(0.0, stiff * (gap - half) + damper * slip)
            elif gap < -half:
                spring = min(0.0, stiff * (gap + half) + damper * slip)
        side = 1.0 if wt > 0.0 else -1.0
        dry = p.Cd * (1.0 + side * p.asymmetry + p.ripple * math.sin(tt))
        slow = math.exp(-((wt / p.static_speed) ** 2))
        top = dry + p.Cd * p.static * slow
        full = top * side / sigma0
        z_new = full + (z - full) * math.exp(-h * sigma0 * abs(wt) / top)
        bristle_torque = sigma0 * z_new + sigma1 * slow * (z_new - z) / h
        z = z_new
        slide = bristle_torque + 0.5 * p.ft * wt
        cog = p.cogging_nm * math.sin(p.cogging_order * tm)
        am = (p.K * mean_i - spring - 0.5 * p.ft * wm - cog) / motor
        force = spring - slide - p.gravity_nm
        ab = 0.0
        if p.bed_hz > 0.0:
            ab = (-(spring - slide) - bed_k * yb - bed_c * vb) / bed
            yb += h * (vb + h * ab / 2)
            vb += h * ab
        at = force / table - ab
        wm_new, wt_new = wm + h * am, wt + h * at
        tm += h * (wm + wm_new) / 2
        tt += h * (wt + wt_new) / 2
        wm, wt = wm_new, wt_new
    return out


_run: Callable[..., Any] = njit(cache=True, nogil=True)(_run_plain)
SETTLE_CYCLES = 200


def run(plant: Plant, drive: Drive, setpoint_m: Array, period_s: float) -> Motion:
    """Move an axis that stands for long along its set-points (m), one per SYNC."""
    r = np.ascontiguousarray(setpoint_m / plant.pitch_m * 2 * math.pi)
    return Motion(*_run(plant, drive, r, period_s, SETTLE_CYCLES))
