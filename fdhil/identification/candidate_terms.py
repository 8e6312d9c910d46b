"""Lists the candidate terms: for each, the regressors of one unit over a window.

Stribeck friction, falling or rising, is tried at a grid of speeds; a ripple is a sine and a cosine of the shaft's
angle; of a commanded voltage the inverter's dead time, and a bus that sags under power, subtract a part.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.identification.filtering import compute_moving_mean
from fdhil.identification.kalman import LOAD, VOLTAGE
from fdhil.identification.prepared_motion import Motion, TermRegressor
from fdhil.records import Float

SPEEDS = np.geomspace(0.02, 0.35, 8)  # of the top speed: Stribeck speeds
SCREW_ORDERS = (1, 2)  # periods per turn
# of 2 to 8 pole pairs: sensors' zeros and gains once and twice an electrical turn, windings 6 times, slots
MOTOR_ORDERS = (3, 4, 5, 6, 8, 10, 12, 16, 18, 20, 24, 30, 36)
MOST_TURN = 0.9 * np.pi  # of a ripple per sample at top speed: beyond it orders alias
SMOOTHING_S = 0.005
WHOLE_DEAD_TIME = 0.01  # of the peak current: above it a dead time has its full effect
LEAST_TURN = 1e-9  # rad per interval
PHASE_SUFFIX = "_phase"  # suffix of a ripple's cosine, and of its phase


@dataclass(frozen=True, slots=True, eq=False)
class CandidateTerm:
    """A candidate term: for each window one or two regressors; only one of its ``family`` may be added."""

    family: str
    courses: tuple[tuple[TermRegressor, ...], ...]


def list_candidates(motions: Sequence[Motion], command: bool) -> list[CandidateTerm]:
    """Return the candidate terms of these windows; terms of the voltage only where it may be a ``command``."""
    top = max(float(np.abs(m.speed).max()) for m in motions)
    found = [
        CandidateTerm("stribeck", tuple((build_stribeck_regressor(m, speed),) for m in motions))
        for speed in SPEEDS * top
    ]
    if all(m.angle_rad.size for m in motions):
        made = [build_ripple_regressors(m) for m in motions]
        shared = [name for name in made[0] if all(name in own for own in made)]
        found += [CandidateTerm(name, tuple(own[name] for own in made)) for name in shared]
    if command and all(m.slow is None for m in motions):
        found += [CandidateTerm("dead_time", tuple((build_dead_time_regressor(m),) for m in motions))]
        found += [CandidateTerm("bus_sag", tuple((build_bus_sag_regressor(m),) for m in motions))]
    return found


def build_stribeck_regressor(motion: Motion, speed_rad_s: float) -> TermRegressor:
    """Return dry friction that decays as exp(-(w / ``speed_rad_s``)^2)."""
    share = np.exp(-np.square(_average_intervals(_smooth_signal(motion, motion.speed)) / speed_rad_s))
    return TermRegressor("stribeck", LOAD, share * _get_direction(motion), speed_rad_s)


def build_stribeck_slope_regressor(motion: Motion, course: TermRegressor) -> TermRegressor:
    """Return the derivative of Stribeck friction by its speed, N.m per rad/s and N.m."""
    speed = _average_intervals(_smooth_signal(motion, motion.speed))
    return TermRegressor("stribeck_speed", LOAD, course.values * 2 * np.square(speed) / course.speed_rad_s**3)


def build_ripple_regressors(motion: Motion) -> dict[str, tuple[TermRegressor, TermRegressor]]:
    """Return sine and cosine of each order of the shaft's angle, as means over each interval, by name."""
    turned = np.diff(motion.angle_rad, append=motion.angle_rad[-1])
    still = np.abs(turned) < LEAST_TURN
    share = np.abs(_get_direction(motion)) / np.where(still, 1.0, turned)
    at = np.exp(1j * motion.angle_rad)
    wave, made = np.ones_like(at), {}
    most = MOST_TURN / max(float(np.abs(turned).max(initial=0.0)), LEAST_TURN)
    for order in range(1, MOTOR_ORDERS[-1] + 1):
        wave = wave * at
        if (order not in SCREW_ORDERS and order not in MOTOR_ORDERS) or order > most:
            continue
        # the integral of exp(j k a) is exp(j k a) / (j k)
        mean = np.where(still, 0.0, np.append(wave[1:], wave[-1]) - wave) * (share / order)
        name = f"ripple_{'screw' if order in SCREW_ORDERS else 'motor'}_{order}"
        made[name] = (TermRegressor(name, LOAD, -mean.real), TermRegressor(name + PHASE_SUFFIX, LOAD, mean.imag))
    return made


def build_dead_time_regressor(motion: Motion) -> TermRegressor:
    """Return minus the sign of the current, smoothed about zero."""
    current = _average_intervals(_smooth_signal(motion, motion.current))
    whole = max(WHOLE_DEAD_TIME * float(np.abs(motion.current).max()), 3.0 * motion.noise.current_a, 1e-12)
    return TermRegressor("dead_time", VOLTAGE, -np.clip(current / whole, -1.0, 1.0))


def build_bus_sag_regressor(motion: Motion) -> TermRegressor:
    """Return minus the voltage times the motor's power; braking does not raise a regulated bus."""
    power = np.maximum(motion.voltage_mean * _average_intervals(_smooth_signal(motion, motion.current)), 0.0)
    return TermRegressor("bus_sag", VOLTAGE, -motion.voltage_mean * power)


def _get_direction(motion: Motion) -> Float:
    return np.where(np.abs(motion.mode) == 1, motion.mode, 0).astype(np.float64)


def _smooth_signal(motion: Motion, values: Float) -> Float:
    return compute_moving_mean(values, 2 * round(SMOOTHING_S / motion.dt_s / 2) + 1)


def _average_intervals(values: Float) -> Float:
    middle: Float = (values + np.append(values[1:], values[-1])) / 2
    return middle
