"""Computes the torque that a spring between motor and table adds to a rigid mass, over a window, in the frequency
domain.

With the masses (1 - s) Jt of the motor and s Jt of the table, a torque T on the motor and dry friction F at the table,
the motor accelerates by

    Jt a = G T - (1 - H) F        G = 1 + H s / (1 - s)        H = p^2 / (p^2 + 2 zeta w p + w^2)

where w = 2 pi f is the resonance of both against each other, the motor free to turn. Rigid masses have H = 0. All are
means over intervals: linear systems map means to means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fdhil.identification.filtering import find_fft_size
from fdhil.identification.kalman import CD, FT, JT, LOAD, K
from fdhil.identification.prepared_motion import Motion, TermRegressor
from fdhil.identification.term_regressors import FIRST_TERM
from fdhil.records import Float

Spectrum = npt.NDArray[np.complex128]

MOST_OF_ROWS, SEEN_ORDER = (
    0.16,
    12,
)  # periods per sample up to which a vibration is visible, and the order of that limit
RINGS_S = 0.5  # until a spring's vibration has decayed
LEAST_SHARE, MOST_SHARE = 0.1, 0.9
MOST_STEP = 0.25  # of f per step


@dataclass(frozen=True, slots=True)
class Spring:
    """A spring: its resonance f in Hz, the table's share s of the inertia, and its damping ratio."""

    hertz: float
    share: float
    damping: float

    def apply_step(self, hertz: float, share: float) -> Spring:
        """Return the spring moved in f and s, within physical limits."""
        near = float(np.clip(hertz, -MOST_STEP * self.hertz, MOST_STEP * self.hertz))
        part = float(np.clip(self.share + share, LEAST_SHARE, MOST_SHARE))
        return replace(self, hertz=self.hertz + near, share=part)


@dataclass(frozen=True, slots=True)
class SpringResponse:
    """Frequency response (w,) of a spring to torques: ``swing`` H and ``motor`` G.

    Current and acceleration both measure the torque on the motor, each with noise; ``of_current`` is the weight of the
    current. Where they differ, a rigid mass feels ``shaped`` of it: near the resonance, where the motor moves much, its
    acceleration decides, so that noise of the current is not taken for a vibration.
    """

    ratio: float
    swing: Spectrum
    motor: Spectrum
    of_current: Float

    @property
    def shaped(self) -> Spectrum:
        """The remaining share of a difference between the torques by current and by acceleration."""
        return (1.0 + self.ratio * self.swing * self.of_current) / self.motor

    @property
    def on_motor(self) -> Spectrum:
        """What a torque against the motor adds to itself."""
        return self.shaped * self.motor - 1.0

    @property
    def on_table(self) -> Spectrum:
        """What a torque against the table adds to itself."""
        return self.shaped * (1.0 - self.swing) - 1.0

    def compute_added_torque(self, motor: Spectrum, table: Spectrum) -> Spectrum:
        """Return the torque against the positive direction that the spring adds to torques on motor and table."""
        return -self.swing * (self.ratio * motor + table)


@dataclass(frozen=True, slots=True)
class SpringTorques:
    """Spectra (w,) of a window's torques, N.m, and the noise power of the motor's torque.

    ``motor`` is the current's torque less viscous friction, ``table`` the dry friction, both of the six alone, and
    ``..._whole`` with the terms; ``inertial`` is the torque of the acceleration. ``visible`` is the visible share of a
    vibration at the sampling rate.
    """

    n: int
    p: Spectrum
    motor: Spectrum
    table: Spectrum
    motor_whole: Spectrum
    table_whole: Spectrum
    inertial: Spectrum
    noise_current: Float
    noise_speed: Float
    visible: Float

    @classmethod
    def from_motion(cls, motion: Motion, theta: Float) -> SpringTorques:
        """Return the torques of a window; at standstill friction balances any torque."""
        moving, dt_s = np.abs(motion.mode) == 1, motion.dt_s
        motor = theta[K] * _average_neighbours(motion.current) - theta[FT] * _average_neighbours(motion.speed)
        held = np.clip(motor, -abs(theta[CD]), abs(theta[CD]))
        table = np.where(moving, theta[CD] * motion.mode, held)
        motor_whole, table_whole = motor.copy(), table.copy()
        for course, amplitude in zip(motion.courses, theta[FIRST_TERM:], strict=False):
            if course.kind == LOAD and is_motor_term(course):
                motor_whole -= amplitude * course.values
            elif course.kind == LOAD:
                table_whole += amplitude * course.values
        size = 2 * find_fft_size((motion.n + math.ceil(RINGS_S / dt_s) + 1) // 2)
        turn = np.asarray(2 * math.pi * np.fft.rfftfreq(size), dtype=np.float64)
        return cls(
            n=motion.n,
            p=(1j * turn / dt_s).astype(np.complex128),
            motor=_transform_signal(motor, size),
            table=_transform_signal(table, size),
            motor_whole=_transform_signal(motor_whole, size),
            table_whole=_transform_signal(table_whole, size),
            inertial=_transform_signal(theta[JT] * np.diff(motion.speed, append=motion.speed[-1]) / dt_s, size),
            noise_current=np.square(theta[K] * motion.noise.current_a * np.cos(turn / 2)),
            noise_speed=np.square(theta[JT] * motion.noise.speed_rad_s * 2 * np.sin(turn / 2) / dt_s),
            visible=np.asarray(1.0 / (1.0 + (turn / (2 * math.pi * MOST_OF_ROWS)) ** SEEN_ORDER), dtype=np.float64),
        )

    def compute_response(self, spring: Spring) -> SpringResponse:
        """Return a spring's frequency response."""
        ratio, swing = spring.share / (1.0 - spring.share), self._compute_swing(spring)
        motor = 1.0 + ratio * swing
        noise = np.square(np.abs(motor)) * self.noise_current
        return SpringResponse(ratio, swing, motor, self.noise_speed / np.maximum(self.noise_speed + noise, 1e-300))

    def _compute_swing(self, spring: Spring) -> Spectrum:
        w, square = 2 * math.pi * spring.hertz, self.p**2
        return self.visible * square / (square + (2 * spring.damping * w) * self.p + w**2)

    def combine_torque(self, answer: SpringResponse) -> Spectrum:
        """Return the torque on the motor, combined from current and acceleration."""
        by_motion = (self.inertial + self.table_whole * (1.0 - answer.swing)) / answer.motor
        return by_motion + answer.of_current * (self.motor_whole - by_motion)

    def predict_added_torques(self, springs: Sequence[Spring]) -> list[Float]:
        """Return the torque (n,) that each spring would add to a rigid mass."""
        still = Spring(springs[0].hertz, 0.0, springs[0].damping)
        motor = self.combine_torque(self.compute_response(still))
        ratios = [one.share / (1.0 - one.share) for one in springs]
        return [
            self.transform_back(-self._compute_swing(one) * (ratio * motor + self.table_whole))
            for one, ratio in zip(springs, ratios, strict=True)
        ]

    def compute_felt_torque(self, answer: SpringResponse) -> Float:
        """Return the torque (n,) that the spring adds by the six alone; the terms' regressors include their own."""
        own = (answer.shaped - 1.0) * self.inertial - answer.on_motor * self.motor + answer.on_table * self.table
        return self.transform_back(own)

    def compute_torque_difference(self, answer: SpringResponse, high: Spring, low: Spring) -> Float:
        """Return the torque (n,) by which two springs differ, linearised about the one with this response."""
        torque = self.combine_torque(answer)
        added = (self.compute_response(one).compute_added_torque(torque, self.table_whole) for one in (high, low))
        return self.transform_back(answer.shaped * (next(added) - next(added)))

    def compute_scaling_cost(self, answer: SpringResponse) -> float:
        """Return minus twice the log of the scaling of the innovations against those of a rigid mass.

        It corrects the likelihood, because the innovations are measured on another scale.
        """
        return -2.0 * self.n * float(np.log(np.maximum(np.abs(answer.shaped), 1e-12)).mean())

    def apply_response(self, course: TermRegressor, answer: SpringResponse) -> TermRegressor:
        """Return the regressor of a term as rigid masses would feel it."""
        if course.kind != LOAD:
            return course
        gain = answer.on_motor if is_motor_term(course) else answer.on_table
        return replace(
            course,
            values=course.values + self.transform_back(gain * _transform_signal(course.values, 2 * (self.p.size - 1))),
        )

    def transform_back(self, spectrum: Spectrum) -> Float:
        """Return the signal (n,) of a spectrum."""
        return np.fft.irfft(spectrum, 2 * (self.p.size - 1))[: self.n]


def is_motor_term(course: TermRegressor) -> bool:
    """Return whether a term acts on the motor: a ripple of the motor, or of the screw's bearing and nut."""
    return course.name.startswith("ripple")


def _transform_signal(values: Float, size: int) -> Spectrum:
    """Return the spectrum (w,) of a signal (n,), extended by a smooth return to its first value."""
    n = values.size
    whole = np.zeros(size)
    whole[:n] = values - values[0]
    whole[n:] = whole[n - 1] * (0.5 + 0.5 * np.cos(np.linspace(0.0, math.pi, size - n)))
    return np.fft.rfft(whole).astype(np.complex128)


def _average_neighbours(values: Float) -> Float:
    means: Float = (values + np.append(values[1:], values[-1])) / 2
    return means
