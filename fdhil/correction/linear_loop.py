"""Treats the closed loop as a linear system: its delay, and its zero-phase inverse up to a bandwidth.

Away from the limits and from changes of the friction's sign the loop from offset to position is linear, whatever the
regulators: one simulated impulse describes it. Its inverse is regularised, so that it asks for nothing where the drive
does not respond, and it is applied to a recorded or planned error, so it may look ahead and need not delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fdhil.config import Axis
from fdhil.model import simulate_axis
from fdhil.prediction import linearise_model
from fdhil.records import Float, Parameters

BANDWIDTH_HZ = 120.0
REGULARISATION = 1e-3
RESONANCE_SHARE = 0.5  # of a resonance's frequency: near it a small model error inverts the response
IMPULSE_S = 1.0
AHEAD_S = 0.064  # of the impulse response before the impulse: the feed-forward looks ahead
PAD_S = 0.5
RAMP_MM_S, RAMP_S = 1.0, 1.5

Complex = npt.NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class LoopInverse:
    """The inverse of one axis' loop as a factor on the spectrum of an error."""

    factor: Complex
    size: int
    pad: int

    def compute_offset(self, error: Float) -> Float:
        """Return the offset (n,) that would undo ``error`` (n,) in the linear loop; what lies outside counts as 0."""
        padded = np.zeros(self.size)
        padded[self.pad : self.pad + error.size] = error
        back = np.fft.irfft(self.factor * np.fft.rfft(padded), self.size)
        return np.asarray(back[self.pad : self.pad + error.size])


def remove_limits(parameters: Parameters, axis: Axis, dry_nm: float = 0.0) -> tuple[Parameters, Axis]:
    """Return the linear part of the loop, without limits, and with another dry friction: without any it is linear."""
    free = axis.regulators.model_copy(update={"current_limit_a": 1e9, "voltage_limit_v": 1e9})
    return linearise_model(parameters, dry_nm), axis.model_copy(update={"regulators": free})


def measure_delay_s(parameters: Parameters, axis: Axis, sync_period_s: float) -> float:
    """Return by how much the loop lags at constant speed: 0 with full feed-forward, (1 - Kff) / Kv with less."""
    linear, free = remove_limits(parameters, axis)
    ramp = np.arange(round(RAMP_S / sync_period_s), dtype=np.float64) * (sync_period_s * RAMP_MM_S)
    response = simulate_axis(linear, free, sync_period_s, ramp)
    # the last rows depend on the reference beyond its end, where it is held
    return float((ramp[-8] - response.position_mm[-8]) / RAMP_MM_S)


def invert_loop(parameters: Parameters, axis: Axis, sync_period_s: float, rows: int) -> LoopInverse:
    """Return the regularised zero-phase inverse of the axis' loop for blocks of up to ``rows`` rows."""
    linear, free = remove_limits(parameters, axis)
    ahead = round(AHEAD_S / sync_period_s)
    impulse = np.zeros(ahead + round(IMPULSE_S / sync_period_s))
    impulse[ahead] = 1.0
    answer = simulate_axis(linear, free, sync_period_s, impulse).table_mm
    pad = round(PAD_S / sync_period_s)
    size = int(2 ** np.ceil(np.log2(rows + 2 * pad)))
    around = np.zeros(size)
    around[: min(size, answer.size)] = answer[:size]
    around = np.roll(around, -ahead)
    spectrum = np.fft.rfft(around)
    frequency = np.fft.rfftfreq(size, sync_period_s)
    bandwidth = min(BANDWIDTH_HZ, 0.2 / sync_period_s, RESONANCE_SHARE * parameters.get_term("resonance", np.inf))
    roll_off = 1 / (1 + (frequency / bandwidth) ** 4)
    gain = roll_off / (np.abs(spectrum) ** 2 + REGULARISATION)
    factor = np.asarray(np.conj(spectrum) * gain, dtype=np.complex128)
    return LoopInverse(factor, size, pad)
