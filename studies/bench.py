"""A simulated bench for tests and studies: three nested regulators and the drive, stepped every 31.25 us.

It shares no numerics with the package it judges. The drive is integrated by the classical Runge-Kutta rule under a
held voltage; the regulators read at the start of their own cycle; a reversal stops at standstill for that step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]
STEP_S = 3.125e-5
SPEED_STEPS = 8
CYCLE_STEPS = 32
INCREMENT = 1.0 / 65536


@dataclass(frozen=True)
class Plant:
    """True parameters of the drive, and what the model does not have."""

    R: float = 0.5
    L: float = 0.005
    K: float = 0.8
    Jt: float = 0.075
    ft: float = 0.05
    Cd: float = 5.0
    stribeck: float = 0.0
    stribeck_speed: float = 8.0

    def vector(self) -> Array:
        """Return the kernel's argument."""
        return np.array(
            [self.R, self.L, self.K, self.Jt, self.ft, self.Cd, self.stribeck, self.stribeck_speed], dtype=np.float64
        )

    def truth(self) -> dict[str, float]:
        """Return the six parameters by symbol."""
        return {name: getattr(self, name) for name in ("R", "L", "K", "Jt", "ft", "Cd")}


@dataclass(frozen=True)
class Signals:
    """What was recorded, noise free: rows ``dt_s`` apart, SI units; voltage as interval means."""

    dt_s: float
    voltage: Array
    voltage_instant: Array
    current: Array
    speed: Array
    position: Array
    demand: Array
    load: Array = field(default_factory=lambda: np.zeros(0))


def _friction_plain(p: Array, w: float) -> float:
    return float(p[5] + p[6] * np.exp(-((w / p[7]) ** 2)))


_friction: Callable[[Array, float], float] = njit(cache=True, nogil=True)(_friction_plain)


def _slope_plain(p: Array, i: float, w: float, u: float, side: float, load: float) -> tuple[float, float]:
    di = (u - p[0] * i - p[2] * w) / p[1]
    dw = (p[2] * i - p[4] * w - _friction(p, w) * side - load) / p[3]
    return di, dw


_slope: Callable[..., tuple[float, float]] = njit(cache=True, nogil=True)(_slope_plain)


def _run_plain(p: Array, pitch: float, r: Array, load: Array, every: int) -> tuple[Array, ...]:
    """Simulate the cycles of reference ``r`` (m); outputs every ``every`` steps."""
    n = r.size
    rows = n * CYCLE_STEPS // every
    mean_u = np.zeros(rows)
    now_u = np.zeros(rows)
    out_i = np.zeros(rows)
    out_w = np.zeros(rows)
    out_x = np.zeros(rows)
    kp_s, kp_c = 2 * np.pi * 40 * 0.075 / 0.8, 2 * np.pi * 400 * 0.005
    ki_s, ki_c = kp_s * 2 * np.pi * 40 / 5, 2 * np.pi * 400 * 0.5
    h = STEP_S
    cycle = CYCLE_STEPS * h
    to_m = pitch / (2 * np.pi)
    i, w, theta = 0.0, 0.0, r[0] / to_m
    sum_s, sum_c, i_demand = 0.0, 0.0, 0.0
    for step in range(n * CYCLE_STEPS):
        k = step // CYCLE_STEPS
        now = r[k]
        then = r[min(k + 1, n - 1)]
        after = r[min(k + 2, n - 1)]
        if step % SPEED_STEPS == 0:
            s = (step % CYCLE_STEPS) / CYCLE_STEPS
            rate = (then - now) / cycle * (1 - s) + (after - then) / cycle * s
            e = (50.0 * (now + (then - now) * s - theta * to_m) + rate) / to_m - w
            candidate = sum_s + ki_s * SPEED_STEPS * h * e
            raw = kp_s * e + candidate
            i_demand = min(max(raw, -200.0), 200.0)
            if raw == i_demand:
                sum_s = candidate
        e = i_demand - i
        candidate = sum_c + ki_c * h * e
        raw = kp_c * e + candidate
        u = min(max(raw, -300.0), 300.0)
        if raw == u:
            sum_c = candidate
        if step % every == 0:
            row = step // every
            now_u[row], out_i[row], out_w[row], out_x[row] = u, i, w, theta * to_m
        mean_u[step // every] += u / every
        torque = p[2] * i - load[k]
        if w == 0.0 and abs(torque) <= _friction(p, 0.0):
            i += h * (u - p[0] * i) / p[1] * (1 - h * p[0] / (2 * p[1]))
            continue
        side = np.sign(w) if w != 0.0 else np.sign(torque)
        a1, b1 = _slope(p, i, w, u, side, load[k])
        a2, b2 = _slope(p, i + h / 2 * a1, w + h / 2 * b1, u, side, load[k])
        a3, b3 = _slope(p, i + h / 2 * a2, w + h / 2 * b2, u, side, load[k])
        a4, b4 = _slope(p, i + h * a3, w + h * b3, u, side, load[k])
        i += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        w_new = w + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
        if w_new * side < 0.0:
            w_new = 0.0
        theta += h * (w + w_new) / 2
        w = w_new
    return mean_u, now_u, out_i, out_w, out_x


_run: Callable[..., tuple[Array, ...]] = njit(cache=True, nogil=True)(_run_plain)


def make_shuttle_demand(
    distance: float = 0.4,
    speed: float = 0.5,
    acceleration: float = 4.0,
    moves: int = 1,
    rest: float = 0.15,
    lead: float = 0.055,
    smoothing: float = 0.02,
    first: int = 1,
) -> Array:
    """Return the demand (m, 1 ms rows) of ``moves`` rapids back and forth, trapezoids of speed smoothed once."""
    dt = CYCLE_STEPS * STEP_S
    ramp = min(speed / acceleration, np.sqrt(distance / acceleration))
    top = ramp * acceleration
    duration = distance / top + ramp
    t = np.arange(0, duration + rest + smoothing, dt)
    rate = np.clip(np.minimum(t, duration - t) * acceleration, 0, top)
    one = np.concatenate([np.zeros(round(lead / dt)), rate])
    rates = np.concatenate([one * first * (-1) ** k for k in range(moves)] + [np.zeros(round(rest / dt))])
    width = max(1, round(smoothing / dt))
    rates = np.convolve(rates, np.ones(width) / width)[: rates.size]
    return np.concatenate([[0.0], np.cumsum(rates) * dt])


def simulate_bench(
    plant: Plant,
    demand: Array,
    pitch: float = 0.02,
    load: Array | None = None,
    dt_s: float = 1e-3,
    quantised: bool = False,
) -> Signals:
    """Simulate the closed loop; rows every ``dt_s`` (a multiple of 31.25 us); ``load`` (n,) N.m per cycle.

    ``quantised`` set-points, as a bus carries them, make the speed feed-forward and so the voltage rough.
    """
    if quantised:
        demand = np.round(demand / pitch / INCREMENT) * INCREMENT * pitch
    load = np.zeros(demand.size) if load is None else load
    every = round(dt_s / STEP_S)
    mean_u, now_u, current, speed, position = _run(plant.vector(), pitch, demand, load, every)
    grid = np.arange(mean_u.size) * dt_s
    wanted = np.interp(grid, np.arange(demand.size) * CYCLE_STEPS * STEP_S, demand)
    return Signals(dt_s, mean_u, now_u, current, speed, position, wanted, load)


def format_as_csv(signals: Signals, noise: float = 0.005, seed: int = 0, **headers: str) -> str:
    """Return the run as a recording's text with white noise of ``noise`` on 60 V, 50 A, 150 rad/s; 1 um positions."""
    rng = np.random.default_rng(seed)
    n = signals.speed.size
    columns = {
        "voltage_V": signals.voltage + noise * 60 * rng.standard_normal(n),
        "current_A": signals.current + noise * 50 * rng.standard_normal(n),
        "speed_rad_per_s": signals.speed + noise * 150 * rng.standard_normal(n),
        "position_m": signals.position,
        "demand_m": signals.demand,
    }
    return format_table(signals.dt_s, columns, **headers)


def format_table(dt_s: float, columns: dict[str, Array], **headers: str) -> str:
    """Return a recording's text from its columns; ``headers`` replace the usual ones."""
    known = {
        "format": "fdhil-recording-1",
        "sample_rate_hz": f"{1 / dt_s:g}",
        "voltage_sampling": "interval_mean",
        "axis": "X",
        "pitch_m_per_rev": "0.02",
        "rapid_speed_m_per_s": "0.5",
    }
    lines = [f"# {key}: {value}" for key, value in (known | headers).items()]
    lines.append(",".join(["time_s", *columns]))
    digits = {"voltage_V": 4, "current_A": 4, "speed_rad_per_s": 5}
    values = zip(*columns.values(), strict=True)
    for k, row in enumerate(values):
        cells = [f"{v:.{digits.get(name, 6)}f}" for name, v in zip(columns, row, strict=True)]
        lines.append(",".join([f"{k * dt_s:.6f}", *cells]))
    return "\n".join(lines) + "\n"
