"""Prepares a window for the estimators: where the drive is in motion, and the voltage over each interval."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from fdhil.identification.filtering import compute_moving_mean, erode_flags
from fdhil.identification.rapid_windows import (
    RUN_SHARE,
    estimate_noise_std,
    fill_forward,
    interpolate_gaps,
    sort_runs_by_length,
)
from fdhil.model import compute_voltage_ramps
from fdhil.records import Bool, Float, SlowVoltage, VoltageSampling, Window

UNKNOWN_MODE = 0  # stuck, reversing or about to move: the friction torque is unknown
# best possible accuracy of the model, as a share of a signal's peak: the voltage's waveform within a sample is unknown
SHAPE_SHARE = (3e-4, 1e-4, 1e-4)
BROKEN_MODE = 9  # a sample is lost: the interval is skipped
DIFFUSE = 1e6  # variance, in units of the measurement's, of an unknown state

Modes = npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """Standard deviations of the white noise on voltage (V), current (A) and speed (rad/s)."""

    voltage_v: float
    current_a: float
    speed_rad_s: float

    def to_array(self) -> Float:
        """Return (3,) in the order voltage, current, speed."""
        return np.array([self.voltage_v, self.current_a, self.speed_rad_s])


@dataclass(frozen=True, slots=True)
class TermRegressor:
    """The effect of one unit of a term over each interval of a window, ``values`` (n,); the model is linear in it.

    ``kind`` is the signal it adds to. Stribeck friction decays with ``speed_rad_s``. The term is the fitted amplitude
    plus ``about``.
    """

    name: str
    kind: int
    values: Float
    speed_rad_s: float = 0.0
    about: float = 0.0


@dataclass(frozen=True, slots=True)
class WithinSampleDoubt:
    """Unknowns within long samples, (q, n) one standard deviation each: the voltage's rise, the current."""

    rise_v: Float
    current_a: Float


@dataclass(frozen=True, slots=True)
class Motion:
    """One window on its grid: ``mode`` (n,) classifies the interval that begins at each sample.

    +1 or -1: the drive is in motion that way; ``UNKNOWN``: friction is unknown; ``BROKEN``: samples are lost.
    ``voltage_mean`` and ``voltage_rise`` (n,) describe the voltage over each interval; ``current`` and ``speed`` (n,)
    are instants, ``observed`` (n,) marks measured samples. ``speed_walk`` is the standard deviation of the speed's
    change over an interval of unknown friction. With a ``slow`` voltage, ``voltage_mean`` (m,) are its samples,
    ``slope_walk`` (n,), (A/s)^2/s, is the variance that the current's slope gains per second, and ``shape_variance``
    (m,), V^2, is the variance due to the voltage's waveform within a sample. ``courses`` are the regressors of the
    terms, in the order of the last entries of theta; ``known`` are regressors of fixed size. ``angle_rad`` (n,) is the
    shaft's angle, or empty. ``within`` holds the unknowns within long samples. Noise levels are not fitted below
    ``noise_floor`` of the visible noise, where they have no visible effect. ``speed_late`` is the lag in s that was
    removed from the speed, with its standard deviation.
    """

    dt_s: float
    current: Float
    speed: Float
    voltage_mean: Float
    voltage_rise: Float
    observed: Bool
    mode: Modes
    noise: NoiseLevels
    speed_walk: float
    voltage_sampling: VoltageSampling = "interval_mean"
    slow: SlowVoltage | None = None
    slope_walk: Float = field(default_factory=lambda: np.zeros(0))
    shape_variance: Float = field(default_factory=lambda: np.zeros(0))
    courses: tuple[TermRegressor, ...] = ()
    angle_rad: Float = field(default_factory=lambda: np.zeros(0))
    speed_late: tuple[float, float] | None = None
    within: WithinSampleDoubt | None = None
    known: tuple[TermRegressor, ...] = ()
    noise_floor: float = 1e-3

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.speed.size)

    @property
    def samples(self) -> int:
        """Number of samples of a low-rate voltage."""
        return 0 if self.slow is None else int(self.slow.voltage_v.size)

    @property
    def voltage_period_s(self) -> float:
        """The sampling period of the voltage."""
        return self.dt_s if self.slow is None else self.slow.period_s

    def sample_at_voltage(self, course: Float) -> Float:
        """Return a signal (n,) at the begin of each voltage sample."""
        if self.slow is None:
            return course
        begins = self.slow.begin_s + self.slow.period_s * np.arange(self.slow.voltage_v.size)
        begins = begins if self.slow.late_s is None else begins + self.slow.late_s
        return np.interp(begins, np.arange(self.n) * self.dt_s, course)

    def shift_voltage(self, delay_s: float) -> Motion:
        """Return the motion with its voltage earlier by ``delay_s``."""
        if self.slow is not None:
            return replace(self, slow=replace(self.slow, begin_s=self.slow.begin_s - delay_s))
        return replace(self, voltage_mean=self.compute_delayed_voltage(delay_s))

    def compute_delayed_voltage(self, delay_s: float) -> Float:
        """Return the mean voltage (n,) of each interval, corrected for a voltage that is late by ``delay_s``."""
        if delay_s == 0.0:
            return self.voltage_mean
        rows = delay_s / self.dt_s
        whole = round(rows)
        shifted = np.roll(self.voltage_mean, -whole)
        rise = np.roll(self.voltage_rise, -whole)
        if whole > 0:
            shifted[-whole:], rise[-whole:] = self.voltage_mean[-1], 0.0
        elif whole < 0:
            shifted[:-whole], rise[:-whole] = self.voltage_mean[0], 0.0
        return shifted + (rows - whole) * rise


def detect_motion(speed: Float, rapid_rad_s: float) -> Bool:
    """Return where (n,) the shaft is in motion over the whole width of the smoothing that decides it."""
    limit = RUN_SHARE * rapid_rad_s
    width = 2 * int(np.clip((5 * estimate_noise_std(speed) / limit) ** 2, 0, 15)) + 1
    smoothed = compute_moving_mean(fill_forward(speed), width)
    moving = np.abs(smoothed) >= limit
    moving[1:] &= np.sign(smoothed[1:]) == np.sign(smoothed[:-1])
    return erode_flags(moving, width + 2, beyond=True)


def prepare_window(window: Window) -> Motion:
    """Prepare a window for the estimators. ValueError without a voltage."""
    slow = window.slow_voltage
    if window.voltage_v is None and slow is None:
        raise ValueError("a window without voltage has no electrical equation")
    observed = np.isfinite(window.speed_rad_s) & np.isfinite(window.current_a)
    sure = detect_motion(window.speed_rad_s, window.rapid_speed_rad_s)
    side = np.sign(fill_forward(window.speed_rad_s)).astype(np.int8)
    mode = np.where(sure, np.sign(_find_majority_direction(side, sure)), UNKNOWN_MODE).astype(np.int8)
    mode[:-1][mode[:-1] != mode[1:]] = UNKNOWN_MODE  # both ends of an interval must be in the same motion
    if slow is not None:
        mean, rise = fill_forward(slow.voltage_v), np.zeros(slow.voltage_v.size)
    elif window.voltage_v is not None:
        mode[~np.isfinite(window.voltage_v)] = BROKEN_MODE
        mean, rise = compute_voltage_ramps(fill_forward(window.voltage_v), window.voltage_sampling)
    speed, current = fill_forward(window.speed_rad_s), fill_forward(window.current_a)
    return Motion(
        dt_s=window.dt_s,
        current=current,
        speed=speed,
        voltage_mean=mean,
        voltage_rise=rise,
        observed=observed,
        mode=mode,
        noise=estimate_noise_levels(window),
        speed_walk=_find_largest_step(speed, window.dt_s),
        voltage_sampling=window.voltage_sampling,
        slow=slow,
        angle_rad=_compute_angle(window),
        speed_late=None if window.speed_late_s is None else (window.speed_late_s, window.speed_late_std_s),
    )


def _compute_angle(window: Window) -> Float:
    if not np.isfinite(window.position_mm).any():
        return np.zeros(0)
    return interpolate_gaps(window.position_mm) * (2 * math.pi / window.pitch_mm)


def _find_majority_direction(side: Modes, sure: Bool) -> Modes:
    """Return for each sample the majority direction of its moving stretch: noise may flip single samples."""
    result = np.zeros_like(side)
    for a, b in sort_runs_by_length(sure, 1):
        result[a:b] = 1 if side[a:b].sum(dtype=np.int64) >= 0 else -1
    return result


@lru_cache(maxsize=8)
def estimate_noise_levels(window: Window) -> NoiseLevels:
    """Return the noise of the three signals from their third differences, at least their resolution."""
    voltage = window.slow_voltage.voltage_v if window.slow_voltage is not None else window.voltage_v
    signals = (voltage, window.current_a, window.speed_rad_s)
    levels = [_estimate_noise_level(s, share) for s, share in zip(signals, SHAPE_SHARE, strict=True)]
    return NoiseLevels(*levels)


def _estimate_noise_level(values: Float | None, share: float) -> float:
    finite = values[np.isfinite(values)] if values is not None else np.zeros(0)
    if finite.size < 8:
        return 1e-9
    floor = find_resolution(finite) / math.sqrt(12.0)
    return max(estimate_noise_std(finite), floor, share * float(np.abs(finite).max()), 1e-9)


def find_resolution(values: Float) -> float:
    """Return the smallest step between different values, 0 for a constant."""
    if values.size < 2:
        return 0.0
    ordered = np.sort(values)
    steps = ordered[1:] - ordered[:-1]
    steps = steps[steps > 1e-9 * max(1.0, float(np.abs(ordered[[0, -1]]).max()))]
    return float(steps.min()) if steps.size else 0.0


def _find_largest_step(speed: Float, dt: float) -> float:
    width = 2 * round(0.005 / dt / 2) + 1
    step = np.diff(compute_moving_mean(speed, width))
    largest: float = np.abs(step).max(initial=1e-9)
    return largest
