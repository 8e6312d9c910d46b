"""Simulates an axis as real machines have it: friction, loads, ripples, compliance, inverter, encoder and loops.

It shares no numerics with the package it judges: every 31.25 us the regulators act as in a drive, and between them the
mechanics, one mass or two, take Runge-Kutta steps with friction that sticks. Every effect is off by default.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from fdhil.records import Recording, VoltageSampling, freeze_array
from studies.bench import Array, format_table

STEP_S = 3.125e-5
SPEED_STEPS = 8
CYCLE_STEPS = 32
CYCLE_S = STEP_S * CYCLE_STEPS
MOST_DELAY = 64


@dataclass(frozen=True, slots=True)
class Mechanics:
    """The motor and what it moves, SI units; shares are of ``Cd``, or of the inertia.

    ``static`` of Cd comes on top below ``static_speed_rad_s`` (exp(-(w/ws)^2); negative: it builds up with speed).
    Friction is ``asymmetry`` of Cd larger in the positive direction, and as much smaller in the other. Of the inertia
    ``table_share`` hangs behind a spring with ``resonance_hz`` (0: stiff), and the dry friction acts there.
    """

    R: float = 0.5
    L: float = 0.005
    K: float = 0.8
    Jt: float = 0.075
    ft: float = 0.05
    Cd: float = 5.0
    pitch_m: float = 0.02
    static: float = 0.0
    static_speed_rad_s: float = 10.0
    asymmetry: float = 0.0
    load_nm: float = 0.0
    screw_ripple: float = 0.0
    screw_phase: float = 0.0
    motor_ripple_nm: float = 0.0
    motor_order: int = 24
    motor_phase: float = 0.0
    resonance_hz: float = 0.0
    damping: float = 0.02
    table_share: float = 0.6
    warming: float = 0.0  # relative rise of R over the run

    def truth(self) -> dict[str, float]:
        """Return the six parameters by symbol."""
        return {name: getattr(self, name) for name in ("R", "L", "K", "Jt", "ft", "Cd")}


@dataclass(frozen=True, slots=True)
class Loops:
    """The drive's regulators as they really are; gains as in a machine's ``[axis.X.regulators]``."""

    position_gain_per_s: float = 50.0
    speed_feedforward: float = 1.0
    speed_kp: float = 23.562
    speed_ki: float = 1184.35
    current_kp: float = 12.566
    current_ki: float = 1256.64
    current_limit_a: float = 200.0
    voltage_limit_v: float = 300.0
    speed_filter_s: float = 0.0
    delay_s: float = 0.0  # until a computed voltage acts
    table_scale: bool = False  # the position loop reads the table, not the motor
    dead_time_v: float = 0.0
    dead_time_a: float = 0.5  # current at which the dead time has its whole effect
    bus_sag: float = 0.0  # share by which the bus falls at ``peak_power_w``
    peak_power_w: float = 10e3


@dataclass(frozen=True, slots=True)
class Sensors:
    """How the drive reports: noise as a share of 60 V, 50 A, 150 rad/s, gains, what speed and voltage are.

    ``speed`` is "sensor", "difference" (of encoder positions over a row) or "middle" (the same, stamped half a row
    earlier); ``encoder_bits`` per turn. A first-order filter of ``filter_s`` follows. ``command`` records the voltage
    that the drive asked for.
    """

    noise: float = 0.003
    speed: str = "sensor"
    encoder_bits: int = 20
    filter_s: float = 0.0
    command: bool = False
    current_gain: float = 0.0
    voltage_gain: float = 0.0
    sampling: VoltageSampling = "interval_mean"


@dataclass(frozen=True, slots=True)
class Run:
    """What truly happened, rows ``dt_s`` apart, SI units: voltages are means over the row, the rest instants."""

    dt_s: float
    demand: Array
    motor_m: Array
    table_m: Array
    speed: Array
    current: Array
    voltage: Array
    command: Array
    bus: Array  # relative bus voltage, mean
    standstill_a: float = field(default=0.0)


GOOD_MECHANICS = Mechanics(
    static=0.1, asymmetry=0.03, screw_ripple=0.03, motor_ripple_nm=0.005 * 40, resonance_hz=200.0
)
GOOD_LOOPS = Loops(dead_time_v=0.5)
GOOD_SENSORS = Sensors(speed="difference", command=True, current_gain=0.005)
ORDINARY_MECHANICS = Mechanics(
    static=0.2, asymmetry=0.05, screw_ripple=0.05, motor_ripple_nm=0.01 * 40, resonance_hz=120.0, load_nm=2.5
)
ORDINARY_LOOPS = Loops(dead_time_v=2.0, bus_sag=0.03)
ORDINARY_SENSORS = Sensors(speed="difference", command=True, current_gain=0.01)
# the paper's own magnitudes, where friction rules; a gentler axis at 65 rad/s with the bench's pitch
SLOW = Mechanics(R=0.35, L=0.003, K=0.55, Jt=0.02, ft=1.05e-3, Cd=2.2)
SLOW_LOOPS = Loops(
    speed_kp=2 * np.pi * 40 * 0.02 / 0.55,
    speed_ki=2 * np.pi * 40 * 0.02 / 0.55 * 2 * np.pi * 40 / 5,
    current_kp=2 * np.pi * 400 * 0.003,
    current_ki=2 * np.pi * 400 * 0.35,
)
RATED_NM = (11.0, 40.0)  # of the slow axis and of the bench's
# as the public record of a ball-screw axis: a P-P cascade without feed-forward, current and position at 1 kHz
SCREW = Mechanics(static=-0.2, static_speed_rad_s=20.0, asymmetry=0.15, load_nm=0.6)


def _friction_plain(m: Array, w: float, side: float) -> float:
    """Return the dry friction (N.m, positive) of a mass that moves, or is about to move, to ``side``."""
    return float(m[5] * (1.0 + side * m[8] + m[6] * np.exp(-((w / m[7]) ** 2))))


_friction: Callable[..., float] = njit(cache=True, nogil=True)(_friction_plain)


def _slopes_plain(m: Array, x: Array, u: float, side: float, out: Array) -> None:
    """Fill ``out`` (5,) with the slopes of ``x`` (5,) = current, motor speed and angle, table speed and angle."""
    stiff = m[14] == 0.0
    i, w, angle, wt, at = x
    spring = 0.0 if stiff else m[14] * (angle - at) + m[15] * (w - wt)
    ripple = m[5] * m[10] * np.sin(angle + m[11]) + m[12] * np.sin(m[17] * angle + m[13])
    out[0] = (u - m[0] * i - m[2] * w) / m[1]
    motor = m[2] * i - m[4] * w - ripple
    if stiff:
        out[1] = 0.0 if side == 0.0 else (motor - m[9] - side * _friction(m, w, side)) / m[3]
        out[3] = out[1]
    else:
        out[1] = (motor - spring) / (m[3] * (1.0 - m[16]))
        out[3] = 0.0 if side == 0.0 else (spring - m[9] - side * _friction(m, wt, side)) / (m[3] * m[16])
    out[2], out[4] = w, wt


_slopes: Callable[..., None] = njit(cache=True, nogil=True)(_slopes_plain)


def _side_plain(m: Array, x: Array) -> float:
    """Return where the mass with the friction moves or is about to move; 0 where it sticks."""
    stiff = m[14] == 0.0
    w = x[1] if stiff else x[3]
    if w != 0.0:
        return float(np.sign(w))
    if stiff:
        ripple = m[5] * m[10] * np.sin(x[2] + m[11]) + m[12] * np.sin(m[17] * x[2] + m[13])
        push = m[2] * x[0] - ripple - m[9]
    else:
        push = m[14] * (x[2] - x[4]) + m[15] * x[1] - m[9]
    side = float(np.sign(push))
    return side if abs(push) > _friction(m, 0.0, side) else 0.0


_side: Callable[..., float] = njit(cache=True, nogil=True)(_side_plain)


def _run_plain(m: Array, g: Array, r: Array, start: Array, every: int, warming: float) -> tuple[Array, Array]:
    """Simulate the cycles of reference ``r`` (m) from ``start`` (7,); return rows (8, n) and the end state (7,)."""
    cycles = r.size
    rows = np.zeros((8, cycles * CYCLE_STEPS // every))
    x, sums = start[:5].copy(), start[5:].copy()
    to_m = m[18]
    h, cycle = STEP_S, CYCLE_STEPS * STEP_S
    i_demand, filtered = 0.0, x[1]
    late = np.zeros(MOST_DELAY)
    delay = round(g[8] / h)
    k1, k2, k3, k4, trial = np.zeros(5), np.zeros(5), np.zeros(5), np.zeros(5), np.zeros(5)
    r0 = m[0]
    late[:] = sums[1]
    for step in range(cycles * CYCLE_STEPS):
        k = step // CYCLE_STEPS
        m[0] = r0 * (1.0 + warming * step / (cycles * CYCLE_STEPS))
        now, then, after = r[k], r[min(k + 1, cycles - 1)], r[min(k + 2, cycles - 1)]
        if step % SPEED_STEPS == 0:
            s = (step % CYCLE_STEPS) / CYCLE_STEPS
            rate = (then - now) / cycle * (1 - s) + (after - then) / cycle * s
            if g[7] > 0.0:
                filtered += (1.0 - np.exp(-SPEED_STEPS * h / g[7])) * (x[1] - filtered)
            else:
                filtered = x[1]
            seen = x[4] if g[9] > 0.0 else x[2]
            e = (g[0] * (now + (then - now) * s - seen * to_m) + g[1] * rate) / to_m - filtered
            candidate = sums[0] + g[3] * SPEED_STEPS * h * e
            raw = g[2] * e + candidate
            i_demand = min(max(raw, -g[6]), g[6])
            if raw == i_demand:
                sums[0] = candidate
        e = i_demand - x[0]
        candidate = sums[1] + g[5] * h * e
        raw = g[4] * e + candidate
        bus = 1.0 - g[13] * max(0.0, late[0] * x[0]) / g[14]
        asked = min(max(raw, -g[10]), g[10])
        if raw == asked:
            sums[1] = candidate
        if delay > 0:
            acting = late[0]
            late[: delay - 1] = late[1:delay]
            late[delay - 1] = asked
        else:
            acting = asked
            late[0] = asked
        u = acting * bus - g[11] * min(max(x[0] / g[12], -1.0), 1.0)
        row = step // every
        if step % every == 0:
            rows[0, row], rows[1, row] = x[0], x[1]
            rows[2, row], rows[3, row] = x[2] * to_m, x[4] * to_m
            rows[7, row] = i_demand
        rows[4, row] += u / every
        rows[5, row] += asked / every
        rows[6, row] += bus / every
        side = _side(m, x)
        friction_mass = 1 if m[14] == 0.0 else 3
        if side == 0.0:
            x[friction_mass] = 0.0
        _slopes(m, x, u, side, k1)
        trial[:] = x + h / 2 * k1
        _slopes(m, trial, u, side, k2)
        trial[:] = x + h / 2 * k2
        _slopes(m, trial, u, side, k3)
        trial[:] = x + h * k3
        _slopes(m, trial, u, side, k4)
        x += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if x[friction_mass] * side < 0.0:
            x[friction_mass] = 0.0
        if m[14] == 0.0:
            x[3], x[4] = x[1], x[2]
    m[0] = r0
    return rows, np.concatenate((x, sums))


_run: Callable[..., tuple[Array, Array]] = njit(cache=True, nogil=True)(_run_plain)


def _pack_parameters(mechanics: Mechanics, loops: Loops) -> tuple[Array, Array]:
    m, g = mechanics, loops
    stiffness = damper = 0.0
    if m.resonance_hz:
        motor, table = m.Jt * (1 - m.table_share), m.Jt * m.table_share
        whole = 2 * np.pi * m.resonance_hz  # of both masses against each other, the motor free
        stiffness = whole**2 * motor * table / (motor + table)
        damper = 2 * m.damping * whole * motor * table / (motor + table)
    mechanical = [m.R, m.L, m.K, m.Jt, m.ft, m.Cd, m.static, m.static_speed_rad_s, m.asymmetry, m.load_nm]
    mechanical += [m.screw_ripple, m.screw_phase, m.motor_ripple_nm, m.motor_phase, stiffness, damper, m.table_share]
    mechanical += [float(m.motor_order), m.pitch_m / (2 * np.pi)]
    drive = [g.position_gain_per_s, g.speed_feedforward, g.speed_kp, g.speed_ki, g.current_kp, g.current_ki]
    drive += [g.current_limit_a, g.speed_filter_s, g.delay_s, float(g.table_scale), g.voltage_limit_v]
    drive += [g.dead_time_v, g.dead_time_a, g.bus_sag, g.peak_power_w]
    return np.array(mechanical), np.array(drive)


def compute_rest_state(mechanics: Mechanics, loops: Loops, position_m: float) -> Array:
    """Return the state (7,) of an axis at standstill: its regulators hold the load that friction does not."""
    mechanical, drive = _pack_parameters(mechanics, loops)
    angle = position_m / mechanics.pitch_m * 2 * np.pi
    start = np.array([0.0, 0.0, angle, 0.0, angle, 0.0, 0.0])
    return np.asarray(_run(mechanical, drive, np.full(1500, position_m), start, CYCLE_STEPS, 0.0)[1])


def simulate_axis(
    mechanics: Mechanics, demand_m: Array, loops: Loops | None = None, dt_s: float = CYCLE_S, start: Array | None = None
) -> Run:
    """Cut the demand (m, 1 ms rows); rows every ``dt_s`` (a multiple of 31.25 us), from rest unless ``start`` says."""
    loops = loops or Loops()
    mechanical, drive = _pack_parameters(mechanics, loops)
    every = round(dt_s / STEP_S)
    begin = compute_rest_state(mechanics, loops, float(demand_m[0])) if start is None else start
    rows, _ = _run(mechanical, drive, np.ascontiguousarray(demand_m), begin, every, mechanics.warming)
    n = rows.shape[1]
    wanted = np.interp(np.arange(n) * dt_s, np.arange(demand_m.size) * CYCLE_S, demand_m)
    return Run(dt_s, wanted, rows[2], rows[3], rows[1], rows[0], rows[4], rows[5], rows[6], float(begin[5]))


def report_signals(run: Run, mechanics: Mechanics, sensors: Sensors, seed: int = 0) -> dict[str, Array]:
    """Return the columns of a recording as the drive reports them: V, A, rad/s, m."""
    rng = np.random.default_rng(seed)
    n = run.speed.size
    noise = sensors.noise
    turn = 2 * np.pi / 2**sensors.encoder_bits
    angle = np.round(run.motor_m / mechanics.pitch_m * 2 * np.pi / turn) * turn
    if sensors.speed == "sensor":
        speed = run.speed + noise * 150 * rng.standard_normal(n)
    else:
        speed = np.diff(angle, prepend=angle[0]) / run.dt_s
        if sensors.speed == "middle":
            speed = (speed + np.append(speed[1:], speed[-1])) / 2
    if sensors.filter_s > 0.0:
        share = 1.0 - np.exp(-run.dt_s / sensors.filter_s)
        for k in range(1, n):
            speed[k] = speed[k - 1] + share * (speed[k] - speed[k - 1])
    voltage = run.command if sensors.command else run.voltage
    return {
        "voltage_V": (voltage + noise * 60 * rng.standard_normal(n)) * (1 + sensors.voltage_gain),
        "current_A": (run.current + noise * 50 * rng.standard_normal(n)) * (1 + sensors.current_gain),
        "speed_rad_per_s": speed,
        "position_m": np.round(run.motor_m, 6),
        "demand_m": np.round(run.demand, 6),
    }


def make_recording(
    run: Run, mechanics: Mechanics, sensors: Sensors, rapid_m_s: float, seed: int = 0, *, voltage: bool = True
) -> Recording:
    """Return the run as a recording is read from disk."""
    reported = report_signals(run, mechanics, sensors, seed)
    return Recording(
        axis="X",
        dt_s=run.dt_s,
        time_s=freeze_array(np.arange(run.speed.size) * run.dt_s),
        voltage_v=freeze_array(reported["voltage_V"]) if voltage else None,
        current_a=freeze_array(reported["current_A"]),
        speed_rad_s=freeze_array(reported["speed_rad_per_s"]),
        position_mm=freeze_array(reported["position_m"] * 1e3),
        demand_mm=freeze_array(reported["demand_m"] * 1e3),
        voltage_sampling=sensors.sampling,
        pitch_mm=mechanics.pitch_m * 1e3,
        rapid_speed_rad_s=rapid_m_s / mechanics.pitch_m * 2 * np.pi,
    )


def format_as_csv(
    run: Run, mechanics: Mechanics, sensors: Sensors, rapid_m_s: float, seed: int = 0, *, voltage: bool = True
) -> str:
    """Return the run as a recording's text, without the column ``voltage_V`` where there is no ``voltage``."""
    columns = report_signals(run, mechanics, sensors, seed)
    headers = {"pitch_m_per_rev": f"{mechanics.pitch_m:g}", "rapid_speed_m_per_s": f"{rapid_m_s:g}"}
    if not voltage:
        del columns["voltage_V"]
        headers["torque_constant_nm_per_a"] = f"{mechanics.K:g}"
    return format_table(run.dt_s, columns, **headers)


def draw_machine(rng: np.random.Generator, base: Mechanics, share: float = 1.0) -> tuple[Mechanics, Loops, Sensors]:
    """Draw an ordinary machine about ``base``: every effect at a level between none and ``share`` of what is usual."""
    level = share * rng.uniform(0.0, 1.0, 12)
    mechanics = replace(
        base,
        static=float(rng.choice((-0.25, 0.2)) * level[0]),
        static_speed_rad_s=float(rng.uniform(5.0, 20.0)),
        asymmetry=float(0.1 * level[1] * rng.choice((-1.0, 1.0))),
        load_nm=float(0.5 * base.Cd * level[2] * rng.choice((-1.0, 1.0))),
        screw_ripple=float(0.1 * level[3]),
        screw_phase=float(rng.uniform(0, 2 * np.pi)),
        motor_ripple_nm=float(0.02 * RATED_NM[base.Cd > 3] * level[4]),
        motor_order=int(rng.choice((4, 12, 24))),
        resonance_hz=float(rng.uniform(90.0, 300.0)),
    )
    loops = replace(
        SLOW_LOOPS if base.Cd < 3 else Loops(), dead_time_v=float(2.0 * level[6]), bus_sag=float(0.03 * level[7])
    )
    sensors = Sensors(
        noise=float(0.001 + 0.004 * level[8]),
        speed=str(rng.choice(("sensor", "difference", "middle"))),
        encoder_bits=int(rng.choice((16, 18, 20, 23))),
        command=bool(rng.random() < 0.5),
        current_gain=float(0.01 * level[9] * rng.choice((-1.0, 1.0))),
    )
    return mechanics, loops, sensors
