"""Measures how late the guard's offsets leave: from the time stamp of a SYNC until they are handed to the kernel.

A late turn is this computer's fault: what the drives show then (an internal limit, a following error, a missed
heartbeat) is its consequence, not a fault of the machine.
"""

from bisect import bisect_left
from collections import deque
from math import inf
from typing import Any, NamedTuple

from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.interlocks import LATE_PC

BINS_US = (20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
MINUTE_S = 60.0
MOST_LATE = 0.001  # share of the turns of the last minute: arming is refused above it
LEAST_TURNS = 1_000
MOST_S = 1.0  # longer: the wall clock was set
RECENT_S = 1.0  # for so long a late offset may explain what a drive shows
CONSEQUENCES = {
    "LimitActive", "NotFollowing", "FollowingError", "EchoMismatch", "DriveEmergency", "LoopOverrun", "StaleData",
    "FeedbackGap", "TargetLost", "SyncJitter", "HeartbeatLost", "Implausible",
}  # fmt: skip


class _MinuteCount(NamedTuple):
    end_s: float
    turns: int = 0
    late: int = 0
    worst_s: float = 0.0


class TurnLateness:
    """A histogram of all turns, counts of the last one or two minutes, and late offsets of the running correction."""

    def __init__(self, settings: GuardSettings) -> None:
        # a simulated machine waits for its offsets, or runs ahead: its time stamps do not measure this computer
        self._limit_s = settings.sync_period_s * (1 + settings.lead) if settings.clock == "monotonic" else inf
        self._counts = [0] * (len(BINS_US) + 1)
        self._worst_s = 0.0
        self._minutes = deque([_MinuteCount(0.0)], maxlen=2)
        self.forget_late_offsets()

    def forget_late_offsets(self) -> None:
        """Reset the count of late offsets for a new correction."""
        self._late, self._latest_s, self._late_worst_s = 0, -inf, 0.0

    def count_turn(self, turn_s: float, missed: bool, now_s: float) -> None:
        """Count a turn; ``missed``: the next SYNC arrived before its offsets could leave."""
        turn_s = turn_s if 0.0 <= turn_s <= MOST_S else 0.0
        self._counts[bisect_left(BINS_US, turn_s * 1e6)] += 1
        self._worst_s = max(self._worst_s, turn_s)
        late = missed or turn_s > self._limit_s
        if now_s >= self._minutes[-1].end_s:
            self._minutes.append(_MinuteCount(now_s + MINUTE_S))
        at = self._minutes[-1]
        self._minutes[-1] = _MinuteCount(at.end_s, at.turns + 1, at.late + late, max(at.worst_s, turn_s))
        if late:
            self._late, self._latest_s = self._late + 1, now_s
            self._late_worst_s = max(self._late_worst_s, turn_s)

    def explain_by_lateness(self, code: str, now_s: float) -> str:
        """Return how late this computer was where that explains what a drive shows; empty where it does not."""
        if code not in CONSEQUENCES or now_s - self._latest_s > RECENT_S:
            return ""
        offsets = "1 offset" if self._late == 1 else f"{self._late} offsets"
        return f"{LATE_PC} ({offsets}, worst {self._late_worst_s * 1e3:.1f} ms)"

    def refuse_when_late(self) -> str:
        """Return why nothing may be armed on this computer now; empty: it may."""
        turns, late = (sum(values) for values in zip(*(m[1:3] for m in self._minutes), strict=True))
        if self._limit_s == inf or turns < LEAST_TURNS or late <= MOST_LATE * turns:
            return ""
        worst_ms = 1e3 * max(minute.worst_s for minute in self._minutes)
        return f"{late} of the last {turns} offsets would have left late, the worst after {worst_ms:.1f} ms"

    def build_lateness_document(self) -> dict[str, Any]:
        """Return the counts; the last class of the histogram has no upper bound."""
        recent = self._minutes
        return {
            "turns": sum(self._counts),
            "worst_us": round(self._worst_s * 1e6),
            "histogram_us": [[top, n] for top, n in zip((*BINS_US, None), self._counts, strict=True)],
            "recent": {
                "turns": sum(minute.turns for minute in recent),
                "late": sum(minute.late for minute in recent),
                "worst_us": round(1e6 * max(minute.worst_s for minute in recent)),
            },
        }
