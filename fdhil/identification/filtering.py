"""The paper's low-pass: the same filter on every signal keeps the identification unbiased ([DES] eq. 8)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.signal import butter, sosfiltfilt

from fdhil.records import Float

ORDER = 4
REACH_SHARE = 0.01


@lru_cache(maxsize=32)
def _sections(lowpass_hz: float, dt_s: float) -> Float:
    corner = min(lowpass_hz * dt_s * 2, 0.95)
    sections: Float = butter(ORDER, corner, output="sos")
    return sections


def zero_phase(values: Float, lowpass_hz: float, dt_s: float) -> Float:
    """Return ``values`` (..., n) through a Butterworth low-pass run forward and backward: no delay, squared gain."""
    sections = _sections(lowpass_hz, dt_s)
    padding = min(values.shape[-1] - 1, round(3 / lowpass_hz / dt_s))
    filtered: Float = sosfiltfilt(sections, values, padlen=padding)
    return filtered


@lru_cache(maxsize=32)
def impulse_response(lowpass_hz: float, dt_s: float) -> Float:
    """Return what the low-pass makes of one sample, centred (odd length)."""
    half = max(8, round(6 / lowpass_hz / dt_s))
    impulse = np.zeros(2 * half + 1)
    impulse[half] = 1.0
    answer: Float = sosfiltfilt(_sections(lowpass_hz, dt_s), impulse, padlen=0)
    return answer


@lru_cache(maxsize=32)
def reach(lowpass_hz: float, dt_s: float) -> int:
    """Return how many rows to either side the filter mixes into one: beyond it lies 1 % of its impulse response."""
    answer = np.abs(impulse_response(lowpass_hz, dt_s))
    half = answer.size // 2
    beyond = answer[half:][::-1].cumsum()[::-1] * 2 - answer[half]
    return int(np.argmax(beyond <= REACH_SHARE * answer.sum()))
