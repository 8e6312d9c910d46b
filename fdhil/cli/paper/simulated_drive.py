"""The measured machine: physics of the simulator, which shares no numerics with the prediction model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from fdhil.cli.paper.scenarios import load_machine
from fdhil.config import Axis
from fdhil.identification import find_windows
from fdhil.records import Float, Parameters, Recording, Window, freeze_array
from fdhil.sim import PlantPhysics, build_plant_parameters

FULL_SCALE = 70.0  # V, A and rad/s: all three signals of figure 4 share its axis
COLD_C, WARM_C = 20.0, 22.0
STROKE_MM = 500.0
LEAD_S, REST_S = 0.2, 0.3
SMOOTHED_ROWS = 20


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Effects outside the paper's model: load and load ripple (N.m), dead band (um)."""

    load_nm: float = 0.0
    ripple_nm: float = 0.0
    backlash_um: float = 0.0


@dataclass(frozen=True, slots=True)
class Move:
    """A rapid move: distance, speed and acceleration."""

    distance_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float

    @staticmethod
    def create_measured(speed_share: float = 1.0) -> Move:
        """Return the rapid of figure 4, or a slower one."""
        axis = load_machine().axis["X"]
        return Move(STROKE_MM, speed_share * axis.rapid_speed_mm_s, axis.max_acceleration_mm_s2)


QUICK = Move(400.0, 500.0, 4000.0)
"""Rapid of a faster machine: more than twice the speed and ten times the acceleration."""


@dataclass(frozen=True, slots=True)
class Signals:
    """Recorded signals, (n,) each: mean voltage of each cycle; current, speed and table position at its start."""

    voltage_v: Float
    current_a: Float
    speed_rad_s: Float
    table_mm: Float


def compute_parameters(axis: str = "X", celsius: float = COLD_C) -> Parameters:
    """Return the true parameters of the measured machine at a slide-way temperature."""
    config = load_machine()
    settings = config.sim.axis[axis]
    rise = celsius - config.sim.thermal.ambient_c
    base = build_plant_parameters(config.axis[axis].nominal, settings)
    return base.replace_values(
        ft=base.ft * (1 + settings.ft_per_kelvin * rise), Cd=base.Cd * (1 + settings.Cd_per_kelvin * rise)
    )


def simulate_drive(
    axis: Axis,
    period_s: float,
    parameters: Parameters,
    demand_mm: Float,
    load_nm: Float | None = None,
    trouble: Disturbance = Disturbance(),
) -> Signals:
    """Simulate a drive on a demand (n,) in whole increments, as on a bus, with an optional load (n,)."""
    mm_per_rad = axis.screw_pitch_mm / (2 * math.pi)
    per_rev = axis.drive.increments_per_rev
    counts = np.rint(demand_mm * per_rev / axis.screw_pitch_mm)
    counts = np.concatenate([counts, counts[-1:], counts[-1:]])
    start = counts[0] * 2 * math.pi / per_rev
    backlash = trouble.backlash_um * 1e-3 / mm_per_rad
    drive = PlantPhysics(parameters, axis.regulators, period_s, per_rev, angle_rad=start, backlash_rad=backlash)
    rows = np.empty((4, demand_mm.size))
    for k in range(demand_mm.size):
        drive.load_torque_nm = trouble.load_nm + trouble.ripple_nm * math.sin(drive.angle_rad)
        if load_nm is not None:
            drive.load_torque_nm += float(load_nm[k])
        rows[1:, k] = drive.current_a, drive.speed_rad_s, drive.table_rad * mm_per_rad
        p0, p1, p2 = counts[k : k + 3].tolist()
        drive.run_cycle(True, (p0, p1, (p1 - p0) / period_s, (p2 - p1) / period_s, 0.0, 0.0, 0.0, 0.0))
        rows[0, k] = drive.voltage_mean_v
    return Signals(*rows)


def generate_strokes(move: Move, period_s: float, strokes: int = 1) -> Float:
    """Return the demand (n,), mm, of rapids back and forward: speed trapezoids, smoothed over 20 ms."""
    ramp_s = move.speed_mm_s / move.acceleration_mm_s2
    duration_s = move.distance_mm / move.speed_mm_s + ramp_s
    t = np.arange(0.0, duration_s + REST_S, period_s)
    speed = np.clip(np.minimum(t, duration_s - t) * move.acceleration_mm_s2, 0.0, move.speed_mm_s)
    lead = np.zeros(round(LEAD_S / period_s))
    speeds = np.concatenate([lead, *(speed * (-1) ** k for k in range(strokes))])
    smooth = np.convolve(speeds, np.full(SMOOTHED_ROWS, 1.0 / SMOOTHED_ROWS))[: speeds.size]
    return np.concatenate([[0.0], np.cumsum(smooth) * period_s])


@cache
def record_rapids(
    parameters: Parameters,
    celsius: float = COLD_C,
    trouble: Disturbance = Disturbance(),
    strokes: int = 1,
    move: Move | None = None,
) -> Recording:
    """Record rapids of the measured machine's X axis without noise (default: those of figure 4)."""
    config = load_machine()
    move = move or Move.create_measured()
    axis, period_s = config.axis["X"], config.machine.sync_period_s
    demand = generate_strokes(move, period_s, strokes)
    signals = simulate_drive(axis, period_s, parameters, demand, trouble=trouble)
    return Recording(
        axis="X",
        dt_s=period_s,
        time_s=freeze_array(np.arange(demand.size) * period_s),
        voltage_v=freeze_array(signals.voltage_v),
        current_a=freeze_array(signals.current_a),
        speed_rad_s=freeze_array(signals.speed_rad_s),
        position_mm=freeze_array(signals.table_mm),
        demand_mm=freeze_array(demand),
        voltage_sampling="interval_mean",
        pitch_mm=axis.screw_pitch_mm,
        rapid_speed_rad_s=move.speed_mm_s * axis.rapid_speed_rad_s / axis.rapid_speed_mm_s,
        temperature_c=celsius,
    )


def add_noise(recording: Recording, share: float, seed: int) -> list[Window]:
    """Return the rapids of a recording with white noise of ``share`` times the full scale on each signal."""
    assert recording.voltage_v is not None
    scatter = share * FULL_SCALE * np.random.default_rng(seed).standard_normal((3, recording.time_s.size))
    return find_windows(
        replace(
            recording,
            voltage_v=freeze_array(recording.voltage_v + scatter[0]),
            current_a=freeze_array(recording.current_a + scatter[1]),
            speed_rad_s=freeze_array(recording.speed_rad_s + scatter[2]),
            position_mm=freeze_array(np.round(recording.position_mm, 3)),
        )
    )
