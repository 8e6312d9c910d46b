"""Keeps a drive's own time and decides which cycles a SYNC begins and which the drive runs itself.

A drive has its own oscillator. A SYNC at about the configured period (0x60C2, else one cycle) leads, so that a late
host does not distort the physics; without SYNC, or with one of another period, the drive's own time leads. A
phase-locked loop decides: its phase advances by one period per SYNC and is pulled toward the drive's own time.
"""

import math
from typing import NamedTuple

_SYNCS = 4  # tolerated delay in SYNC periods
_MOST_S = 0.6  # limit of the missed time that is made up


class _SyncTolerance(NamedTuple):
    """Tolerated phase of a SYNC: the pull toward the own time per SYNC, seconds late and early."""

    pull: float
    late_s: float
    early_s: float


_FREE = _SyncTolerance(1 / 256, 0.015, 0.006)  # tolerates a few percent
# set-points come with the SYNC: a SYNC of 1 ms may come every 9 ms on a busy host, or arbitrarily fast
_BOUND = _SyncTolerance(1 / 64, 0.5, math.inf)


class DriveOscillator:
    """The time of one drive. Until :meth:`due` is called, every SYNC begins a cycle; ``leads``: no SYNC does."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._now_s: float | None = None
        self._phase_s = 0.0
        self._run_s = 0.0
        self._patience = _FREE
        self._late_s = _FREE.late_s
        self.leads = False

    def follow_sync_only(self) -> None:
        """Make SYNC the only clock."""
        self._now_s = None
        self.leads = False

    def count_due_cycles(self, now_s: float, *, bound: bool, cycles: int = 1) -> int:
        """Advance to ``now_s`` and return how many cycles the drive must run without SYNC.

        ``bound``: the set-points come with the SYNC, which is configured to come every ``cycles`` cycles.
        """
        if self._now_s is None:
            self._phase_s = self._run_s = now_s
        self._now_s = now_s
        self._patience = _BOUND if bound else _FREE
        self._late_s = max(self._patience.late_s, _SYNCS * cycles * self._period_s if cycles > 1 else 0.0)
        self._decide_leader()
        if not self.leads:
            return 0
        self._run_s = max(self._run_s, now_s - _MOST_S)
        missed = max(0, int((now_s - self._run_s) / self._period_s + 1e-6))
        self._run_s += missed * self._period_s
        return missed

    def accept_sync(self, cycles: int = 1) -> bool:
        """Process a SYNC configured for every ``cycles`` cycles; return whether it begins them."""
        if self._now_s is None:
            return True
        self._phase_s = self._correct_phase(self._phase_s + cycles * self._period_s, self._now_s)
        self._decide_leader()
        if self.leads:
            return False
        self._run_s = self._correct_phase(self._run_s + cycles * self._period_s, self._now_s)
        return True

    def _correct_phase(self, phase_s: float, now_s: float) -> float:
        return phase_s + self._patience.pull * (now_s - phase_s)

    def _decide_leader(self) -> None:
        assert self._now_s is not None
        furthest = 2 * self._late_s  # so that a returning SYNC soon leads again
        self._phase_s = min(max(self._phase_s, self._now_s - furthest), self._now_s + furthest)
        self.leads = not -self._patience.early_s <= self._now_s - self._phase_s <= self._late_s
