"""Estimates R and L from a recording with a locked rotor: [1] without its back-EMF.

The current computed from R, L and the measured voltage is fitted to the measured one ([LJU] ch. 4, output error).
"""

import math

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from fdhil.identification.identifiability import RELATIVE_STD_LIMIT
from fdhil.identification.normal_equations import invert_gram
from fdhil.identification.prepared_motion import estimate_noise_levels
from fdhil.identification.rapid_windows import fill_forward
from fdhil.model import compute_voltage_ramps
from fdhil.records import PARAMETERS, Estimate, Float, Reason, Result, Window

NAME = "locked_rotor"
TURNING = 8.0  # of the noise of the speed
ADVICE = "add a recording in which the rotor turns"
START_L_H = 1e-3
OPEN_SHARE = np.array([5e-4, 1e-3])  # of R and L: doubt of the voltage's waveform within a sample
TOO_SLOW = "the current changes too little, or too slowly, to determine {}"


def is_rotor_locked(window: Window) -> bool:
    """Return whether the speed of a laboratory recording is only noise while a current flows."""
    speed, current = np.abs(fill_forward(window.speed_rad_s)).max(), np.abs(fill_forward(window.current_a)).max()
    noise = estimate_noise_levels(window)
    return not window.is_rapid and bool(speed <= TURNING * noise.speed_rad_s and current > TURNING * noise.current_a)


def estimate_locked_rotor(window: Window) -> Estimate:
    """Return R and L of a window with a measured voltage; the other parameters are NaN with a reason."""
    assert window.voltage_v is not None
    voltage = compute_voltage_ramps(fill_forward(window.voltage_v), window.voltage_sampling)[0]
    current = fill_forward(window.current_a)

    def compute_current_residuals(logarithms: Float) -> Float:
        resistance, inductance = np.exp(logarithms)
        keeps = math.exp(-resistance / inductance * window.dt_s)
        made = lfilter([0.0, 1.0], [1.0, -keeps], voltage * (1.0 - keeps) / resistance)
        return np.asarray(made + current[0] * keeps ** np.arange(current.size) - current, dtype=np.float64)

    start_ohm = max(abs(float(voltage @ current)) / float(current @ current), 1e-3)
    with np.errstate(over="ignore", under="ignore"):
        found = least_squares(compute_current_residuals, np.log([start_ohm, START_L_H]), bounds=(-14.0, 7.0))
    spread = (
        invert_gram(np.asarray(found.jac, dtype=np.float64))[0]
        * float(found.fun @ found.fun)
        / max(1, current.size - 2)
    )
    shares = np.sqrt(np.diag(spread) * compute_correlation_factor(found.fun) + OPEN_SHARE**2)
    values, covariance = np.full(6, np.nan), np.full((6, 6), np.nan)
    still = "the rotor does not turn, so {} cannot be determined"
    missing = {name: Reason("LowExcitation", still.format(name), ADVICE) for name in PARAMETERS}
    for k, name in enumerate(PARAMETERS[:2]):
        if 0.0 < shares[k] <= RELATIVE_STD_LIMIT[name]:
            values[k] = math.exp(found.x[k])
            covariance[k, k] = (shares[k] * values[k]) ** 2
            del missing[name]
        else:
            missing[name] = Reason("LowExcitation", TOO_SLOW.format(name), "record steps of the voltage")
    return Estimate(NAME, PARAMETERS, values, covariance, {"electrical": found.fun}, Result.UNDER_EXCITED, missing)


def compute_correlation_factor(residuals: Float) -> float:
    """Return the variance inflation of correlated residuals (m,), at least 1: 1 + 2 sum of their correlations."""
    power, total = float(residuals @ residuals), 1.0
    for lag in range(1, min(200, residuals.size // 4)):
        share = float(residuals[lag:] @ residuals[:-lag]) / max(power, 1e-300)
        if share < 0.05:
            break
        total += 2.0 * share
    return total
