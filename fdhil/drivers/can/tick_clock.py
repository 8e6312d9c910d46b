"""Converts between host time and SYNC count, by the arrivals of SYNC. Pure."""

import numpy as np

from fdhil.records import Float, Int, TickTimes

KEPT_TICKS = 8192
_STALE_TICKS = 50.0
_LATE_TICKS = 512  # longer delays count as a delayed SYNC


class TickClock:
    """The newest arrivals of SYNC; between two of them time is linear, so a delayed producer distorts nothing."""

    def __init__(self, sync_period_s: float) -> None:
        self.period_ns = sync_period_s * 1e9
        self._tick = np.empty(0, np.int64)
        self._t_ns = np.empty(0, np.int64)

    def add_arrivals(self, times: TickTimes) -> None:
        """Append arrivals; a restarted count discards the old ones."""
        if times.tick.size == 0:
            return
        if self._tick.size and times.tick[0] <= self._tick[-1]:
            self._tick, self._t_ns = self._tick[:0], self._t_ns[:0]
        self._tick = np.concatenate([self._tick, times.tick])[-KEPT_TICKS:]
        self._t_ns = np.concatenate([self._t_ns, times.t_ns])[-KEPT_TICKS:]

    @property
    def is_running(self) -> bool:
        return self._tick.size > 1

    @property
    def newest_tick(self) -> int:
        """The newest tick, 0 before the first."""
        return int(self._tick[-1]) if self._tick.size else 0

    def is_covered(self, t_ns: int) -> bool:
        """Return whether SYNCs up to host time ``t_ns`` have arrived."""
        return self._t_ns.size > 0 and int(self._t_ns[-1]) >= t_ns

    def is_past(self, t_ns: int) -> bool:
        """Return whether host time ``t_ns`` is before every SYNC that is still stored."""
        return self.is_running and t_ns < int(self._t_ns[0])

    def bound_ticks(self, from_ns: int, to_ns: int) -> tuple[float, float] | None:
        """Return fractional ticks that enclose the span with certainty; None when SYNC does not run at that time.

        A stamp is never early but often late, when the computer was busy. So the stamps give the SYNCs that had come
        for certain; how many may have come follows from the earliest instants that the later stamps allow. A span that
        ends after the newest SYNC is extrapolated at the period, as long as SYNC is not overdue.
        """
        if not self.is_running or from_ns < self._t_ns[0] or to_ns - self._t_ns[-1] > _STALE_TICKS * self.period_ns:
            return None
        start = max(0, int(self._t_ns.searchsorted(to_ns)) - _LATE_TICKS)
        tick, t_ns = self._tick[start:], self._t_ns[start:]
        return _interpolate_tick(from_ns, self._tick, self._t_ns, self.period_ns), _interpolate_tick(
            to_ns, tick, *self._estimate_earliest(tick, t_ns)
        )

    def _estimate_earliest(self, tick: Int, t_ns: Int) -> tuple[Float, float]:
        """Return the earliest possible instants (n,) of these SYNCs, and the period.

        A simulated machine may run faster than nominal: its own period then counts.
        """
        steps = np.diff(t_ns) / np.diff(tick)
        period_ns = min(self.period_ns, float(np.median(steps))) if steps.size else self.period_ns
        return np.minimum.accumulate((t_ns - tick * period_ns)[::-1])[::-1] + tick * period_ns, period_ns

    def convert_to_ns(self, tick: Float) -> Float:
        """Return the host time (n,) of fractional ticks (n,), extrapolated at the nominal period at both ends."""
        inside = np.interp(tick, self._tick, self._t_ns)
        before = np.minimum(tick - self._tick[0], 0) * self.period_ns
        after = np.maximum(tick - self._tick[-1], 0) * self.period_ns
        return np.asarray(inside + before + after, dtype=np.float64)


def _interpolate_tick(t_ns: int, tick: Int, stamps_ns: Int | Float, period_ns: float) -> float:
    beyond = t_ns - float(stamps_ns[-1])
    return float(tick[-1] + beyond / period_ns if beyond > 0 else np.interp(t_ns, stamps_ns, tick))
