"""Places the samples of a free-running counter on a timeline, from bounds. Pure.

Each query shows that sample ``counter`` had just been completed at some instant between request and answer. All queries
together leave a narrow band of lines counter -> time, whose middle is the estimate; slow queries constrain little and
do no harm (the idea of Klipper's clock synchronisation, with intervals instead of a regression, because delays are
one-sided and not normal). The timeline may be the host's clock in ns or the SYNC count: a paused simulated machine
stops both its SYNC and its sensor, and only the SYNC count stays valid.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from fdhil.records import Float, Int

KEPT_QUERIES = 256
RATE_TOLERANCE = 200e-6  # two quartz clocks
_SLOPE_QUERIES = 32


@dataclass(frozen=True, slots=True)
class CounterLine:
    """Sample c begins at ``start`` + ``step`` * (c - ``origin``) of the timeline, to +- ``error``."""

    origin: int
    start: float
    step: float
    error: float

    def locate_sample(self, counter: int) -> float:
        """Return where sample ``counter`` begins."""
        return self.start + self.step * (counter - self.origin)


class CounterClock:
    """Collects queries; ``step`` is the nominal length of one sample on the timeline."""

    def __init__(self, step: float) -> None:
        self._step = step
        self._queries: deque[tuple[int, float, float]] = deque(maxlen=KEPT_QUERIES)

    def add_query(self, counter: int, asked: float, answered: float) -> None:
        """Add one query: ``counter`` is the newest complete sample, ``asked`` <= ``answered`` lie on the timeline.

        A counter that decreased means that the sensor was restarted: earlier queries are dropped.
        """
        if self._queries and counter < self._queries[-1][0]:
            self._queries.clear()
        self._queries.append((counter, asked, answered))

    def estimate_line(self) -> CounterLine | None:
        """Return the middle of the band on which most queries agree, None before the first query."""
        if not self._queries:
            return None
        counter, asked, answered = (np.array(column) for column in zip(*self._queries, strict=True))
        origin = int(counter[-1])
        step, slope_error = self._estimate_slope(counter, asked, answered)
        begun = step * (counter - origin)
        # sample c is complete at start + step (c - origin + 1), sample c + 1 is not
        low, high = _intersect_intervals(asked - begun - 2 * step, answered - begun - step)
        return CounterLine(origin, (low + high) / 2, step, max((high - low) / 2, step * 1e-3) + slope_error)

    def _estimate_slope(self, counter: Int, asked: Float, answered: Float) -> tuple[float, float]:
        """Return the slope through the quickest half of the queries, limited to quartz tolerance about the nominal
        step, and twice its standard error over the span of all queries."""
        span = float(counter[-1] - counter[0])
        nominal = self._step, self._step * RATE_TOLERANCE * span
        if counter.size < _SLOPE_QUERIES:
            return nominal
        quick = answered - asked <= np.median(answered - asked)
        x, y = counter[quick] - counter[-1], (asked + answered)[quick] / 2
        spread = x - x.mean()
        power = float(spread @ spread)
        if not power:
            return nominal
        slope = float(spread @ (y - y.mean()) / power)
        residual = y - y.mean() - slope * spread
        error = 2 * float(np.sqrt(residual @ residual / max(x.size - 2, 1) / power)) * span
        if error > nominal[1]:
            return nominal
        low, high = self._step * (1 - RATE_TOLERANCE), self._step * (1 + RATE_TOLERANCE)
        return float(np.clip(slope, low, high)), error


def _intersect_intervals(low: Float, high: Float) -> tuple[float, float]:
    """Return the smallest span common to the most of the intervals [low, high] (n,): Marzullo's algorithm.

    A few wrong queries (a stamp that was late because the computer was busy) are outvoted.
    """
    edges = np.concatenate([low, high])
    change = np.concatenate([np.ones(low.size), -np.ones(high.size)])
    order = np.lexsort((-change, edges))
    depth = np.cumsum(change[order])
    best = int(np.argmax(depth))
    return float(edges[order][best]), float(edges[order][best + 1])
