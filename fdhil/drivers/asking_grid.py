"""Says when a sensor that shows one value is asked, and how far from that instant its answer may be. Pure.

The instants are whole multiples of the period on the SYNC count, so that the values are a signal on the drive's clock;
without SYNC they are so on this computer's clock.
"""

from __future__ import annotations

import math

import numpy as np

from fdhil.drivers.can.tick_clock import TickClock

SYNC_ENDED_NS = 500_000_000  # after so long a silence it does not run


class AskingGrid:
    """Instants ``period_s`` apart, numbered; ``missed`` counts those at which nobody was asked.

    ``phase`` (of a period) has them so much later: sensors on one line are asked in turn.
    """

    def __init__(self, period_s: float, sync_period_s: float, phase: float = 0.0) -> None:
        self.period_ns = period_s * 1e9
        self._phase = phase
        self._ticks = period_s / sync_period_s
        self._next: int | None = None
        self._by_sync = False
        self.missed = 0

    def next_instant(self, now_ns: int, ticks: TickClock) -> tuple[int, float]:
        """Return number and host time (ns) of the next instant."""
        by_sync = ticks.running and ticks.covers(now_ns - SYNC_ENDED_NS)
        newest = ticks.newest_tick
        since = (now_ns - float(ticks.time_ns(np.array([newest]))[0])) / ticks.period_ns if by_sync else 0.0
        periods = (newest + since) / self._ticks if by_sync else now_ns / self.period_ns
        number = math.ceil(periods - self._phase)
        last, went_on = self._next, by_sync == self._by_sync
        self._by_sync = by_sync
        if went_on and last is not None and number - last + 1 >= 0:
            number = max(number, last)
            self.missed += number - last
        self._next = number + 1
        return number, self.host_ns(number, ticks)

    def host_ns(self, number: int, ticks: TickClock) -> float:
        """Return the host time of an instant."""
        if not self._by_sync:
            return (number + self._phase) * self.period_ns
        return float(ticks.time_ns(np.array([(number + self._phase) * self._ticks]))[0])

    def off_ns(self, number: int, asked_ns: int, answered_ns: int, ticks: TickClock) -> float:
        """Return how far off the instant of that number a value may be that was read between question and answer."""
        between = ticks.bounds(asked_ns, answered_ns) if self._by_sync else None
        if between is None:
            due_ns = self.host_ns(number, ticks)
            return max(abs(asked_ns - due_ns), abs(answered_ns - due_ns))
        due = (number + self._phase) * self._ticks
        return max(abs(between[0] - due), abs(between[1] - due)) * ticks.period_ns
