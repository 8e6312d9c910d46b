"""Filters without phase shift: the paper's low-pass, and centred averages.

The same low-pass on every signal keeps the identification unbiased ([DES] eq. 8). It is written in numpy, because
importing scipy.signal takes a second, too long for the daemon's start.
"""

from functools import lru_cache

import numpy as np

from fdhil.records import Bool, Float

ORDER = 4
REACH_SHARE = 0.01
SPAN_PERIODS = 6  # of the corner's period: beyond it the impulse response is negligible
PADDING_PERIODS = 3


def filter_zero_phase(values: Float, lowpass_hz: float, dt_s: float) -> Float:
    """Return ``values`` (..., n) through a Butterworth low-pass run forward and backward: no delay, squared gain.

    The ends are extended by odd reflection, as usual for forward-backward filters.
    """
    n = values.shape[-1]
    pad = min(n - 1, round(PADDING_PERIODS / lowpass_hz / dt_s))
    if pad < 1:
        return values.copy()
    before = 2 * values[..., :1] - values[..., pad:0:-1]
    after = 2 * values[..., -1:] - values[..., -2 : -pad - 2 : -1]
    extended = np.concatenate([before, values, after], axis=-1)
    size = find_fft_size(extended.shape[-1])
    spectrum = np.fft.rfft(_extend_periodically(extended, size)) * _compute_butterworth_gain(size, lowpass_hz, dt_s)
    return np.fft.irfft(spectrum, size)[..., pad : pad + n]


def _extend_periodically(values: Float, size: int) -> Float:
    """Return ``values`` (..., m) extended to ``size`` by a line back to the first value: the FFT is periodic."""
    missing = size - values.shape[-1]
    share = np.linspace(0.0, 1.0, missing + 2)[1:-1]
    bridge = values[..., -1:] * (1.0 - share) + values[..., :1] * share
    return np.concatenate([values, bridge], axis=-1)


@lru_cache(maxsize=256)
def find_fft_size(least: int) -> int:
    """Return the smallest fast FFT size of at least ``least``: no prime factor above 5."""
    size = least
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return size
        size += 1


@lru_cache(maxsize=64)
def _compute_butterworth_gain(size: int, lowpass_hz: float, dt_s: float) -> Float:
    corner = np.tan(np.pi * min(lowpass_hz * dt_s, 0.475))
    # the bilinear transform's frequency axis; at the highest one the gain is 0
    axis = np.tan(np.minimum(np.pi * np.fft.rfftfreq(size), np.pi / 2 * (1 - 1e-9)))
    gain: Float = 1.0 / (1.0 + (axis / corner) ** (2 * ORDER))
    return gain


@lru_cache(maxsize=32)
def compute_impulse_response(lowpass_hz: float, dt_s: float) -> Float:
    """Return the centred impulse response of the low-pass (odd length)."""
    half = max(8, round(SPAN_PERIODS / lowpass_hz / dt_s))
    size = 2 * half + 1
    return np.roll(np.fft.irfft(_compute_butterworth_gain(size, lowpass_hz, dt_s), size), half)


@lru_cache(maxsize=32)
def compute_filter_reach(lowpass_hz: float, dt_s: float) -> int:
    """Return the half width of the low-pass in samples: 1 % of its impulse response lies beyond."""
    answer = np.abs(compute_impulse_response(lowpass_hz, dt_s))
    half = answer.size // 2
    beyond = answer[half:][::-1].cumsum()[::-1] * 2 - answer[half]
    return int(np.argmax(beyond <= REACH_SHARE * answer.sum()))


def compute_moving_mean(values: Float, width: int) -> Float:
    """Return the centred mean (n,) over ``width`` (odd) samples; the end values are repeated beyond the ends."""
    if width <= 1 or values.size == 0:
        return values.copy()
    half = width // 2
    padded = np.concatenate([np.full(half, values[0]), values, np.full(half, values[-1])])
    return np.convolve(padded, np.full(width, 1.0 / width), "valid")


def erode_flags(flags: Bool, width: int, beyond: bool) -> Bool:
    """Return where (n,) all ``width`` (odd) samples around one are set; samples beyond the ends count as ``beyond``."""
    half = width // 2
    ends = np.full(half, beyond)
    missing = np.concatenate([[0], np.cumsum(~np.concatenate([ends, flags, ends]))])
    together: Bool = missing[width:] == missing[:-width]
    return together


def convolve_columns(columns: Float, kernel: Float) -> Float:
    """Return each column (m, k) convolved with a centred ``kernel`` (odd length)."""
    rows, half = columns.shape[0], kernel.size // 2
    size = find_fft_size(rows + kernel.size - 1)
    spectrum = np.fft.rfft(columns, size, axis=0) * np.fft.rfft(kernel, size)[:, None]
    return np.fft.irfft(spectrum, size, axis=0)[half : half + rows]
