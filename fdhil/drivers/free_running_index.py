"""Numbers the values of a free-running instrument by their arrival. Pure.

A value may come late, with the following ones close behind it: none is missing then. One that is not closely followed
came in time, and if it is late all the same, others before it were lost.
"""

from collections import deque

LATE = 0.6  # of a period
IN_TIME = 0.45  # of a period, to the next value; with LATE more than 1, by more than two clocks drift apart
KEPT = 64  # values, of which the earliest for its number came in time


class FreeRunningIndex:
    """Counts values ``period_s`` apart; ``missed`` counts lost ones.

    A wrong count is set back: a number may then occur again.
    """

    def __init__(self, period_s: float) -> None:
        self._period_ns = period_s * 1e9
        self._early: deque[float] = deque(maxlen=KEPT)
        self._number = -1
        self._last_ns: int | None = None
        self.missed = 0

    def assign_number(self, t_ns: int) -> int:
        """Return the number of a value that came at ``t_ns``."""
        if self._last_ns is not None and t_ns - self._last_ns >= IN_TIME * self._period_ns:
            self._correct_number(self._last_ns)
        self._number += 1
        self._last_ns = t_ns
        return self._number

    def _correct_number(self, t_ns: int) -> None:
        ahead = t_ns - self._number * self._period_ns
        behind = (ahead - min(self._early)) / self._period_ns if self._early else 0.0
        if abs(behind) > LATE:
            self._number += round(behind)
            self.missed = max(0, self.missed + round(behind))
            ahead -= round(behind) * self._period_ns
        self._early.append(ahead)
