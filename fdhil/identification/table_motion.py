"""Models sensors at the table with two masses on a spring, linear in all but resonance and damping.

With q the table's share of the inertia J, w and z the resonance with the motor free and its damping, a and t the
positions of motor and table and T the motor's torque less friction:

    table         (s^2 + 2 z' w' s + w'^2) t = (2 z' w' s + w'^2) a        w' = w sqrt(1 - q), z' = z sqrt(1 - q)
    bend          a - t = T / (J (1 - q)) F                                F = 1 / (s^2 + 2 z w s + w^2)
    acceleration  s^2 t = T / J (2 z w s + w^2) F
    motor         s a   = T / J (1 / s + q / (1 - q) s F)

w' and z' are those of the table with the motor held. While the table moves one way its friction is constant or follows
speed and angle, so the friction's bend, the vibration since breakaway, the sensors' offsets and the screw's pitch error
are linear. Noise of the motor's own sensors passes through the same response; its power is known and whitened: maximum
likelihood of a system with a noisy input.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fdhil.identification.filtering import filter_zero_phase, find_fft_size
from fdhil.identification.prepared_motion import find_resolution
from fdhil.identification.rapid_windows import estimate_noise_std, find_longest_run, interpolate_gaps, smooth_samples
from fdhil.records import Bool, Float, Parameters, Window

Complex = npt.NDArray[np.complex128]

MOVING = 0.15  # of the top speed: below it friction changes with speed
LEAST_ROWS = 80
FINEST = 0.03  # of the encoder's noise: least noise of the speed
NIL = 1e-9


@dataclass(frozen=True, slots=True)
class MotorMotion:
    """The motor's motion, (n,) samples dt apart, and the ``rows`` in which the table surely moves one way.

    ``push`` is the torque per inertia, mm/s2 at the table. ``steps`` and ``pushes`` are the spectra of the position's
    steps and of the detrended ``push``. ``place_noise`` is the power of the position's noise (mm2 a sample) by
    frequency.
    """

    dt_s: float
    place_mm: Float
    speed_mm_s: Float
    turns: Float  # angle of the shaft, rad
    push: Float
    rows: Bool
    omega: Float
    steps: Complex
    pushes: Complex
    place_noise: Float

    @classmethod
    def from_window(cls, window: Window, parameters: Parameters) -> MotorMotion | None:
        """Return the motor's motion in a window; None with too few samples or without the torque's scale."""
        dt, mm_per_rad = window.dt_s, window.pitch_mm / (2 * math.pi)
        known = np.isfinite(window.speed_rad_s) & np.isfinite(window.position_mm) & np.isfinite(window.current_a)
        scale = parameters.K / parameters.Jt * mm_per_rad if parameters.Jt else math.nan
        if np.count_nonzero(known) < LEAST_ROWS or not math.isfinite(scale):
            return None
        speed, push = interpolate_gaps(window.speed_rad_s) * mm_per_rad, interpolate_gaps(window.current_a) * scale
        size = 2 * find_fft_size(speed.size)  # even, for the inverse transform
        place, noise = _estimate_position(interpolate_gaps(window.position_mm), speed, dt, size)
        slow = smooth_samples(speed, dt)
        first, last = find_longest_run(known & (window.direction * slow > MOVING * np.abs(slow).max()))
        rows = np.zeros(place.size, np.bool_)
        rows[first:last] = True
        omega = np.asarray(2 * math.pi * np.fft.rfftfreq(size, dt), dtype=np.float64)
        steps, pushes = np.fft.rfft(np.diff(place), size), np.fft.rfft(push - _interpolate_ends(push), size)
        return cls(dt, place, speed, place / mm_per_rad, push, rows, omega, steps, pushes, noise)

    def filter_travel(self, gain: Complex, steady_s: float, rows: Bool) -> Float:
        """Return (m,) the motor's travel, mm, through a gain that is ``steady_s`` s at low frequency."""
        step = np.exp(1j * self.omega * self.dt_s) - 1.0
        step[0] = 1.0
        through = gain / step
        through[0] = steady_s / self.dt_s
        return self._select_rows(self.steps * through, rows)

    def filter_torque(self, gain: Complex, rows: Bool) -> Float:
        """Return (m,) the torque per inertia through a system with this gain."""
        return self._select_rows(self.pushes * gain, rows) + float(gain[0].real) * _interpolate_ends(self.push)[rows]

    def _select_rows(self, spectrum: Complex, rows: Bool) -> Float:
        return np.fft.irfft(spectrum, 2 * (self.omega.size - 1))[: rows.size][rows]

    def compute_time_s(self, rows: Bool) -> Float:
        """Return (m,) seconds since the first of some samples."""
        return np.asarray(self.dt_s * (np.flatnonzero(rows) - int(np.argmax(rows))), dtype=np.float64)

    def build_disturbance_columns(self, rows: Bool) -> list[Float]:
        """Return regressors of an offset, and of friction and pitch error by speed and angle."""
        turns = self.turns[rows]
        return [np.ones(turns.size), self.speed_mm_s[rows], np.sin(turns), np.cos(turns)]


def _interpolate_ends(values: Float) -> Float:
    return np.asarray(np.linspace(values[0], values[-1], values.size), dtype=np.float64)


def _estimate_position(position_mm: Float, speed_mm_s: Float, dt: float, size: int) -> tuple[Float, Float]:
    """Return the motor's position (n,), slow parts from the encoder and fast ones from the speed, and its noise power.

    The integrated speed drifts, so the encoder's position takes over below the frequency where both noises are equal.
    """
    w = np.concatenate([speed_mm_s[:1], speed_mm_s, speed_mm_s[-1:]])
    summed = np.concatenate([[0.0], np.cumsum(dt / 24 * (13 * (w[1:-2] + w[2:-1]) - w[:-3] - w[3:]))])
    fine = estimate_noise(position_mm)
    rough = max(dt * estimate_noise_std(speed_mm_s), FINEST * fine)
    if rough > 2.0 * fine:
        return position_mm, np.full(size // 2 + 1, fine**2)
    corner = math.asin(0.5 * rough / fine) / (math.pi * dt)
    impulse = np.zeros(size)
    impulse[size // 2] = 1.0
    share = np.abs(np.fft.rfft(filter_zero_phase(impulse, corner, dt)))
    swing = np.maximum(2 * np.sin(math.pi * np.fft.rfftfreq(size)), NIL)
    power = (share * fine) ** 2 + ((1.0 - share) * rough / swing) ** 2
    return summed + filter_zero_phase(position_mm - summed, corner, dt), power


def estimate_noise(values: Float) -> float:
    """Return the standard deviation of a signal's noise, at least that of its resolution."""
    known = values[np.isfinite(values)]
    return max(estimate_noise_std(known), find_resolution(known) / math.sqrt(12.0), NIL)


def compute_flexible_response(omega: Float, w: float, z: float) -> Complex:
    """Return F, 1 / (s^2 + 2 z w s + w^2), at angular frequencies (n,)."""
    s = 1j * omega
    return np.asarray(1.0 / (s * s + 2 * z * w * s + w * w), dtype=np.complex128)


def build_decay_columns(time_s: Float, w: float, z: float) -> Float:
    """Return regressors (m, 2) of the free vibration since the first sample."""
    turning, fades = w * math.sqrt(max(1.0 - z * z, 1e-6)) * time_s, np.exp(-z * w * time_s)
    return np.column_stack([fades * np.cos(turning), fades * np.sin(turning)])


def compute_white_residuals(readings: Float, columns: Float, power: Float) -> Float:
    """Return the residuals (m,) after regression on columns (m, k), in deviations of noise of this power.

    They are whitened by the inverse of the noise's minimum-phase factor, computed by its cepstrum (Oppenheim and
    Schafer).
    """
    size = 2 * (power.size - 1)
    cepstrum = np.fft.irfft(np.log(power), size)[: size // 2]
    cepstrum[0] *= 0.5
    undone = np.exp(-np.fft.rfft(cepstrum, size))
    both = np.column_stack([columns, readings])
    white = np.fft.irfft(np.fft.rfft(both, size, axis=0) * undone[:, None], size, axis=0)[: readings.size]
    q, _ = np.linalg.qr(white[:, :-1] / np.linalg.norm(white[:, :-1], axis=0))
    return white[:, -1] - q @ (q.T @ white[:, -1])


@dataclass(frozen=True, slots=True)
class TableEncoder:
    """An encoder at the table: ``readings`` (m,) mm at its ``rows``, with the deviation ``noise_std`` of its noise."""

    motor: MotorMotion
    readings: Float
    rows: Bool
    noise_std: float

    def compute_stiff_residuals(self, late_s: float, power: Float | None = None) -> Float:
        """Return the residuals with a rigid screw, in its own noise or of another ``power``."""
        moved = self.motor.place_mm[self.rows] - self.motor.filter_travel(
            self._compute_lag_response(late_s), late_s, self.rows
        )
        own = self.motor.place_noise + self.noise_std**2
        return compute_white_residuals(
            self.readings - moved, self._build_linear_columns(), own if power is None else power
        )

    def compute_follow_residuals(self, w: float, z: float, late_s: float) -> Float:
        """Return the residuals of a table that follows the motor; ``w`` and ``z`` are those with the motor held."""
        motor, rows = self.motor, self.rows
        pulled = (2j * z * w * motor.omega + w * w) * compute_flexible_response(motor.omega, w, z)
        lags = motor.filter_travel(1.0 - pulled * (1.0 - self._compute_lag_response(late_s)), late_s, rows)
        columns = np.column_stack([build_decay_columns(motor.compute_time_s(rows), w, z), self._build_linear_columns()])
        return compute_white_residuals(
            self.readings - motor.place_mm[rows] + lags, columns, self.compute_noise_power(w, z)
        )

    def compute_noise_power(self, w: float, z: float) -> Float:
        """Return the power of its noise and of the motor position's through the response, a sample."""
        pulled = (2j * z * w * self.motor.omega + w * w) * compute_flexible_response(self.motor.omega, w, z)
        return np.abs(pulled) ** 2 * self.motor.place_noise + self.noise_std**2

    def compute_bend_residuals(self, w: float, z: float, q: float) -> Float:
        """Return the residuals of a table bent by the torque; ``w`` and ``z`` with the motor free."""
        motor, rows = self.motor, self.rows
        gain = compute_flexible_response(motor.omega, w, z) / (1.0 - q)
        columns = np.column_stack([build_decay_columns(motor.compute_time_s(rows), w, z), self._build_linear_columns()])
        power = np.abs(gain) ** 2 * estimate_noise_std(motor.push) ** 2 + motor.place_noise + self.noise_std**2
        return compute_white_residuals(
            motor.place_mm[rows] - self.readings - motor.filter_torque(gain, rows), columns, power
        )

    def _compute_lag_response(self, late_s: float) -> Complex:
        return np.asarray(1.0 - np.exp(-1j * self.motor.omega * late_s), dtype=np.complex128)

    def _build_linear_columns(self) -> Float:
        return np.column_stack([self.motor.turns[self.rows], *self.motor.build_disturbance_columns(self.rows)])


@dataclass(frozen=True, slots=True)
class TableAccelerometer:
    """An accelerometer at the table, ``readings`` (m,) mm/s2 at its ``rows``; its gain is known to a few per cent."""

    motor: MotorMotion
    readings: Float
    rows: Bool
    noise_std: float

    def compute_stiff_residuals(self, late_s: float, power: Float | None = None) -> Float:
        """Return the residuals with a rigid screw, in its own noise or of another ``power``."""
        own = np.full(self.motor.omega.size, self.noise_std**2)
        return self._compute_sensor_residuals(
            np.exp(-1j * self.motor.omega * late_s), [], own if power is None else power
        )

    def compute_follow_residuals(self, w: float, z: float, late_s: float) -> Float:
        """Return the residuals of a table moved by the torque; ``w`` and ``z`` are those with the motor free."""
        omega = self.motor.omega
        pulled = (2j * z * w * omega + w * w) * compute_flexible_response(omega, w, z) * np.exp(-1j * omega * late_s)
        return self._compute_sensor_residuals(
            pulled, [build_decay_columns(self.motor.compute_time_s(self.rows), w, z)], self.compute_noise_power(w, z)
        )

    def compute_noise_power(self, w: float, z: float) -> Float:
        """Return the power of its noise and of the current's through the response, a sample."""
        pulled = (2j * z * w * self.motor.omega + w * w) * compute_flexible_response(self.motor.omega, w, z)
        return np.abs(pulled) ** 2 * estimate_noise_std(self.motor.push) ** 2 + self.noise_std**2

    def _compute_sensor_residuals(self, gain: Complex, more: list[Float], power: Float) -> Float:
        motor, rows = self.motor, self.rows
        turns, speed = motor.turns[rows], motor.speed_mm_s[rows]
        waves = [speed**2 * np.sin(turns), speed**2 * np.cos(turns)]
        columns = np.column_stack(
            [motor.filter_torque(gain, rows), *more, *motor.build_disturbance_columns(rows), *waves]
        )
        return compute_white_residuals(self.readings, columns, power)


def compute_shaft_residuals(motor: MotorMotion, w: float, z: float, q: float) -> Float:
    """Return the residuals (m,) of the motor's speed with a table of inertia share ``q`` on a spring."""
    rows, s = motor.rows, 1j * motor.omega
    driven = motor.dt_s * np.cumsum(motor.push)[rows] + q / (1.0 - q) * motor.filter_torque(
        s * compute_flexible_response(motor.omega, w, z), rows
    )
    turns, time_s = motor.turns[rows], motor.compute_time_s(rows)
    own = [np.ones(turns.size), time_s, turns, np.sin(turns), np.cos(turns)]
    columns = np.column_stack([driven, build_decay_columns(time_s, w, z), *own])
    s = np.maximum(motor.omega, motor.omega[1]) * 1j
    gain = 1.0 / s + q / (1.0 - q) * s * compute_flexible_response(motor.omega, w, z)
    power = np.abs(gain) ** 2 * estimate_noise_std(motor.push) ** 2 + estimate_noise_std(motor.speed_mm_s) ** 2
    return compute_white_residuals(motor.speed_mm_s[rows], columns, power)
