"""Simulates the speed from the measured voltage, and computes how much of the measured speed that explains."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fdhil.identification import LikelihoodFit, compute_term_voltage_v, fill_forward, list_missing_reasons
from fdhil.model import discretise_plant, simulate_plant
from fdhil.records import Estimate, Float, Parameters, Window

LEAST_FIT_PERCENT = 80.0
EXCESS = 1.5  # of the variance that noise explains
SHAPE_SHARE = 0.002  # of the rapid speed: uncertainty by the voltage's course within a sample


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedMotion:
    """A drive simulated from its measured voltage at ``time_s`` (m,) after row 0, with its measured speed there."""

    time_s: Float
    current_a: Float
    speed_rad_s: Float
    measured_rad_s: Float


def compute_fit_percent(window: Window, estimate: Estimate, fit: LikelihoodFit | None) -> float | None:
    """Return 100 (1 - |w - what| / |w - mean w|) of the speed simulated from voltage; None without a model."""
    motion = simulate_from_voltage(window, estimate, fit)
    if motion is None:
        return None
    known = np.isfinite(motion.measured_rad_s)
    return _compute_explained_percent(motion.measured_rad_s[known], motion.speed_rad_s[known])


def simulate_from_voltage(window: Window, estimate: Estimate, fit: LikelihoodFit | None) -> SimulatedMotion | None:
    """Simulate a window's current and speed from its voltage alone; None without a model or a voltage.

    An estimated delay of the voltage of up to one sample is removed first. Where a slow voltage leaves R or L
    undetermined, the fit's own value is used: a simulation needs all.
    """
    if window.voltage_v is None and window.slow_voltage is None:
        return None
    p = _fill_missing_values(estimate, fit).build_parameters()
    values = np.array(list(p.as_dict().values()))
    if not np.isfinite(values).all() or not (values[:4] > 0).all():
        return None
    p = replace(p, ft=max(p.ft, 0.0), Cd=max(p.Cd, 0.0))
    if window.slow_voltage is not None:
        return _simulate_slow_voltage(window, p, estimate.delay_s or 0.0)
    assert window.voltage_v is not None
    row: Float = np.arange(window.n, dtype=np.float64)
    voltage = fill_forward(window.voltage_v)
    if fit is not None:
        voltage = voltage + compute_term_voltage_v(fit.problem.motions[0], fit.theta)
    if estimate.delay_s and abs(estimate.delay_s) <= window.dt_s:
        voltage = np.interp(row + estimate.delay_s / window.dt_s, row, voltage)
    current, speed = simulate_plant(p, voltage, window.dt_s, window.voltage_sampling)
    return SimulatedMotion(row * window.dt_s, current, speed, window.speed_rad_s)


def _fill_missing_values(estimate: Estimate, fit: LikelihoodFit | None) -> Estimate:
    if fit is None or not estimate.missing or list_missing_reasons(estimate, slow=fit.problem.has_slow_voltage):
        return estimate
    return replace(estimate, values=np.where(np.isnan(estimate.values), fit.theta[:6], estimate.values))


def _simulate_slow_voltage(window: Window, parameters: Parameters, delay_s: float) -> SimulatedMotion:
    slow = window.slow_voltage
    assert slow is not None
    begin: Float = slow.begin_s - delay_s + slow.period_s * np.arange(slow.voltage_v.size, dtype=np.float64)
    voltage = fill_forward(slow.voltage_v)
    if slow.late_s is not None:  # of a polled sensor: its values are interpolated to the grid, and across its gaps
        known = np.isfinite(slow.voltage_v)
        voltage = np.interp(begin, (begin + slow.late_s)[known], slow.voltage_v[known]) if known.any() else voltage
    current, speed = simulate_plant(parameters, voltage, slow.period_s, window.voltage_sampling)
    measured = np.interp(begin, np.arange(window.n) * window.dt_s, fill_forward(window.speed_rad_s))
    return SimulatedMotion(begin, current, speed, measured)


def _compute_explained_percent(measured: Float, speed: Float) -> float | None:
    spread = float(np.linalg.norm(measured - measured.mean())) if measured.size else 0.0
    if spread == 0.0 or not np.isfinite(speed).all():
        return None
    return 100.0 * (1.0 - float(np.linalg.norm(measured - speed)) / spread)


def compute_expected_fit_percent(window: Window, fit: LikelihoodFit) -> float:
    """Return the least fit of a correct model, from the noise of speed and of the voltage that drives it."""
    if window.slow_voltage is not None:
        return LEAST_FIT_PERCENT  # the voltage's course within its samples is unknown
    noise = fit.problem.motions[0].noise
    own = fit.problem.noises[0].voltage_v
    p = Parameters(*fit.theta[:6])
    step = discretise_plant(p, fit.problem.motions[0].voltage_period_s)
    push = step.mean[:, 0] / p.L * min(own, EXCESS * noise.voltage_v)
    # the steady state of P = phi P phi' + push push'
    spread = np.linalg.solve(np.eye(4) - np.kron(step.phi, step.phi), np.outer(push, push).ravel()).reshape(2, 2)
    variance = EXCESS * (noise.speed_rad_s**2 + spread[1, 1]) + (SHAPE_SHARE * window.rapid_speed_rad_s) ** 2
    deviation = float(np.nanstd(window.speed_rad_s))
    return max(LEAST_FIT_PERCENT, 100.0 * (1.0 - float(np.sqrt(variance)) / max(deviation, 1e-300)))
