"""Solves equations [1] and [2] of [DES]: exact discretisation, and simulation from the measured voltage.

    L di/dt  = u - R i - K w
    Jt dw/dt = K i - ft w - Cd sign(w)          w = 0 sticks while |K i| <= Cd

Between two reversals the drive is linear, so its step over any interval is exact: a matrix exponential.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdhil.model.numba_decorators import compile_inline_kernel, compile_kernel
from fdhil.records import Float, Parameters, VoltageSampling, make_read_only_view

SUBSTEP_S = 6.25e-5  # interval at which stick and slip are decided; the linear part needs no substep
_SERIES_TERMS = 14
_SERIES_NORM = 0.4  # below it the series of _SERIES_TERMS terms is exact to the last bit


@dataclass(frozen=True, slots=True)
class PlantStep:
    """One exact step of dx/dt = A x + b over h: x(h) = phi x(0) + mean b_mean + ramp b_ramp for x = [i, w].

    ``phi`` (2, 2); ``mean`` (2, 2) is the integral of exp(A s); ``ramp`` (2, 2) answers an input that rises linearly
    from -1/2 to +1/2 over the step, whose mean is 0.
    """

    phi: Float
    mean: Float
    ramp: Float


@compile_inline_kernel
def _multiply_2x2(a: Float, b: Float) -> Float:
    """Return the product of two (2, 2) matrices; at this size a library call takes ten times longer."""
    out = np.empty((2, 2))
    out[0, 0] = a[0, 0] * b[0, 0] + a[0, 1] * b[1, 0]
    out[0, 1] = a[0, 0] * b[0, 1] + a[0, 1] * b[1, 1]
    out[1, 0] = a[1, 0] * b[0, 0] + a[1, 1] * b[1, 0]
    out[1, 1] = a[1, 0] * b[0, 1] + a[1, 1] * b[1, 1]
    return out


@compile_kernel
def compute_transition(a: Float, h: float) -> tuple[Float, Float, Float]:
    """Return phi = exp(A h), its integral over h, and the response to a ramp from -1/2 to 1/2 (all (2, 2))."""
    norm = np.abs(a).sum() * h
    halvings = 0
    while norm > _SERIES_NORM and halvings < 60:
        norm *= 0.5
        halvings += 1
    step = h / 2.0**halvings
    phi = np.eye(2)
    mean = np.eye(2) * step  # integral of exp(A s)
    first = np.eye(2) * (step * step / 2.0)  # integral of exp(A (h - s)) s
    power = np.eye(2)
    factor = 1.0
    for k in range(1, _SERIES_TERMS):
        power = _multiply_2x2(power, a)
        factor *= step / k
        phi += power * factor
        mean += power * (factor * step / (k + 1))
        first += power * (factor * step * step / ((k + 1) * (k + 2)))
    for _ in range(halvings):
        first = _multiply_2x2(phi, first) + first + mean * step
        mean = mean + _multiply_2x2(phi, mean)
        phi = _multiply_2x2(phi, phi)
        step *= 2.0
    return phi, mean, first / h - mean * 0.5


def build_system_matrix(parameters: Parameters) -> Float:
    """Return A (2, 2) of dx/dt = A x + [u/L, -Cd sign(w)/Jt] for x = [i, w]."""
    p = parameters
    return np.array([[-p.R / p.L, -p.K / p.L], [p.K / p.Jt, -p.ft / p.Jt]])


def discretise_plant(parameters: Parameters, dt_s: float) -> PlantStep:
    """Return the exact step of the moving drive over ``dt_s``; the inputs are u/L and -Cd sign(w)/Jt."""
    return PlantStep(*compute_transition(build_system_matrix(parameters), dt_s))


@compile_kernel
def _simulate_plant_steps(
    a: Float, gains: Float, mean_v: Float, rise_v: Float, dt: float, substeps: int, start: Float
) -> tuple[Float, Float]:
    """Step through the intervals; ``gains`` = [1/L, Cd/Jt, K, Cd]; ``rise_v`` is the voltage rise over each."""
    n = mean_v.size
    current = np.empty(n)
    speed = np.empty(n)
    h = dt / substeps
    phi, whole, ramp = compute_transition(a, h)
    still = np.exp(a[0, 0] * h)
    still_gain = -(1.0 - still) / a[0, 0] if a[0, 0] != 0.0 else h
    i = start[0]
    w = start[1]
    for k in range(n):
        current[k] = i
        speed[k] = w
        for j in range(substeps):
            u = mean_v[k] + rise_v[k] * ((j + 0.5) / substeps - 0.5)
            torque = gains[2] * i
            if w == 0.0 and abs(torque) <= gains[3]:
                i = still * i + still_gain * gains[0] * u
                continue
            side = np.sign(w) if w != 0.0 else np.sign(torque)
            e = gains[0] * u
            r = gains[0] * rise_v[k] / substeps
            f = -gains[1] * side
            i_next = phi[0, 0] * i + phi[0, 1] * w + whole[0, 0] * e + whole[0, 1] * f + ramp[0, 0] * r
            w_next = phi[1, 0] * i + phi[1, 1] * w + whole[1, 0] * e + whole[1, 1] * f + ramp[1, 0] * r
            i = i_next
            w = 0.0 if w_next * side < 0.0 else w_next
    return current, speed


def compute_voltage_ramps(voltage_v: Float, sampling: VoltageSampling) -> tuple[Float, Float]:
    """Return mean (n,) and rise (n,) in V of the voltage over each [t_k, t_k + dt).

    Between samples a drive's voltage is closer to a ramp than to a hold. The rise of an interval mean is half the
    difference of its neighbours, which leaves the means as measured. Instantaneous values are joined by straight lines.
    """
    if voltage_v.size < 2:
        return voltage_v.copy(), np.zeros_like(voltage_v)
    if sampling == "instant":
        following = np.append(voltage_v[1:], voltage_v[-1])
        return (voltage_v + following) / 2, following - voltage_v
    rise = np.empty_like(voltage_v)
    rise[1:-1] = (voltage_v[2:] - voltage_v[:-2]) / 2
    rise[0], rise[-1] = voltage_v[1] - voltage_v[0], voltage_v[-1] - voltage_v[-2]
    return voltage_v, rise


def simulate_plant(
    parameters: Parameters,
    voltage_v: Float,
    dt_s: float,
    sampling: VoltageSampling,
    current0_a: float = 0.0,
    speed0_rad_s: float = 0.0,
) -> tuple[Float, Float]:
    """Simulate [1] and [2] from the voltage (n,) alone; return current_a (n,), speed_rad_s (n,) at t_0 .. t_{n-1}.

    Sample 0 is the given start. The step is exact while the drive moves or sticks; a stop is detected every
    ``SUBSTEP_S``.
    """
    p = parameters
    mean, rise = compute_voltage_ramps(np.ascontiguousarray(voltage_v, dtype=np.float64), sampling)
    substeps = max(1, int(np.ceil(dt_s / SUBSTEP_S - 1e-9)))
    gains = np.array([1 / p.L, p.Cd / p.Jt, p.K, p.Cd])
    start = np.array([current0_a, speed0_rad_s])
    return _simulate_plant_steps(build_system_matrix(p), gains, make_read_only_view(mean), rise, dt_s, substeps, start)
