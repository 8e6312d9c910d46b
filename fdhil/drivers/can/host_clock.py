"""Converts time stamps of other clocks to the host's monotonic clock."""

import time
from collections import deque


class WallClock:
    """The wall clock against the monotonic one; the two are never read at quite the same instant, so small changes are
    followed slowly, and a change of more than 2 ms means that the clock was set."""

    _SET_NS = 2_000_000
    _SHARE = 64
    _SPREAD_NS = 200_000

    def __init__(self) -> None:
        self._ahead_ns: int | None = None

    def measure_ahead_ns(self) -> int:
        """Return by how much the wall clock is ahead now."""
        spread, ahead = min(self._read_clocks() for _ in range(3))
        if self._ahead_ns is not None and spread > self._SPREAD_NS:
            return self._ahead_ns  # interrupted between the clocks: the reading is useless
        if self._ahead_ns is None or abs(ahead - self._ahead_ns) > self._SET_NS:
            self._ahead_ns = ahead
        else:
            self._ahead_ns += (ahead - self._ahead_ns) // self._SHARE
        return self._ahead_ns

    @staticmethod
    def _read_clocks() -> tuple[int, int]:
        before = time.monotonic_ns()
        wall = time.time_ns()
        after = time.monotonic_ns()
        return after - before, wall - (before + after) // 2


def convert_to_monotonic_ns(wall_ns: int, wall_ahead_ns: int) -> int:
    """Convert a wall-clock stamp to the monotonic clock; return now, when the wall clock was set since the stamp."""
    now_ns, stamp_ns = time.monotonic_ns(), wall_ns - wall_ahead_ns
    return stamp_ns if now_ns - 1_000_000_000 < stamp_ns <= now_ns + 5_000_000 else now_ns


class RemoteClock:
    """A remote clock (of a CAN controller, of a hub) against the monotonic one, by its quickest recent reading.

    No reading arrives before it was sent, so the one that seems furthest ahead was the quickest. Readings older than
    ``window_s`` are dropped: two crystals drift apart by up to 0.1 ms a second. A clock that was set, or restarts,
    counts from there.
    """

    _SET_BACK_NS = 1_000_000_000

    def __init__(self, window_s: float) -> None:
        self._window_ns = round(window_s * 1e9)
        self._readings: deque[tuple[int, int]] = deque()  # (time, ahead), in descending order of ahead

    def track_ahead_ns(self, stamp_ns: int, now_ns: int) -> int:
        """Add a reading; return by how much the remote clock is ahead."""
        ahead, kept = stamp_ns - now_ns, self._readings
        if kept and ahead < kept[0][1] - self._SET_BACK_NS:
            kept.clear()
        while kept and kept[-1][1] <= ahead:
            kept.pop()
        kept.append((now_ns, ahead))
        while kept[0][0] < now_ns - self._window_ns:
            kept.popleft()
        return kept[0][1]
