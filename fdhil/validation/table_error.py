"""Converts an unmodelled torque to its error at the table, in micrometres, through the position loop.

With an ideal current loop, speed demand Kv e + Ki int e and a PI on speed, a torque d moves the shaft by

theta / d = s^2 / (Jt s^4 + ft s^3 + K (kp s + ki) (s^2 + Kv s + Ki))

(the loop's integrator removes a constant torque: a load matters where it steps, a ripple near the loop's corner). Only
the integral of a torque is needed, the momentum in N.m.s: no signal is differentiated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdhil.config import Axis
from fdhil.identification.filtering import quick_size
from fdhil.records import Float, Parameters

# of a drive with unknown regulators: corner of its speed loop, and its position gain
ORDINARY_SPEED_HZ, ORDINARY_KV = 30.0, 30.0
INTEGRAL_SHARE = 0.2  # of the speed loop's corner: the corner of its integral
SETTLED_S = 0.5  # by then a loop has settled: earlier torque has no effect
UM_PER_MM = 1e3


@dataclass(frozen=True, slots=True)
class TableError:
    """The loop of one axis about one drive: gains (A.s/rad, A/rad, 1/s, 1/s2) and mechanics, and um per rad."""

    inertia: float
    viscous: float
    torque_constant: float
    speed_kp: float
    speed_ki: float
    position_kv: float
    position_ki: float
    um_per_rad: float

    @classmethod
    def of(cls, parameters: Parameters, pitch_mm: float, axis: Axis | None) -> TableError:
        """Return the loop with the regulators of the axis' section, or with ordinary ones without a section."""
        to_um = UM_PER_MM * pitch_mm / (2 * math.pi)
        mechanics = parameters.Jt, max(parameters.ft, 0.0), parameters.K
        if axis is None:
            corner = 2 * math.pi * ORDINARY_SPEED_HZ
            kp = corner * parameters.Jt / parameters.K
            return cls(*mechanics, kp, INTEGRAL_SHARE * corner * kp, ORDINARY_KV, 0.0, to_um)
        g = axis.regulators
        return cls(*mechanics, g.speed_kp, g.speed_ki, g.position_gain_per_s, g.position_ki_per_s2, to_um)

    def response(self, size: int, dt_s: float) -> Float:
        """Return the complex gain from momentum (N.m.s) to the table (um) at the frequencies of ``size`` rows."""
        s = 2j * math.pi * np.fft.rfftfreq(size, dt_s)
        s[0] = 1e-9j  # a constant torque has no lasting effect
        speed, place = self.speed_kp * s + self.speed_ki, s * s + self.position_kv * s + self.position_ki
        free = self.inertia * s**4 + self.viscous * s**3
        gain: Float = self.um_per_rad * s**3 / (free + self.torque_constant * speed * place)
        return gain

    def um(self, momentum: Float, dt_s: float) -> Float:
        """Return the error at the table (q, n), um, by the integrals (q, n) of torques, N.m.s, rows dt apart."""
        n = momentum.shape[-1]
        settled = math.ceil(SETTLED_S / dt_s)
        size = quick_size(n + 3 * settled)
        # the transform is circular: the final momentum is held until the loop has settled, then faded out
        fading = np.cos(np.linspace(0.0, math.pi, settled)) / 2 + 0.5
        tail = np.concatenate([np.ones(settled), fading, np.zeros(size - n - 2 * settled)])
        whole = np.concatenate([momentum, momentum[..., -1:] * tail], axis=-1)
        out: Float = np.fft.irfft(np.fft.rfft(whole) * self.response(size, dt_s), size)[..., :n]
        return out

    def lasting_um(self, dt_s: float) -> float:
        """Return how far a step of 1 N.m moves the table before the loop has compensated it, um."""
        since: Float = dt_s * np.arange(math.ceil(SETTLED_S / dt_s), dtype=np.float64)
        return float(np.abs(self.um(since, dt_s)).max())

    def noise_um(self, white: float, walk: float, n: int, dt_s: float) -> float:
        """Return the RMS (um) by a momentum of white noise and one of a random walk, by their deviation per row."""
        size = quick_size(n + 3 * math.ceil(SETTLED_S / dt_s))
        power = np.abs(self.response(size, dt_s)[1:]) ** 2
        step = 2 * np.sin(math.pi * np.fft.rfftfreq(size)[1:])
        return math.sqrt(float(power @ (white**2 + (walk / step) ** 2)) * 2 / size)
