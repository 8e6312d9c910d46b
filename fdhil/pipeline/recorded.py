"""Analyses the windows of one recording of one axis, with the best model of its drive."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

from fdhil.config import Axis, Identification
from fdhil.identification.current_means import with_current_means
from fdhil.pipeline.analysis import analyse, own
from fdhil.pipeline.own_loops import explained
from fdhil.records import LoopEstimate, Window, WindowOutcome

Work = Callable[[Window], WindowOutcome]
Spread = Callable[[Work, Sequence[Window]], Iterable[WindowOutcome]]


def analyse_windows(
    windows: Sequence[Window],
    settings: Identification,
    axis: Axis | None = None,
    sync_period_s: float | None = None,
    spread: Spread = map,
    done: Callable[[], None] = lambda: None,
) -> tuple[Sequence[WindowOutcome], LoopEstimate | None]:
    """Return the outcome of each window, and the drive's own loops if they had to be identified.

    ``spread`` may use further processes, in order; ``done`` is called after each window.
    """
    if windows:
        windows = with_current_means(windows, settings, own(windows[0], axis), sync_period_s)
    work = partial(analyse, settings=settings, axis=axis, sync_period_s=sync_period_s)

    def told() -> Iterator[WindowOutcome]:
        for outcome in spread(work, windows):
            done()
            yield outcome

    def again(better: Axis) -> Sequence[WindowOutcome]:
        return list(spread(partial(work, axis=better), windows))

    return explained(list(told()), axis, settings, sync_period_s, again)
