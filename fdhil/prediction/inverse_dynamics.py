"""What a path demands of a drive, by inverse dynamics: [DES] eqs. 1 and 2 turned around."""

from __future__ import annotations

import numpy as np

from fdhil.config import Axis
from fdhil.records import Float, Parameters


def required(reference_mm: Float, parameters: Parameters, axis: Axis, dt_s: float) -> tuple[Float, Float]:
    """Return the current and voltage (n,) that follow ``reference_mm`` (n,) exactly, as shares of their limits."""
    p = parameters
    speed = np.gradient(reference_mm, dt_s) * 2 * np.pi / axis.screw_pitch_mm
    acceleration = np.gradient(speed, dt_s)
    moving = np.abs(speed) > 1e-9 * max(1.0, float(np.abs(speed).max()))
    current = (p.Jt * acceleration + p.ft * speed + p.Cd * np.where(moving, np.sign(speed), 0.0)) / p.K
    # dry friction's steps are left out of di/dt: the current loop takes them in a fraction of a cycle
    slope = np.gradient((p.Jt * acceleration + p.ft * speed) / p.K, dt_s)
    voltage = p.L * slope + p.R * current + p.K * speed
    return (
        np.asarray(np.abs(current) / axis.regulators.current_limit_a),
        np.asarray(np.abs(voltage) / axis.regulators.voltage_limit_v),
    )
