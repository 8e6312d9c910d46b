"""Identifies the spring between motor and table from sensors at the table and the motor's own signals.

An encoder shows how the table follows the motor and how the torque bends the screw; an accelerometer, how the torque
accelerates the table.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.table_motion import (
    LEAST_ROWS,
    MotorMotion,
    TableAccelerometer,
    TableEncoder,
    compute_shaft_residuals,
    estimate_noise,
)
from fdhil.records import INTERVAL_95, Estimate, Float, Parameters, Reason, Window, compute_rms, freeze_array

TERMS = ("resonance", "resonance_damping", "resonance_share")
BAND_HZ = (12.0, 300.0)
TRIALS = 70  # frequencies of the first search
WHOLE = 0.8  # of the moving samples must have a reading
EVIDENCE = 30.0  # least rise of twice the log likelihood, in independent samples: by chance once in 10^5 windows,
ELSEWHERE = (0.6, 0.75, 1.33, 1.67)  # above that of a rigid screw, and of springs at these shares of the frequency
LARGEST_STD = 0.1  # of the frequency: with more none is reported
DAMPING = (0.03, 1.2)  # prior, and the deviation of its logarithm
LATE_STD_S = 2e-3  # prior of the lag between the table's sensor and the drive's
SHARE = (0.5, 0.15)  # prior of the table's share of the inertia
SHARES = (0.05, 0.95)
# least doubts, since ripples of the motor's torque are not noise: of the share, which grows with the screw's stiffness,
# and of the frequency by an accelerometer alone; at this frequency (Hz)
UNSURE_SHARE, UNSURE_ALONE, AT_HZ = 0.04, 0.025, 80.0
CORRELATED_S = 0.02  # range of correlation of the residuals
SAME = 0.03  # of the frequency: tolerance of the configured one
STEPS = 25
NIL = 1e-30
ResidualFunction = Callable[[Float], Float]


@dataclass(frozen=True, slots=True)
class Compliance:
    """The spring between motor and table from one window: ``values`` (3,) of ``TERMS`` and their covariance.

    ``doubts`` (3, 2), part of the covariance, are common to all windows of an axis, one standard deviation a column.
    ``estimate_current_lag_s`` is the lag of the table's sensor against the drive's signals.
    """

    values: Float
    covariance: Float
    doubts: Float
    late_s: float

    def get_config_values(self) -> dict[str, float]:
        """Return resonance and damping by their keys in the axis' section of the configuration."""
        return {"resonance_hz": float(self.values[0]), "resonance_damping": float(self.values[1])}


def estimate_compliance(window: Window, parameters: Parameters) -> Compliance | None:
    """Estimate the spring from the sensors at the table; None without a sensor or without a significant resonance.

    ``parameters`` are those identified from the window: K / Jt converts current to acceleration. The window's speed
    must be aligned to its samples.
    """
    motor = MotorMotion.from_window(window, parameters)
    if motor is None:
        return None
    encoder, accelerometer = _select_table_sensors(window, motor)
    sensor = encoder or accelerometer
    fit = None if sensor is None else _fit_resonance(sensor, motor.dt_s)
    if sensor is None or fit is None:
        return None
    values, spread = fit
    w, z = math.exp(values[0]), math.exp(values[1])
    if encoder is None:
        share = _estimate_inertia_share(lambda q: compute_shaft_residuals(motor, w, z, q), motor.dt_s)
        return _build_compliance(w, z, *share, spread, float(values[2]), held=False)
    held = encoder  # w and z are those with the motor held; the share converts them to the motor free
    share = _estimate_inertia_share(
        lambda q: held.compute_bend_residuals(w / math.sqrt(1.0 - q), z / math.sqrt(1.0 - q), q), motor.dt_s
    )
    return _build_compliance(w, z, *share, spread, float(values[2]), held=True)


def _select_table_sensors(window: Window, motor: MotorMotion) -> tuple[TableEncoder | None, TableAccelerometer | None]:
    def select_rows(values: Float | None) -> np.ndarray[tuple[int], np.dtype[np.bool_]] | None:
        rows = motor.rows & np.isfinite(values) if values is not None else np.zeros(1, np.bool_)
        return rows if np.count_nonzero(rows) >= max(LEAST_ROWS, WHOLE * np.count_nonzero(motor.rows)) else None

    table, acceleration = window.table_mm, window.table_m_s2
    encoder = accelerometer = None
    if table is not None and (rows := select_rows(table)) is not None:
        encoder = TableEncoder(motor, table[rows], rows, estimate_noise(table))
    if acceleration is not None and (rows := select_rows(acceleration)) is not None:
        accelerometer = TableAccelerometer(motor, 1e3 * acceleration[rows], rows, 1e3 * estimate_noise(acceleration))
    return encoder, accelerometer


def _fit_resonance(sensor: TableEncoder | TableAccelerometer, dt: float) -> tuple[Float, Float] | None:
    late = _estimate_sensor_lag(sensor)
    trials = 2 * math.pi * np.geomspace(*BAND_HZ, TRIALS)
    shown = [_compute_spring_evidence(sensor, w, DAMPING[0], late) for w in trials]
    best = int(np.argmax(shown))
    if best in (0, TRIALS - 1):  # a resonance beyond the band, or none
        return None
    start = np.array([math.log(trials[best]), math.log(DAMPING[0]), late])
    weak = np.array([0.0, 1.0 / DAMPING[1], 1.0 / LATE_STD_S])
    expected = start.copy()
    scale = max(1.0, compute_rms(sensor.compute_follow_residuals(trials[best], DAMPING[0], late)))
    low, high = np.log(2 * math.pi * np.array(BAND_HZ))

    def compute_fit_residuals(x: Float) -> Float:
        w, z = math.exp(min(max(x[0], low), high)), min(math.exp(x[1]), 0.9)
        return np.concatenate([sensor.compute_follow_residuals(w, z, x[2]) / scale, (x - expected) * weak])

    values, rest, slopes = _minimise_squares(compute_fit_residuals, start, np.array([1e-4, 1e-2, 1e-5]))
    at = [
        _compute_spring_evidence(sensor, math.exp(values[0]) * off, math.exp(values[1]), values[2])
        for off in (1.0, *ELSEWHERE)
    ]
    if at[0] - max(0.0, *at[1:]) < EVIDENCE:
        return None
    if not (low < values[0] < high and values[1] < math.log(0.9)):
        return None
    spread = _estimate_covariance(slopes, rest, sensor.readings.size, round(CORRELATED_S / dt))
    return (values, spread) if np.isfinite(spread).all() and spread[0, 0] < LARGEST_STD**2 else None


def _estimate_sensor_lag(sensor: TableEncoder | TableAccelerometer) -> float:
    """Return the lag of a sensor, s, found with a rigid screw."""
    tried = np.linspace(-2.0, 6.0, 17) * 1e-3 if isinstance(sensor, TableAccelerometer) else np.zeros(1)
    return float(min(tried, key=lambda late: float(np.square(sensor.compute_stiff_residuals(late)).sum())))


def _compute_spring_evidence(sensor: TableEncoder | TableAccelerometer, w: float, z: float, late_s: float) -> float:
    """Return the rise of twice the log likelihood by a spring, counted in independent samples and with equal noise."""
    sprung, stiff = (
        sensor.compute_follow_residuals(w, z, late_s),
        sensor.compute_stiff_residuals(late_s, sensor.compute_noise_power(w, z)),
    )
    return _count_independent_samples(sprung) * math.log(
        max(float(stiff @ stiff), NIL) / max(float(sprung @ sprung), NIL)
    )


def _count_independent_samples(rest: Float) -> float:
    """Return the number of independent samples among residuals (m,), from their correlation at lag 1."""
    power = float(rest @ rest)
    correlation = max(0.0, float(rest[1:] @ rest[:-1]) / power) if power else 0.0
    return rest.size * (1.0 - correlation) / (1.0 + correlation)


def _estimate_inertia_share(unexplained: Callable[[float], Float], dt: float) -> tuple[float, float]:
    tried = np.linspace(0.2, 0.8, 7)
    parts = [unexplained(q) for q in tried]
    costs = [float(e @ e) for e in parts]
    scale = math.sqrt(max(min(costs) / parts[0].size, 1.0))

    def compute_residuals_with_prior(x: Float) -> Float:
        q = min(max(float(x[0]), SHARES[0]), SHARES[1])
        return np.concatenate([unexplained(q) / scale, [(x[0] - SHARE[0]) / SHARE[1]]])

    values, rest, slopes = _minimise_squares(
        compute_residuals_with_prior, np.array([tried[int(np.argmin(costs))]]), np.array([1e-3])
    )
    spread = _estimate_covariance(slopes, rest, parts[0].size, round(CORRELATED_S / dt))
    return float(np.clip(values[0], *SHARES)), min(math.sqrt(spread[0, 0]), SHARE[1])


def _build_compliance(
    w: float, z: float, q: float, std: float, spread: Float, late_s: float, *, held: bool
) -> Compliance:
    free = 1.0 / math.sqrt(1.0 - q) if held else 1.0
    hertz, damping = w * free / (2 * math.pi), z * free
    lever = np.diag([hertz, damping, 1.0])
    if held:
        lever[:2, 2] = np.array([hertz, damping]) * 0.5 / (1.0 - q)
    off = w / (2 * math.pi * AT_HZ)
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[2, 2] = spread[:2, :2], std**2
    doubts = lever @ np.diag([0.0 if held else UNSURE_ALONE * off, 0.0, UNSURE_SHARE * max(1.0, off**3)])[:, [0, 2]]
    covariance = lever @ whole @ lever.T + doubts @ doubts.T
    return Compliance(freeze_array([hertz, damping, q]), freeze_array(covariance), freeze_array(doubts), late_s)


def _minimise_squares(unexplained: ResidualFunction, start: Float, steps: Float) -> tuple[Float, Float, Float]:
    """Minimise the squares (Levenberg, Marquardt); return the values (k,), residuals (m,) and their slopes (m, k)."""
    values, rest, damped = start, unexplained(start), 1e-3
    slopes = _differentiate_residuals(unexplained, values, steps)
    for _ in range(STEPS):
        normal = slopes.T @ slopes
        trial = values - np.linalg.lstsq(normal + damped * np.diag(np.diag(normal)), slopes.T @ rest, rcond=None)[0]
        other = unexplained(trial)
        gained = 1.0 - float(other @ other) / float(rest @ rest)
        if not gained > 0.0:
            damped *= 8.0
            if damped > 1e6:
                break
            continue
        values, rest, damped = trial, other, damped / 5.0
        slopes = _differentiate_residuals(unexplained, values, steps)
        if gained < 1e-6:
            break
    return values, rest, slopes


def _differentiate_residuals(unexplained: ResidualFunction, x: Float, steps: Float) -> Float:
    columns = []
    for k, step in enumerate(steps):
        up, down = x.copy(), x.copy()
        up[k], down[k] = x[k] + step, x[k] - step
        columns.append((unexplained(up) - unexplained(down)) / (2 * step))
    return np.column_stack(columns)


def _estimate_covariance(slopes: Float, rest: Float, size: int, reach: int) -> Float:
    """Return the covariance of a fit whose ``size`` first residuals correlate over ``reach`` (Newey, West 1987)."""
    bread = np.linalg.inv(slopes.T @ slopes)
    scores = slopes * rest[:, None]
    part, own = scores[:size], slopes[size:]  # the prior counts with its own deviation
    meat = part.T @ part + own.T @ own
    for lag in range(1, min(reach, size - 1)):
        both = part[lag:].T @ part[:-lag]
        meat += (1.0 - lag / reach) * (both + both.T)
    return np.asarray(bread @ meat @ bread)


def merge_compliance(estimate: Estimate, identified: Compliance) -> Estimate:
    """Return the estimate with the resonance from the table's sensors, replacing one from the motor's side."""
    kept = [k for k, name in enumerate(estimate.names) if name not in TERMS]
    before = np.zeros((len(estimate.names), 0))
    if estimate.systematic is not None:  # covers the first names only
        before = np.pad(estimate.systematic, ((0, len(estimate.names) - len(estimate.systematic)), (0, 0)))
    return replace(
        estimate,
        names=(*(estimate.names[k] for k in kept), *TERMS),
        values=freeze_array([*estimate.values[kept], *identified.values]),
        covariance=freeze_array(_build_block_diagonal(estimate.covariance[np.ix_(kept, kept)], identified.covariance)),
        systematic=freeze_array(_build_block_diagonal(before[kept], identified.doubts)),
    )


def _build_block_diagonal(one: Float, other: Float) -> Float:
    lower, upper = np.zeros((len(other), one.shape[1])), np.zeros((len(one), other.shape[1]))
    return np.block([[one, upper], [lower, other]])


def check_configured_resonance(identified: Compliance, axis: Axis | None) -> list[Reason]:
    """Return a warning where the table's resonance differs significantly from the one in use."""
    if axis is None or axis.resonance_hz is None:
        return []
    hertz, half = float(identified.values[0]), INTERVAL_95 * math.sqrt(identified.covariance[0, 0])
    if abs(hertz - axis.resonance_hz) <= max(half, SAME * hertz):
        return []
    text = f"the table resonates at {hertz:.1f} ± {half:.1f} Hz, not at {axis.resonance_hz:.4g} Hz as configured or "
    text += "identified from the motor"
    return [Reason("ResonanceDiffers", text, "set resonance_hz of the axis to the table's resonance")]
