"""Simulates the separate voltage sensor of an axis, with a small sample memory that can be latched.

Its own registers, 16 bit, 32 bit values in two with the high word first, the same as input (fc 4) and holding ones (3):

    0-1     newest voltage, float32             10      trigger: 1 latches the newest samples, at most 100, that were
    2-3     counter of the newest sample                not latched before (fc 6, 16)
    4-5     sample rate in Hz, float32          11      0 idle, 1 latched, 2 latched and samples were lost
    6-7     volts per count of the block        12-13   counter of the block's first sample
    8-9     slide-way temperature in degC       14      number of samples in the block; 15 is 0
                                                16-115  samples, int16

Sample c is the mean over [c Ts, (c + 1) Ts) of the sensor's own time, which is the simulated one.
"""

import struct
import threading
from collections import deque

import numpy as np

from fdhil.sim.signal_fault import WhiteNoise
from fdhil.sim.wire.sensor_faults import SensorFaults

REGISTERS = 116
BLOCK = 100
TRIGGER, STATUS, FIRST_SAMPLE = 10, 11, 16


class VoltageSensor:
    """Registers and sample memory of one sensor; :meth:`feed` and the reading thread may run concurrently."""

    def __init__(
        self, rate_hz: float, limit_v: float, noise_v: float, rng: np.random.Generator, cycles: int = 1
    ) -> None:
        """Create a sensor whose samples are means over ``cycles`` fed values."""
        self.faults = SensorFaults()
        self._cycles, self._sum_v, self._summed = cycles, 0.0, 0
        self.celsius = 20.0
        self.rate_hz = rate_hz
        self.volts_per_count = max(0.01, round(1.05 * limit_v / 32767, 4))
        self._noise, self._rng = WhiteNoise(noise_v, rng), rng
        self._lock = threading.Lock()
        self._recent: deque[float] = deque(maxlen=BLOCK)
        self._count = 0  # samples so far
        self._latched = 0  # samples latched or lost
        self._block = [0] * (REGISTERS - STATUS)

    def feed_mean_voltage(self, mean_v: float) -> None:
        """Add the mean terminal voltage of one cycle; the last cycle of a sample completes it."""
        self._sum_v, self._summed = self._sum_v + mean_v, self._summed + 1
        if self._summed < self._cycles:
            return
        mean_v, self._sum_v, self._summed = self._sum_v / self._cycles, 0.0, 0
        value = self.faults.signal.apply_errors(mean_v + self._noise.draw(), self._rng)
        with self._lock:
            self._recent.append(value)
            self._count += 1

    def latch_samples(self) -> None:
        """Copy the newest samples not latched before into the block, at most 100."""
        with self._lock:
            fresh = self._count - self._latched
            number = min(fresh, len(self._recent))
            samples = list(self._recent)[len(self._recent) - number :]
            self._latched = self._count
            first = self._count - number
        counts = [max(-32768, min(32767, round(v / self.volts_per_count))) & 0xFFFF for v in samples]
        status = 2 if fresh > number else 1
        header = [status, *_unpack_words(struct.pack(">I", first & 0xFFFFFFFF)), number, 0]
        self._block = header + counts + [0] * (BLOCK - number)

    def read_registers(self) -> list[int]:
        with self._lock:
            newest, count = (self._recent[-1] if self._recent else 0.0), max(self._count - 1, 0)
        head = struct.pack(">fIfff", newest, count & 0xFFFFFFFF, self.rate_hz, self.volts_per_count, self.celsius)
        return [*_unpack_words(head), 0, *self._block]

    trigger: int | None = TRIGGER

    def list_words(self) -> dict[int, int]:
        return dict(enumerate(self.read_registers()))

    def read_newest(self, number: int) -> tuple[int, list[float]]:
        """Return the number of samples so far, and up to ``number`` of the newest, the oldest first."""
        with self._lock:
            return self._count, list(self._recent)[-number:]


def _unpack_words(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data))
