"""An independent DC motor: midpoint steps and Karnopp's friction, without code from fdhil."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Drive = Callable[[float, float, float], float]
"""Voltage (V) over the next sample, from time (s), current (A) and speed (rad/s)."""

TRUTH = {"R": 1.2, "L": 0.0031, "K": 0.24, "Jt": 9.0e-4, "ft": 1.1e-3, "Cd": 0.06}
SUBSTEPS = 25
STILL_RAD_S = 1e-3


@dataclass(frozen=True)
class MotorRecord:
    """Arrays (n,): time (s), mean voltage over each sample (V), current (A) and speed (rad/s) at its begin."""

    time: Floats
    voltage: Floats
    current: Floats
    speed: Floats


def run_motor(
    drive: Drive, seconds: float, dt: float = 1e-3, *, noise: float = 2e-3, locked: bool = False, seed: int = 1
) -> MotorRecord:
    """Run the motor, and measure it with white noise of ``noise`` times each signal's largest value."""
    p, h = TRUTH, dt / SUBSTEPS
    rows = round(seconds / dt)
    table = np.zeros((rows, 4))
    current = speed = 0.0
    for k in range(rows):
        u = drive(k * dt, current, speed)
        table[k] = k * dt, u, current, speed
        for _ in range(SUBSTEPS):
            slope = (u - p["R"] * current - p["K"] * speed) / p["L"]
            middle = current + h / 2 * slope
            current += h / p["L"] * (u - p["R"] * middle - p["K"] * speed)
            torque = p["K"] * middle
            if abs(speed) < STILL_RAD_S and abs(torque) <= p["Cd"]:
                speed = 0.0
            else:
                side = np.sign(speed) if abs(speed) >= STILL_RAD_S else np.sign(torque)
                after = speed + h / p["Jt"] * (torque - p["ft"] * speed - p["Cd"] * side)
                speed = 0.0 if after * speed < 0.0 and abs(torque) <= p["Cd"] else after
            speed = 0.0 if locked else speed
    scatter = np.random.default_rng(seed).normal(size=(rows, 3))
    table[:, 1:] += scatter * noise * np.maximum(np.abs(table[:, 1:]).max(axis=0), 1e-9)
    return MotorRecord(*table.T.copy())


def build_speed_loop(
    profile: Callable[[float], float], dt: float = 1e-3, gain: float = 0.9, rate: float = 12.0
) -> Drive:
    """Return a PI speed loop that follows ``profile`` (rad/s); it overshoots a step."""
    total = 0.0

    def compute_voltage(time_s: float, current: float, speed: float) -> float:
        nonlocal total
        error = profile(time_s) - speed
        total += error * dt
        return float(np.clip(gain * error + gain * rate * total, -48.0, 48.0))

    return compute_voltage


def build_trapezoidal_move(time_s: float) -> float:
    """Return a rapid move in both directions, rad/s."""

    def build_ramp(t: float) -> float:
        return float(np.clip(min(t, 0.8 - t) / 0.15, 0.0, 1.0)) * 120.0

    return build_ramp(time_s - 0.1) - build_ramp(time_s - 1.2)


def build_speed_steps(time_s: float) -> float:
    """Return steps of the speed in both directions, rad/s."""
    return (0.0, 60.0, 100.0, 30.0, -80.0, 0.0)[min(int(time_s / 0.3), 5)]


MOVES: dict[str, tuple[Drive, float]] = {
    "steps of voltage": (lambda t, _i, _w: (0.0, 12.0, 24.0, -18.0, 6.0, 0.0)[min(int(t / 0.3), 5)], 1.8),
    "chirp": (lambda t, _i, _w: 10.0 + 14.0 * np.sin(2 * np.pi * (0.5 + 6.0 * t) * t), 2.0),
    "ramp": (lambda t, _i, _w: 12.0 * t, 2.0),
    "back and forth": (lambda t, _i, _w: 24.0 * np.sin(2 * np.pi * 2.0 * t), 2.0),
}
