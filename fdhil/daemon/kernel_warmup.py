"""Compiles the kernels before the daemon is READY: a compilation blocks the interpreter for seconds."""

import math

import numpy as np

from fdhil import correction
from fdhil.config import Axis, MachineConfig
from fdhil.correction import project_onto_limits
from fdhil.identification import compute_departure, compute_robust_covariance
from fdhil.model import simulate_axis
from fdhil.pipeline import AxisPipeline
from fdhil.records import Float, Parameters, Stages, Trajectory, Window, freeze_array, freeze_integers


def compile_kernels(config: MachineConfig, method: str | None = None) -> None:
    """Run simulated rapids of the nominal drives through pipelines and a correction, so that every kernel compiles."""
    dt_s = config.machine.sync_period_s
    windows = {}
    for name, axis in config.axis.items():
        pipeline = AxisPipeline(name, config, method)
        for direction in (1, -1):
            windows[name] = simulate_nominal_rapid(name, axis, dt_s, direction)
            pipeline.process_record(windows[name])
    rows = min(window.n for window in windows.values())
    demand = {name: freeze_array(0.2 * window.demand_mm[:rows]) for name, window in windows.items()}
    still = np.zeros(rows, dtype=np.int64)
    reference = Trajectory(
        dt_s, freeze_array(np.arange(rows) * dt_s), demand, still.astype(np.bool_), freeze_integers(still)
    )
    models = {name: Parameters(**axis.nominal.model_dump()) for name, axis in config.axis.items()}
    correction.plan_correction(reference, models, config)
    for name, model in models.items():
        for more in ({"load": 0.0}, {"resonance": 100.0}):
            simulate_axis(model.replace_values(**more), config.axis[name], dt_s, demand[name][:8])
    _warm_rare_kernels()


def _warm_rare_kernels() -> None:
    """Call what a healthy drive rarely needs: clipped offsets, a reconstructed sensor, coloured innovations.

    The last one compiles nothing, but loads a library's code and buffers, over a megabyte, into memory from the start.
    """
    project_onto_limits(np.linspace(0.0, 2.0, 8), np.ones(3), np.zeros(2))
    theta, rows = np.array([0.5, 0.005, 0.8, 0.075, 0.05, 5.0, 0.0]), np.ones((4, 3))
    compute_departure(theta, 0.001, np.ones(4, dtype=np.int8), np.ones(4), rows, rows, rows, 0)
    slopes = np.random.default_rng(1).normal(size=(256, 2, theta.size))
    compute_robust_covariance(np.eye(theta.size), [slopes[:, 0]], [(slopes, slopes[:, :, 0])])


def simulate_nominal_rapid(name: str, axis: Axis, dt_s: float, direction: int = 1, seed: int = 1) -> Window:
    """Return a simulated rapid of the nominal drive with its regulators and noise; the voltage follows from [1]."""
    top = axis.rapid_speed_rad_s
    nominal = Parameters(**axis.nominal.model_dump())
    ramp_s = axis.rapid_speed_mm_s / axis.max_acceleration_mm_s2
    margin, ramp, cruise = (round(seconds / dt_s) for seconds in (0.1, ramp_s, 0.4))
    wanted = direction * top * _make_speed_profile(margin, ramp, cruise)
    turned = np.cumsum(wanted) - 0.5 * (wanted + wanted[0])  # trapezoids
    demand = turned * dt_s * axis.screw_pitch_mm / (2 * math.pi)
    moved = simulate_axis(nominal, axis, dt_s, freeze_array(demand))
    position, speed, current = moved.position_mm, moved.speed_rad_s, moved.current_a
    angle = position * (2 * math.pi / axis.screw_pitch_mm)
    voltage = nominal.R * current + nominal.L * np.gradient(current, dt_s) + nominal.K * speed
    if axis.voltage.sampling == "interval_mean":  # [1] over the row
        held = (current + np.append(current[1:], current[-1])) / 2
        steps = [np.diff(values, append=values[-1]) / dt_s for values in (current, angle)]
        voltage = nominal.R * held + nominal.L * steps[0] + nominal.K * steps[1]
    rng = np.random.default_rng(seed)
    noisy = [freeze_array(s + rng.normal(0, 1e-3 * np.abs(s).max(), s.size)) for s in (speed, current, voltage)]
    begin, end = margin, wanted.size - margin
    return Window(
        axis=name,
        start_tick=0,
        start_s=0.0,
        dt_s=dt_s,
        demand_mm=freeze_array(demand),
        position_mm=freeze_array(position),
        speed_rad_s=noisy[0],
        current_a=noisy[1],
        voltage_v=noisy[2],
        voltage_sampling=axis.voltage.sampling,
        stages=Stages((begin, begin + ramp), (begin + ramp, end - ramp), (end - ramp, end)),
        direction=direction,
        rapid_speed_rad_s=top,
        pitch_mm=axis.screw_pitch_mm,
        source="warm-up",
    )


def _make_speed_profile(margin: int, ramp: int, cruise: int) -> Float:
    """Return a speed profile 0..1 with smooth corners: rest, ramp, cruise, ramp, rest."""
    up = 0.5 - 0.5 * np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp)
    return np.concatenate([np.zeros(margin), up, np.ones(cruise), up[::-1], np.zeros(margin)])
