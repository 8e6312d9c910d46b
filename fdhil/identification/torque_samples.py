"""Prepares a window for [2] alone: current, speed, acceleration and its derivatives through the same filter.

The acceleration comes from the position or the speed, whichever is less noisy. The position's second difference is the
acceleration's mean weighted by a triangle two samples wide, so the current is averaged by the same triangle. Samples at
standstill, or lost, are zeroed on both sides of [2] before the low-pass: unknown static friction must not leak.
"""

import math
from dataclasses import dataclass

import numpy as np

from fdhil.config import Identification
from fdhil.identification.filtering import (
    compute_filter_reach,
    compute_impulse_response,
    erode_flags,
    filter_zero_phase,
)
from fdhil.identification.prepared_motion import detect_motion, find_resolution
from fdhil.identification.rapid_windows import estimate_noise_std, interpolate_gaps
from fdhil.records import Bool, Float, Window


@dataclass(frozen=True, slots=True)
class TorqueSamples:
    """A window's signals (n,), filtered alike; ``usable`` marks the samples in motion, which are fitted.

    ``jerk`` and ``snap`` are the first and second derivative of the acceleration. ``side`` is the direction of motion
    (0 at standstill), unfiltered, and so is ``angle`` = 2 pi x / pitch, rad. ``error_rad_s2`` is the standard deviation
    of the noise on the acceleration.
    """

    dt_s: float
    lowpass_hz: float
    current: Float
    acceleration: Float
    jerk: Float
    snap: Float
    speed: Float
    side: Float
    angle: Float
    usable: Bool
    error_rad_s2: float

    @property
    def count(self) -> int:
        """Number of samples to fit."""
        return int(np.count_nonzero(self.usable))

    def filter_regressors(self, courses: Float) -> Float:
        """Return torque regressors (q, n) through the same low-pass, at the samples to fit (m, q)."""
        return filter_zero_phase(courses, self.lowpass_hz, self.dt_s)[:, self.usable].T


def extract_torque_samples(window: Window, settings: Identification) -> TorqueSamples | None:
    """Return the torque samples of a window, its acceleration from position or speed; None with hardly any samples."""
    dt, corner = window.dt_s, settings.lowpass_hz
    broken = ~(np.isfinite(window.current_a) & np.isfinite(window.speed_rad_s) & np.isfinite(window.position_mm))
    if window.n - np.count_nonzero(broken) < 8:
        return None
    angle = interpolate_gaps(window.position_mm) / window.pitch_mm * 2 * math.pi
    speed, acceleration, error = _select_acceleration(angle, interpolate_gaps(window.speed_rad_s), corner, dt)
    whole = erode_flags(~broken, 3, beyond=True)
    moving = detect_motion(speed, window.rapid_speed_rad_s) & whole
    signals = (
        _apply_stencil(interpolate_gaps(window.current_a), (1 / 6, 2 / 3, 1 / 6)),
        acceleration,
        _apply_stencil(acceleration, (-0.5, 0.0, 0.5)) / dt,
        _apply_stencil(acceleration, (1.0, -2.0, 1.0)) / dt**2,
        speed,
    )
    current, acceleration, jerk, snap, speed = filter_zero_phase(np.where(moving, np.stack(signals), 0.0), corner, dt)
    return TorqueSamples(
        dt_s=dt,
        lowpass_hz=corner,
        current=current,
        acceleration=acceleration,
        jerk=jerk,
        snap=snap,
        speed=speed,
        side=np.where(moving, np.sign(speed), 0.0),
        angle=angle,
        usable=erode_flags(moving, 2 * compute_filter_reach(corner, dt) + 1, beyond=False),
        error_rad_s2=error,
    )


def _select_acceleration(angle: Float, speed: Float, lowpass_hz: float, dt: float) -> tuple[Float, Float, float]:
    """Return speed and acceleration (n,) from the signal that disturbs the acceleration less, and its noise."""
    second, slope = np.array([1.0, -2.0, 1.0]) / dt**2, np.array([-0.5, 0.0, 0.5]) / dt
    of_angle = _compute_noise_gain(second, lowpass_hz, dt) * max(
        estimate_noise_std(angle), find_resolution(angle) / math.sqrt(12.0)
    )
    of_speed = _compute_noise_gain(slope, lowpass_hz, dt) * max(
        estimate_noise_std(speed), find_resolution(speed) / math.sqrt(12.0)
    )
    if np.ptp(angle) > 0.0 and of_angle <= of_speed:
        return _apply_stencil(angle, tuple(slope)), _apply_stencil(angle, tuple(second)), of_angle
    return speed, _apply_stencil(speed, tuple(slope)), of_speed


def _compute_noise_gain(stencil: Float, lowpass_hz: float, dt: float) -> float:
    return float(np.linalg.norm(np.convolve(compute_impulse_response(lowpass_hz, dt), stencil)))


def _apply_stencil(values: Float, weights: tuple[float, ...]) -> Float:
    """Return the weighted sum (n,) over three samples about each; the ends repeat their neighbours."""
    summed = np.empty_like(values)
    before, at, after = weights
    summed[1:-1] = before * values[:-2] + at * values[1:-1] + after * values[2:]
    summed[0], summed[-1] = summed[1], summed[-2]
    return summed
