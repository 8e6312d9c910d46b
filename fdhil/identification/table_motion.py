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

from fdhil.identification.filtering import quick_size, zero_phase
from fdhil.identification.motion import resolution
from fdhil.identification.windows import bridged, longest, noise_of, smooth
from fdhil.records import Bool, Float, Parameters, Window

Complex = npt.NDArray[np.complex128]

MOVING = 0.15  # of the top speed: below it friction changes with speed
LEAST_ROWS = 80
FINEST = 0.03  # of the encoder's noise: least noise of the speed
NIL = 1e-9


@dataclass(frozen=True, slots=True)
class Motor:
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
    def of(cls, window: Window, parameters: Parameters) -> Motor | None:
        """Return the motor's motion in a window; None with too few samples or without the torque's scale."""
        dt, mm_per_rad = window.dt_s, window.pitch_mm / (2 * math.pi)
        known = np.isfinite(window.speed_rad_s) & np.isfinite(window.position_mm) & np.isfinite(window.current_a)
        scale = parameters.K / parameters.Jt * mm_per_rad if parameters.Jt else math.nan
        if np.count_nonzero(known) < LEAST_ROWS or not math.isfinite(scale):
            return None
        speed, push = bridged(window.speed_rad_s) * mm_per_rad, bridged(window.current_a) * scale
        size = 2 * quick_size(speed.size)  # even, for the inverse transform
        place, noise = _place(bridged(window.position_mm), speed, dt, size)
        slow = smooth(speed, dt)
        first, last = longest(known & (window.direction * slow > MOVING * np.abs(slow).max()))
        rows = np.zeros(place.size, np.bool_)
        rows[first:last] = True
        omega = np.asarray(2 * math.pi * np.fft.rfftfreq(size, dt), dtype=np.float64)
        steps, pushes = np.fft.rfft(np.diff(place), size), np.fft.rfft(push - _line(push), size)
        return cls(dt, place, speed, place / mm_per_rad, push, rows, omega, steps, pushes, noise)

    def way(self, gain: Complex, steady_s: float, rows: Bool) -> Float:
        """Return (m,) the motor's travel, mm, through a gain that is ``steady_s`` s at low frequency."""
        step = np.exp(1j * self.omega * self.dt_s) - 1.0
        step[0] = 1.0
        through = gain / step
        through[0] = steady_s / self.dt_s
        return self._rows(self.steps * through, rows)

    def pushed(self, gain: Complex, rows: Bool) -> Float:
        """Return (m,) the torque per inertia through a system with this gain."""
        return self._rows(self.pushes * gain, rows) + float(gain[0].real) * _line(self.push)[rows]

    def _rows(self, spectrum: Complex, rows: Bool) -> Float:
        return np.fft.irfft(spectrum, 2 * (self.omega.size - 1))[: rows.size][rows]

    def time(self, rows: Bool) -> Float:
        """Return (m,) seconds since the first of some samples."""
        return np.asarray(self.dt_s * (np.flatnonzero(rows) - int(np.argmax(rows))), dtype=np.float64)

    def beside(self, rows: Bool) -> list[Float]:
        """Return regressors of an offset, and of friction and pitch error by speed and angle."""
        turns = self.turns[rows]
        return [np.ones(turns.size), self.speed_mm_s[rows], np.sin(turns), np.cos(turns)]


def _line(values: Float) -> Float:
    return np.asarray(np.linspace(values[0], values[-1], values.size), dtype=np.float64)


def _place(position_mm: Float, speed_mm_s: Float, dt: float, size: int) -> tuple[Float, Float]:
    """Return the motor's position (n,), slow parts from the encoder and fast ones from the speed, and its noise power.

    The integrated speed drifts, so the encoder's position takes over below the frequency where both noises are equal.
    """
    w = np.concatenate([speed_mm_s[:1], speed_mm_s, speed_mm_s[-1:]])
    summed = np.concatenate([[0.0], np.cumsum(dt / 24 * (13 * (w[1:-2] + w[2:-1]) - w[:-3] - w[3:]))])
    fine = noise(position_mm)
    rough = max(dt * noise_of(speed_mm_s), FINEST * fine)
    if rough > 2.0 * fine:
        return position_mm, np.full(size // 2 + 1, fine**2)
    corner = math.asin(0.5 * rough / fine) / (math.pi * dt)
    impulse = np.zeros(size)
    impulse[size // 2] = 1.0
    share = np.abs(np.fft.rfft(zero_phase(impulse, corner, dt)))
    swing = np.maximum(2 * np.sin(math.pi * np.fft.rfftfreq(size)), NIL)
    power = (share * fine) ** 2 + ((1.0 - share) * rough / swing) ** 2
    return summed + zero_phase(position_mm - summed, corner, dt), power


def noise(values: Float) -> float:
    """Return the standard deviation of a signal's noise, at least that of its resolution."""
    known = values[np.isfinite(values)]
    return max(noise_of(known), resolution(known) / math.sqrt(12.0), NIL)


def flexible(omega: Float, w: float, z: float) -> Complex:
    """Return F, 1 / (s^2 + 2 z w s + w^2), at angular frequencies (n,)."""
    s = 1j * omega
    return np.asarray(1.0 / (s * s + 2 * z * w * s + w * w), dtype=np.complex128)


def swings(time_s: Float, w: float, z: float) -> Float:
    """Return regressors (m, 2) of the free vibration since the first sample."""
    turning, fades = w * math.sqrt(max(1.0 - z * z, 1e-6)) * time_s, np.exp(-z * w * time_s)
    return np.column_stack([fades * np.cos(turning), fades * np.sin(turning)])


def left(readings: Float, columns: Float, power: Float) -> Float:
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
class Encoder:
    """An encoder at the table: ``readings`` (m,) mm at its ``rows``, with the deviation ``noise_std`` of its noise."""

    motor: Motor
    readings: Float
    rows: Bool
    noise_std: float

    def stiff(self, late_s: float, power: Float | None = None) -> Float:
        """Return the residuals with a rigid screw, in its own noise or of another ``power``."""
        moved = self.motor.place_mm[self.rows] - self.motor.way(self._late(late_s), late_s, self.rows)
        own = self.motor.place_noise + self.noise_std**2
        return left(self.readings - moved, self._linear(), own if power is None else power)

    def follows(self, w: float, z: float, late_s: float) -> Float:
        """Return the residuals of a table that follows the motor; ``w`` and ``z`` are those with the motor held."""
        motor, rows = self.motor, self.rows
        pulled = (2j * z * w * motor.omega + w * w) * flexible(motor.omega, w, z)
        lags = motor.way(1.0 - pulled * (1.0 - self._late(late_s)), late_s, rows)
        columns = np.column_stack([swings(motor.time(rows), w, z), self._linear()])
        return left(self.readings - motor.place_mm[rows] + lags, columns, self.power(w, z))

    def power(self, w: float, z: float) -> Float:
        """Return the power of its noise and of the motor position's through the response, a sample."""
        pulled = (2j * z * w * self.motor.omega + w * w) * flexible(self.motor.omega, w, z)
        return np.abs(pulled) ** 2 * self.motor.place_noise + self.noise_std**2

    def bends(self, w: float, z: float, q: float) -> Float:
        """Return the residuals of a table bent by the torque; ``w`` and ``z`` with the motor free."""
        motor, rows = self.motor, self.rows
        gain = flexible(motor.omega, w, z) / (1.0 - q)
        columns = np.column_stack([swings(motor.time(rows), w, z), self._linear()])
        power = np.abs(gain) ** 2 * noise_of(motor.push) ** 2 + motor.place_noise + self.noise_std**2
        return left(motor.place_mm[rows] - self.readings - motor.pushed(gain, rows), columns, power)

    def _late(self, late_s: float) -> Complex:
        return np.asarray(1.0 - np.exp(-1j * self.motor.omega * late_s), dtype=np.complex128)

    def _linear(self) -> Float:
        return np.column_stack([self.motor.turns[self.rows], *self.motor.beside(self.rows)])


@dataclass(frozen=True, slots=True)
class Accelerometer:
    """An accelerometer at the table, ``readings`` (m,) mm/s2 at its ``rows``; its gain is known to a few per cent."""

    motor: Motor
    readings: Float
    rows: Bool
    noise_std: float

    def stiff(self, late_s: float, power: Float | None = None) -> Float:
        """Return the residuals with a rigid screw, in its own noise or of another ``power``."""
        own = np.full(self.motor.omega.size, self.noise_std**2)
        return self._left(np.exp(-1j * self.motor.omega * late_s), [], own if power is None else power)

    def follows(self, w: float, z: float, late_s: float) -> Float:
        """Return the residuals of a table moved by the torque; ``w`` and ``z`` are those with the motor free."""
        omega = self.motor.omega
        pulled = (2j * z * w * omega + w * w) * flexible(omega, w, z) * np.exp(-1j * omega * late_s)
        return self._left(pulled, [swings(self.motor.time(self.rows), w, z)], self.power(w, z))

    def power(self, w: float, z: float) -> Float:
        """Return the power of its noise and of the current's through the response, a sample."""
        pulled = (2j * z * w * self.motor.omega + w * w) * flexible(self.motor.omega, w, z)
        return np.abs(pulled) ** 2 * noise_of(self.motor.push) ** 2 + self.noise_std**2

    def _left(self, gain: Complex, more: list[Float], power: Float) -> Float:
        motor, rows = self.motor, self.rows
        turns, speed = motor.turns[rows], motor.speed_mm_s[rows]
        waves = [speed**2 * np.sin(turns), speed**2 * np.cos(turns)]
        columns = np.column_stack([motor.pushed(gain, rows), *more, *motor.beside(rows), *waves])
        return left(self.readings, columns, power)


def shaft(motor: Motor, w: float, z: float, q: float) -> Float:
    """Return the residuals (m,) of the motor's speed with a table of inertia share ``q`` on a spring."""
    rows, s = motor.rows, 1j * motor.omega
    driven = motor.dt_s * np.cumsum(motor.push)[rows] + q / (1.0 - q) * motor.pushed(
        s * flexible(motor.omega, w, z), rows
    )
    turns, time_s = motor.turns[rows], motor.time(rows)
    own = [np.ones(turns.size), time_s, turns, np.sin(turns), np.cos(turns)]
    columns = np.column_stack([driven, swings(time_s, w, z), *own])
    s = np.maximum(motor.omega, motor.omega[1]) * 1j
    gain = 1.0 / s + q / (1.0 - q) * s * flexible(motor.omega, w, z)
    power = np.abs(gain) ** 2 * noise_of(motor.push) ** 2 + noise_of(motor.speed_mm_s) ** 2
    return left(motor.speed_mm_s[rows], columns, power)
