"""Places the samples of a stream on the SYNC count, by their arrival. Pure.

A sample cannot arrive before it was taken, and its delay varies. So the line from the sensor's count to the SYNC count
runs along the earliest arrivals; its slope is the sensor's true rate, some percent off the nominal one for such
sensors.
"""

from collections import deque

import numpy as np

from fdhil.drivers.modbus.counter_clock import CounterLine

KEPT = 400
LEAST_FOR_RATE = 20  # arrivals
LEAST_SPAN_S = 0.5
RATE_TOLERANCE = 0.06  # of the nominal rate
EARLIEST = 10.0  # percent of the arrivals that count as undelayed


class ArrivalClock:
    """Collects arrivals; ``rate_hz`` is the sensor's nominal rate, ``period_s`` that of SYNC."""

    def __init__(self, rate_hz: float, period_s: float) -> None:
        self._nominal = 1.0 / (rate_hz * period_s)
        self._least_span = LEAST_SPAN_S / period_s
        self._known: deque[tuple[int, float]] = deque(maxlen=KEPT)

    def add_arrival(self, counter: int, tick: float) -> None:
        """Add the arrival of sample ``counter`` at ``tick``; a count or a tick that decreased begins another stream."""
        if self._known and (counter <= self._known[-1][0] or tick < self._known[-1][1]):
            self._known.clear()
        self._known.append((counter, tick))

    def estimate_line(self) -> CounterLine | None:
        """Return the samples' line on the SYNC count with its uncertainty; None before anything arrived."""
        if not self._known:
            return None
        counter, tick = (np.array(column, np.float64) for column in zip(*self._known, strict=True))
        origin = int(counter[-1])
        counter -= origin
        step = self._estimate_step(counter, tick)
        late = tick - step * counter
        earliest, usual = np.percentile(late, (EARLIEST, 50.0))
        return CounterLine(origin, float(earliest), step, float(usual - earliest) + step / 2)

    def _estimate_step(self, counter: np.ndarray, tick: np.ndarray) -> float:
        if counter.size < LEAST_FOR_RATE or tick[-1] - tick[0] < self._least_span:
            return self._nominal
        slope, _ = np.polyfit(counter, tick, 1)
        late = tick - slope * counter
        early = late <= np.median(late)
        slope, _ = np.polyfit(counter[early], tick[early], 1)
        low, high = self._nominal * (1 - RATE_TOLERANCE), self._nominal * (1 + RATE_TOLERANCE)
        return float(min(max(slope, low), high))
