"""Keeps the newest samples of one axis, and combines them to columns if there are more than a screen can show.

Pure: no clock, no socket. Samples are placed by their tick; a missing one stays NaN.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdhil.daemon import LIVE_SIGNALS

Rows = NDArray[np.float32]
UNITS = {
    "voltage_v": "V",
    "current_a": "A",
    "speed_rad_s": "rad/s",
    "following_error_um": "µm",
    "offset_um": "µm",
    "position_mm": "mm",
    "demand_mm": "mm",
    "temperature_c": "°C",
}
DRAWN = (*LIVE_SIGNALS, "temperature_c")
VOLTAGE, TEMPERATURE = DRAWN.index("voltage_v"), DRAWN.index("temperature_c")


@dataclass(frozen=True, slots=True)
class SignalEnvelope:
    """The minimum and maximum of every signal in each column, (signals, columns), NaN without samples.

    Column j covers ``per_column`` ticks from ``first_tick`` + j ``per_column`` on.
    """

    first_tick: int
    per_column: int
    low: Rows
    high: Rows


class SampleRing:
    """The newest ``capacity`` samples of one axis: those of the ticks from ``begin`` to before ``end``."""

    def __init__(self, capacity: int) -> None:
        self._values: Rows | None = None  # allocated with the first samples
        self._celsius = np.nan
        self._first = 0
        self.capacity = capacity
        self.end = 0

    @property
    def begin(self) -> int:
        """The oldest tick that is kept; ``end`` while there is none."""
        return max(self._first, self.end - self.capacity)

    def put_samples(self, ticks: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Add samples: rising ``ticks`` (n,), after all before them, and the daemon's signals (7, n)."""
        if self._values is None:
            self._values = np.full((len(DRAWN), self.capacity), np.nan, np.float32)
            self._first = self.end = int(ticks[0])
        if ticks[0] < self.end:
            return
        before, self.end = self.end, int(ticks[-1]) + 1
        self._values[:, np.arange(max(before, self.begin), self.end) % self.capacity] = np.nan
        keep = ticks >= self.begin
        places = ticks[keep] % self.capacity
        self._values[: len(LIVE_SIGNALS), places] = values[:, keep]
        self._values[TEMPERATURE, places] = self._celsius

    def put_voltage(self, ticks: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Set the voltage (n,) of a separate sensor at the existing samples of ``ticks`` (n,)."""
        if self._values is not None:
            held = (ticks >= self.begin) & (ticks < self.end)
            self._values[VOLTAGE, ticks[held] % self.capacity] = values[held]

    def set_temperature(self, celsius: float) -> None:
        """Set the temperature of the samples from here on."""
        self._celsius = celsius

    def read_samples(self, first: int, end: int) -> Rows:
        """Return the samples (signals, n) of the ticks from ``first`` to before ``end``, NaN for missing ones."""
        values = np.full((len(DRAWN), end - first), np.nan, np.float32)
        held = np.arange(max(first, self.begin), min(end, self.end))
        if self._values is not None and held.size:
            values[:, held[0] - first : held[-1] + 1 - first] = self._values[:, held % self.capacity]
        return values

    def compute_envelope(self, first: int, end: int, per_column: int) -> SignalEnvelope:
        """Return the complete columns between two ticks; the first begins at a multiple of their width."""
        start = -(-first // per_column) * per_column
        columns = max(0, (end - start) // per_column)
        rows = self.read_samples(start, start + columns * per_column).reshape(len(DRAWN), columns, per_column)
        return SignalEnvelope(start, per_column, np.fmin.reduce(rows, axis=2), np.fmax.reduce(rows, axis=2))
