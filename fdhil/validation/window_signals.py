"""Holds a window before any fit: its sensors, their noise and resolution, and the samples of motion and standstill."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification import (
    NoiseLevels,
    estimate_noise_levels,
    fill_forward,
    find_moving_range,
    find_resolution,
    smooth_samples,
)
from fdhil.records import Bool, Float, Window
from fdhil.validation.backlash import DeadBand, detect_backlash

STILL_MM = 0.004  # travel of a table at standstill
STILL_S, STILL_SHARE = 0.010, 0.02  # time over which that travel is measured, and share of the rapid speed
LEAST_SAMPLES = 32  # of a window that may hold a rapid move


@dataclass(frozen=True, slots=True)
class SensorSignal:
    """One sensor over a window: its ``values`` (n,), and the smallest ``step`` between them (0: a single value)."""

    name: str
    unit: str
    values: Float
    step: float


def collect_sensors(window: Window) -> tuple[SensorSignal, ...]:
    """Return the sensors that the window has in every sample."""
    recorded = (
        ("voltage", "V", window.voltage_v),
        ("current", "A", window.current_a),
        ("speed", "rad/s", window.speed_rad_s),
    )
    return tuple(SensorSignal(n, u, v, find_resolution(v[np.isfinite(v)])) for n, u, v in recorded if v is not None)


@dataclass(frozen=True)
class WindowSignals:
    """A ``window`` whose speed is aligned to its samples, and as it was ``recorded`` (None: nothing was aligned).

    ``axis`` is the axis' section of the configuration, and ``sync_period_s`` that of its set-points (None: one per
    sample). Whether a sensor repeats its reading is checked on the recorded samples.
    """

    window: Window
    settings: Identification
    axis: Axis | None = None
    sync_period_s: float | None = None
    recorded: Window | None = None

    @property
    def setpoint_period_s(self) -> float:
        """The time from one set-point to the next."""
        return self.sync_period_s or self.window.dt_s

    @cached_property
    def sensors(self) -> Sequence[SensorSignal]:
        """The sensors as recorded, each with its resolution."""
        return collect_sensors(self.recorded or self.window)

    @property
    def varying_sensors(self) -> Sequence[SensorSignal]:
        """The sensors that must vary during the move; in a laboratory the voltage may be constant on purpose."""
        return [sensor for sensor in self.sensors if self.window.is_rapid or sensor.name != "voltage"]

    @property
    def has_voltage(self) -> bool:
        """Whether the window has a voltage, of the drive or of a slow sensor."""
        return self.window.voltage_v is not None or self.window.slow_voltage is not None

    @cached_property
    def noise(self) -> NoiseLevels:
        """The noise of the three sensors."""
        return estimate_noise_levels(self.window)

    @cached_property
    def motion_range(self) -> tuple[int, int]:
        """The half-open range of samples of the move itself."""
        return find_moving_range(self.window)

    @cached_property
    def standstill(self) -> Bool:
        """The samples (n,) in which the table stands still, by position and smoothed speed."""
        window = self.window
        position = fill_forward(window.position_mm)
        reach = max(1, round(STILL_S / window.dt_s))
        ahead, behind = np.roll(position, -reach), np.roll(position, reach)
        still = (np.abs(ahead - position) < STILL_MM) & (np.abs(behind - position) < STILL_MM)
        still[:reach] &= np.abs(position[:reach] - position[0]) < STILL_MM
        still[-reach:] &= np.abs(position[-reach:] - position[-1]) < STILL_MM
        slow = np.abs(smooth_samples(window.speed_rad_s, window.dt_s)) < STILL_SHARE * window.rapid_speed_rad_s
        return still & slow & np.isfinite(window.speed_rad_s)

    @cached_property
    def backlash(self) -> DeadBand | None:
        """The backlash that the window shows."""
        return detect_backlash(self.window)

    def get_time_s(self, sample: int) -> float:
        """Return the time of a sample in its recording."""
        return self.window.start_s + sample * self.window.dt_s
