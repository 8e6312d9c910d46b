"""Judges windows by the drive's own loops where these, and not the configured ones, explain its rapids."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from fdhil.config import Axis, Identification
from fdhil.identification.loops import MOST_WINDOWS, better_loops, identify_loops, with_loops
from fdhil.pipeline.analysis import analyse
from fdhil.records import LoopEstimate, WindowOutcome
from fdhil.validation.weight import LOOPS_DIFFER

LEAST_WINDOWS = 2  # that the configured loops do not explain, before others are looked for


def unexplained(outcome: WindowOutcome) -> bool:
    """Return whether a window is refused since the loops, and not the mechanics, are other than configured."""
    return any(reason.code == LOOPS_DIFFER for reason in outcome.verdict.reasons)


class DriveLoops:
    """The axis' section with the loops that explain its newest rapids: the configured ones, or those found in them."""

    def __init__(
        self, axis: Axis, settings: Identification, period_s: float, known: LoopEstimate | None = None
    ) -> None:
        """``known`` are those of an earlier run."""
        self._configured, self._settings, self._period_s = axis, settings, period_s
        self.axis = axis if known is None or not better_loops(known) else with_loops(axis, known)
        self._newest: deque[WindowOutcome] = deque(maxlen=MOST_WINDOWS)
        self._unexplained = 0

    def take(self, outcome: WindowOutcome) -> LoopEstimate | None:
        """Take a window that was judged by ``axis``; return the loops that explain it and those before it, if new."""
        if outcome.estimate is not None and not outcome.estimate.missing:
            self._newest.append(outcome)
        self._unexplained = self._unexplained + 1 if unexplained(outcome) else 0
        if self._unexplained < LEAST_WINDOWS:
            return None
        self._unexplained = 0  # looked for once in so many windows: it takes seconds
        found = found_in(self._newest, self._settings, self._configured, self._period_s)
        if found is not None:
            self.axis = with_loops(self._configured, found)
        return found


def found_in(
    outcomes: Sequence[WindowOutcome], settings: Identification, axis: Axis, period_s: float
) -> LoopEstimate | None:
    """Return the loops that explain the windows better than the configured ones; None where those do, or none do."""
    told = [(o.window, o.estimate.parameters()) for o in outcomes if o.estimate is not None and not o.estimate.missing]
    if not told:
        return None
    windows, mechanics = zip(*told, strict=True)
    found = identify_loops(windows, mechanics, axis, settings, period_s)
    return found if found is not None and better_loops(found) else None


def judged_again(
    outcomes: Sequence[WindowOutcome], settings: Identification, axis: Axis | None, period_s: float | None
) -> tuple[list[WindowOutcome], LoopEstimate | None]:
    """Return a recording's windows judged by the drive's own loops where the configured ones do not explain them.

    With them come those loops, None where the windows stay as they are.
    """
    refused = [outcome for outcome in outcomes if unexplained(outcome)]
    if axis is None or len(refused) < min(LEAST_WINDOWS, len(outcomes)) or not refused:
        return list(outcomes), None
    found = found_in(outcomes[-MOST_WINDOWS:], settings, axis, period_s or outcomes[0].window.dt_s)
    if found is None:
        return list(outcomes), None
    own = with_loops(axis, found)
    return [analyse(outcome.window, settings, own, period_s) for outcome in outcomes], found
