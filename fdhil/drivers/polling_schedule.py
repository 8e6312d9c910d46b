"""Schedules the polls of a sensor that shows one value, and bounds the time of each reading. Pure.

Polls lie at whole multiples of the period on the SYNC count, so that the values form a signal on the drive's clock;
without SYNC they follow this computer's clock.
"""

import math

import numpy as np

from fdhil.drivers.can.tick_clock import TickClock

SYNC_ENDED_NS = 500_000_000  # silence after which SYNC counts as stopped
PACE_TICKS = 500


class PollingSchedule:
    """Numbered polls ``period_s`` apart; ``missed`` counts those that were not made.

    ``phase``, a share of the period, delays them: sensors on one line are polled in turn.
    """

    def __init__(self, period_s: float, sync_period_s: float, phase: float = 0.0) -> None:
        self.period_ns = period_s * 1e9
        self._phase = phase
        self._ticks = period_s / sync_period_s
        self._next: int | None = None
        self._by_sync = False
        self.missed = 0

    def schedule_next(self, now_ns: int, ticks: TickClock) -> tuple[int, float]:
        """Return number and host time (ns) of the next poll."""
        by_sync = ticks.is_running and ticks.is_covered(now_ns - SYNC_ENDED_NS)
        newest, newest_ns, step_ns = _measure_sync_pace(ticks)
        periods = (newest + (now_ns - newest_ns) / step_ns) / self._ticks if by_sync else now_ns / self.period_ns
        number = math.ceil(periods - self._phase)
        last, went_on = self._next, by_sync == self._by_sync
        self._by_sync = by_sync
        if went_on and last is not None and number - last + 1 >= 0:
            number = max(number, last)
            self.missed += number - last
        self._next = number + 1
        return number, self.compute_host_ns(number, ticks)

    def compute_host_ns(self, number: int, ticks: TickClock) -> float:
        """Return the host time (ns) of a poll; a future one is extrapolated from the pace of SYNC."""
        if not self._by_sync:
            return (number + self._phase) * self.period_ns
        tick = (number + self._phase) * self._ticks
        newest, newest_ns, step_ns = _measure_sync_pace(ticks)
        return (
            newest_ns + (tick - newest) * step_ns if tick > newest else float(ticks.convert_to_ns(np.array([tick]))[0])
        )

    def locate_reading(
        self, number: int, asked_ns: int, answered_ns: int, ticks: TickClock
    ) -> tuple[float, float, float]:
        """Return the host time (ns) of a value that was read between request and answer, its delay against the
        scheduled instant, and the uncertainty of both (ns)."""
        between = ticks.bound_ticks(asked_ns, answered_ns) if self._by_sync else None
        if between is None:
            middle = (asked_ns + answered_ns) / 2
            return middle, middle - self.compute_host_ns(number, ticks), (answered_ns - asked_ns) / 2
        tick = (between[0] + between[1]) / 2
        late = (tick - (number + self._phase) * self._ticks) * ticks.period_ns
        return float(ticks.convert_to_ns(np.array([tick]))[0]), late, (between[1] - between[0]) / 2 * ticks.period_ns


def _measure_sync_pace(ticks: TickClock) -> tuple[int, float, float]:
    """Return the newest tick, its host time, and the ns per tick: a simulated machine may run slower than nominal."""
    newest = ticks.newest_tick
    if not ticks.is_running:
        return newest, 0.0, ticks.period_ns
    before_ns, newest_ns = ticks.convert_to_ns(np.array([newest - PACE_TICKS, newest]))
    return newest, float(newest_ns), float(newest_ns - before_ns) / PACE_TICKS
