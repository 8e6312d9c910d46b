"""Refines feasible feeds: each is raised alone, while those next to it stay.

An error between two segments hardly depends on either of them alone, so that a search which changes both by the result
of each ends a little early.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np

from fdhil.prediction.feeds import AIM, STILL, WORTH, Feeds, Judge, Source, run, stretches
from fdhil.records import Trajectory

STEP = 1.05  # first factor tried
MOST_STEPS, MOST_STEP, LEAST_POWER = 3, 2.0, 0.05
MOST_GROUPS = 3  # of segments that do not touch each other
Span = tuple[float, float]


def raised_alone(feeds: Feeds, source: Source, judge: Judge, tolerance_um: float) -> Feeds:
    """Return the feeds with each possible segment raised; together they keep the tolerance as before."""
    waiting = {k for k in feeds.held if feeds.share[k] * STEP <= 1.0}
    if not waiting:
        return feeds
    raising = _Raising(feeds, source, judge, tolerance_um)
    for _ in range(MOST_GROUPS):
        if not waiting:
            break
        group = raising.group(waiting)
        waiting -= group
        factors = dict.fromkeys(group, STEP)
        for _ in range(MOST_STEPS):
            factors = raising.step(factors)
            if not factors:
                break
    return raising.feeds()


class _Raising:
    """Shares, all of which were evaluated."""

    def __init__(self, feeds: Feeds, source: Source, judge: Judge, tolerance_um: float) -> None:
        self._before, self._source, self._judge, self._tolerance_um = feeds, source, judge, tolerance_um
        self._share = dict(feeds.share)
        self._apart_s = 2 * source.after_s
        self._reference, self._error_um = run(source, self._share, judge)
        self._most_um = {k: max(tolerance_um, um / STILL) for k, um in self._error_um.items() if um > tolerance_um}

    def _spoilt(self, error_um: Mapping[int, float]) -> list[int]:
        return [k for k, um in error_um.items() if not 0.0 <= um <= self._most_um.get(k, self._tolerance_um)]

    def group(self, waiting: Collection[int]) -> set[int]:
        """Return some of ``waiting`` that do not touch each other, in the order of the path."""
        chosen, end_s = set(), -np.inf
        for k, (first_s, last_s) in sorted(_spans(self._reference, waiting).items(), key=lambda item: item[1]):
            if first_s > end_s:
                chosen.add(k)
                end_s = last_s + self._apart_s
        return chosen

    def step(self, factors: Mapping[int, float]) -> dict[int, float]:
        """Evaluate some shares times their factors and keep those within the tolerance; return their next factors."""
        tried = {k: min(1.0, self._share[k] * factor) for k, factor in factors.items()}
        reference, error_um = run(self._source, self._share | tried, self._judge)
        spoilt = _spans(reference, self._spoilt(error_um)).values()
        good = {k for k, span in _spans(reference, tried).items() if not self._near(span, spoilt)}
        further = {k: self._further(tried[k] / self._share[k], self._error_um[k], error_um[k]) for k in good}
        self._share |= {k: tried[k] for k in good}
        self._error_um |= {k: error_um[k] for k in good}
        return {k: factor for k, factor in further.items() if factor > WORTH and tried[k] < 1.0}

    def _near(self, span: Span, others: Iterable[Span]) -> bool:
        first_s, last_s = span
        return any(first - self._apart_s <= last_s and first_s <= last + self._apart_s for first, last in others)

    def _further(self, factor: float, before_um: float, now_um: float) -> float:
        """Return the factor that brings an error to its target, by its change with the last one."""
        power = max(float(np.log(now_um / before_um) / np.log(factor)), LEAST_POWER) if before_um > 0.0 else 1.0
        return float(np.clip((AIM * self._tolerance_um / now_um) ** (1.0 / power), 1.0, MOST_STEP))

    def feeds(self) -> Feeds:
        if self._share == self._before.share:
            return self._before
        _, error_um = run(self._source, self._share, self._judge)
        if self._spoilt(error_um):
            return self._before
        return replace(self._before, share=self._share, left_um={k: error_um.get(k, 0.0) for k in self._share})


def _spans(reference: Trajectory, wanted: Collection[int]) -> dict[int, Span]:
    stretch = stretches(reference)
    names, first = np.unique(stretch, return_index=True)
    _, last = np.unique(stretch[::-1], return_index=True)
    start, dt_s = float(reference.time_s[0]), reference.dt_s
    ends = zip(names.tolist(), first.tolist(), (stretch.size - last).tolist(), strict=True)
    return {k: (start + begin * dt_s, start + end * dt_s) for k, begin, end in ends if k in wanted}
