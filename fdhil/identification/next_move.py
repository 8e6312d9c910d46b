"""Predicts which further move narrows the intervals of an estimate most, by the information of [1] and [2].

Each sample adds the information of its regressors, divided by the variance of the equation due to sensor noise ([LJU]
ch. 13). Moves are simulated with the estimated model, within the voltage of the recording.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from fdhil.identification.normal_equations import invert_symmetric
from fdhil.identification.prepared_motion import NoiseLevels, estimate_noise_levels
from fdhil.identification.rapid_windows import fill_forward
from fdhil.model import simulate_plant
from fdhil.records import PARAMETERS, Estimate, Float, Parameters, Window

MOVES: Mapping[str, Callable[[Float], Float]] = {  # share (n,) of the voltage over that of the time
    "steps of voltage in both directions": lambda t: np.array([0.0, 0.5, 1.0, -1.0, -0.5, 0.0])[(t * 6).astype(int)],
    "fast chirp about half the voltage": lambda t: 0.5 + 0.5 * np.sin(2 * np.pi * (2.0 + 60.0 * t) * t),
    "slowly in both directions": lambda t: np.where(t < 0.5, 0.15, -0.15),
    "long at full speed in both directions": lambda t: np.where(t < 0.5, 1.0, -1.0),
}


@dataclass(frozen=True)
class NextMove:
    """A further move, and the share of the present interval that remains at least for each parameter."""

    name: str
    shares: Mapping[str, float]


def predict_next_moves(window: Window, estimate: Estimate) -> list[NextMove]:
    """Return for each move, as long as the window, the remaining intervals; the same recording again comes first.

    The part of the intervals that sensor noise does not explain remains in any case.
    """
    if window.voltage_v is None:
        return []
    parameters, noise = estimate.build_parameters(), estimate_noise_levels(window)
    current, speed = fill_forward(window.current_a), fill_forward(window.speed_rad_s)
    now = compute_information(parameters, noise, window.dt_s, current, speed)
    known = np.diag(invert_symmetric(now)[0])
    stays = np.maximum(np.square([estimate.get_std(name) for name in PARAMETERS]) - known, 0.0)

    def compute_remaining_shares(variances: Float) -> Mapping[str, float]:
        return dict(zip(PARAMETERS, np.sqrt((variances + stays) / (known + stays)).tolist(), strict=True))

    moves = [NextMove("the same recording again", compute_remaining_shares(0.5 * known))]
    top_v, share = float(np.nanmax(np.abs(window.voltage_v))), np.arange(window.n) / window.n
    for name, course in MOVES.items():
        current, speed = simulate_plant(parameters, top_v * course(share), window.dt_s, "interval_mean")
        after = invert_symmetric(now + compute_information(parameters, noise, window.dt_s, current, speed))[0]
        moves.append(NextMove(name, compute_remaining_shares(np.diag(after))))
    return moves


def compute_information(p: Parameters, noise: NoiseLevels, dt_s: float, current: Float, speed: Float) -> Float:
    """Return the information (6, 6) on R, L, K, Jt, ft, Cd of a move's current (n,) and speed (n,)."""
    di, dw, zero = np.gradient(current, dt_s), np.gradient(speed, dt_s), np.zeros(current.size)
    slope_i, slope_w = np.sqrt(2.0) * noise.current_a / dt_s, np.sqrt(2.0) * noise.speed_rad_s / dt_s
    parts = (noise.voltage_v, p.R * noise.current_a, p.L * slope_i, p.K * noise.speed_rad_s)
    electrical = np.column_stack([current, di, speed, zero, zero, zero]) / np.linalg.norm(parts)
    moving = np.abs(speed) > 0.02 * np.abs(speed).max()
    torque = np.column_stack([zero, zero, -current, dw, speed, np.sign(speed)])[moving]
    mechanical = torque / np.linalg.norm((p.K * noise.current_a, p.Jt * slope_w))
    return np.asarray(electrical.T @ electrical + mechanical.T @ mechanical, dtype=np.float64)
