"""Keeps a drive's own time: which cycles a SYNC begins, and which the drive runs by itself.

A drive has its own oscillator. A SYNC at about the period that the drive was told (0x60C2; else one cycle) leads it, so
that a late host does not bend the physics; where there is none, or one at another period, the drive's own time leads.
Which of the two it is, a phase-locked loop says: its phase goes that period on with every SYNC and is drawn to the own
time.
"""

from __future__ import annotations

_PULL = 1 / 64  # of the way to the own time, per SYNC
_FREE_S = 0.02  # how far the phase may be off: a SYNC whose period is wrong by a third of 1 ms is beyond it
_BOUND_S = 0.5  # the same where the set-points come with the SYNC: a period nine times too long is beyond it
_SYNCS = 4  # or, where that is longer, so many periods of the SYNC
_MOST_S = 0.05  # of what was missed, this much is run


class OwnClock:
    """The time of one drive. It stands, and every SYNC begins a cycle, until it is told; ``leads``: no SYNC does."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._now_s: float | None = None
        self._phase_s = 0.0
        self._run_s = 0.0
        self._slack_s = _FREE_S
        self.leads = False

    def stop(self) -> None:
        """SYNC is the only clock from now on."""
        self._now_s = None
        self.leads = False

    def due(self, now_s: float, *, bound: bool, cycles: int = 1) -> int:
        """It is ``now_s``: return how many cycles the drive has to run by itself.

        ``bound``: the set-points come with the SYNC, which is said to come every ``cycles`` cycles.
        """
        if self._now_s is None:
            self._phase_s = self._run_s = now_s
        self._now_s = now_s
        self._slack_s = max(_BOUND_S if bound else _FREE_S, _SYNCS * cycles * self._period_s if cycles > 1 else 0.0)
        self._judge()
        if not self.leads:
            return 0
        self._run_s = max(self._run_s, now_s - _MOST_S)
        cycles = int((now_s - self._run_s) / self._period_s + 1e-6)
        self._run_s += cycles * self._period_s
        return cycles

    def sync(self, cycles: int = 1) -> bool:
        """A SYNC came that is said to come every so many cycles: return whether it begins them."""
        if self._now_s is None:
            return True
        self._phase_s += cycles * self._period_s
        self._phase_s += _PULL * (self._now_s - self._phase_s)
        self._judge()
        return not self.leads

    def _judge(self) -> None:
        assert self._now_s is not None
        furthest = 2 * self._slack_s  # so that a SYNC that comes back is soon believed again
        self._phase_s = min(max(self._phase_s, self._now_s - furthest), self._now_s + furthest)
        leads = abs(self._now_s - self._phase_s) > self._slack_s
        if leads and not self.leads:
            self._run_s = min(self._phase_s, self._now_s)  # what SYNC has not run since
        self.leads = leads
