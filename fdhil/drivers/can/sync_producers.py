"""Detects two SYNC producers on one bus. Pure.

With counters: two series alternate. A single producer that loses frames, restarts, or counts to another overflow value
breaks its series but never returns to the former one. Without counters: SYNC comes twice a period, alternately early
and late. A single producer of half the period comes evenly; that fault is detected by its rate.
"""

from collections import deque

import numpy as np

from fdhil.records import Int

HISTORY = 32
_EVEN = 0.1  # of a period: difference of the two intervals that jitter may cause
_SURE = 4.0  # standard errors


class SyncProducerMonitor:
    """Monitors the SYNC of one bus; ``has_two_producers`` is evaluated after each block."""

    def __init__(self, sync_period_s: float, realtime: bool) -> None:
        self._period_ns = sync_period_s * 1e9
        self._realtime = realtime
        self._newest: int | None = None  # counter of the series that continued last
        self._other: int | None = None  # and of the one before
        self._returned: deque[bool] = deque(maxlen=HISTORY)
        self._stamps_ns: deque[int] = deque(maxlen=HISTORY + 1)

    def note_regular_block(self, count: int, newest: int | None) -> None:
        """Note that a block of SYNC continued its series (None: without counter)."""
        self._newest = newest
        self._returned.extend([False] * min(count, HISTORY))

    def note_irregular_sync(self, counter: int | None, overflow: int) -> None:
        """Note one SYNC of an irregular block, and whether it continues the series before the newest one."""
        if counter is None:
            self._returned.append(self._newest is not None)
            return
        same = counter == self._newest
        goes_on = self._newest is not None and counter == self._newest % overflow + 1
        returns = self._other is not None and counter == self._other % overflow + 1
        if not same and not goes_on:
            self._other = self._newest
        self._newest = counter
        self._returned.append(same or (returns and not goes_on))

    def note_stamps(self, stamps_ns: Int) -> None:
        self._stamps_ns.extend(stamps_ns.tolist())

    @property
    def has_two_producers(self) -> bool:
        if len(self._returned) < HISTORY:
            return False
        return sum(self._returned) > HISTORY // 3 or (self._newest is None and self._is_alternating())

    def _is_alternating(self) -> bool:
        if not self._realtime or len(self._stamps_ns) <= HISTORY:
            return False
        steps = np.diff(np.array(self._stamps_ns, dtype=np.int64)) / self._period_ns
        first, second = steps[0::2], steps[1::2]
        doubt = _SURE * float(np.hypot(first.std(), second.std())) / np.sqrt(first.size)
        twice = abs(float((first + second).mean()) - 1.0) < _EVEN
        return twice and abs(float(first.mean() - second.mean())) > max(_EVEN, doubt)
