"""Computes the current and voltage that a path demands of a drive: [DES] eqs. 1 and 2 inverted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fdhil.config import Axis, MachineConfig
from fdhil.model import simulate_axis
from fdhil.prediction.model_variants import split_resisting_torque
from fdhil.records import Float, Parameters, Trajectory

SHARE_STEP = 2e-3  # resolution of the feasible feed


def compute_required_shares(
    reference_mm: Float, parameters: Parameters, axis: Axis, dt_s: float
) -> tuple[Float, Float]:
    """Return the current and voltage (n,) that follow ``reference_mm`` (n,) exactly, as shares of their limits."""
    p = parameters
    speed = np.gradient(reference_mm, dt_s) * 2 * np.pi / axis.screw_pitch_mm
    acceleration = np.gradient(speed, dt_s)
    moving = np.abs(speed) > 1e-9 * max(1.0, float(np.abs(speed).max()))
    angle = reference_mm * 2 * np.pi / axis.screw_pitch_mm
    smooth, dry = split_resisting_torque(p, np.where(moving, speed, 0.0), angle)
    current = (p.Jt * acceleration + smooth + dry) / p.K
    # dry friction's steps are left out of di/dt: the current loop takes them in a fraction of a cycle
    slope = np.gradient((p.Jt * acceleration + smooth) / p.K, dt_s)
    voltage = p.L * slope + p.R * current + p.K * speed
    return (
        np.asarray(np.abs(current) / axis.regulators.current_limit_a),
        np.asarray(np.abs(voltage) / axis.regulators.voltage_limit_v),
    )


def find_feasible_feed_share(reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig) -> float:
    """Return the largest share <= 1 of the feed at which no limit of any drive acts, to ``SHARE_STEP``.

    At a share of the feed an NC with fixed smoothing times commands the same share of speed and acceleration, so the
    path scaled by it shows the demand on the drives, dry friction included.
    """

    def is_feasible(share: float) -> bool:
        for axis, path in reference.position_mm.items():
            if np.ptp(path) == 0.0:
                continue
            scaled = path[0] + share * (path - path[0])
            if (
                max(
                    one.max()
                    for one in compute_required_shares(scaled, models[axis], config.axis[axis], reference.dt_s)
                )
                > 1.0
            ):
                return False
            if simulate_axis(models[axis], config.axis[axis], reference.dt_s, scaled).limited_s > 0.0:
                return False
        return True

    low, high = float(is_feasible(1.0)), 1.0
    while high - low > SHARE_STEP:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_feasible(middle) else (low, middle)
    return low
