"""Searches for the highest feed of each segment of a path that keeps a tolerance, by predicting the whole path.

Then each feed is raised alone, while those next to it stay: an error between two segments hardly depends on either of
them alone, so that a search which changes both by the result of each ends a little early.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from fdhil.config import MachineConfig
from fdhil.program import Arc, Feed, Motion
from fdhil.program import plan as plan_program
from fdhil.records import Float, Int, Trajectory

AFTER_S = 0.2  # an error belongs to commands up to this long before it: the loops need to settle
RAPID, REST = -1, -2  # rows without a segment: not assessed, and assessed for the segment before
NARROW = 1.02  # shares closer than this are not refined further
LEAST_FALL, MOST_FALL, RISE = 0.97, 0.25, 1.05  # of a share, from one trial to the next
POWERS = (0.3, 3.0)  # limits of the exponent p of error ~ share ** p
AIM, FULL = 0.996, 0.99  # of the tolerance: the target, and what is close enough
PATIENCE = 2  # successive rises by the power law of the last trials
EDGE = 0.1  # of a bracket, in logarithms: distance of a trial from its ends
LOWEST = 1e-3  # lowest share of the feed that is tried
# an error that keeps STILL of itself while its feed falls to 1 / FAR does not come from the feed; over less it may
# come from the NC's acceleration, which is the same until the feed is below what a ramp gains while the loops settle
STILL, FAR = 0.9, 8.0
SLACK, MOST_RISES = 0.97, 2  # of the tolerance: with more slack a higher feed is tried, up to this many times
MOST_TRIALS = 80
WORTH, FEW = 1.02, 0.02  # trials that speed up fewer segments, or by less, are skipped
LONGEST_S, LONGEST_SHARE = 120.0, 10.0  # a path is not slowed beyond both, the latter times its own duration

# contour error (n,) um of a reference; inf where the drives cannot follow, NaN where the error is then unknown
Judge = Callable[[Trajectory], Float]
STEP = 1.05  # first factor tried
MOST_STEPS, MOST_STEP, LEAST_POWER = 3, 2.0, 0.05
MOST_GROUPS = 3  # of segments that do not touch each other
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class FeedScaledPath:
    """A path that can be generated with every segment at its own share of the feed (default 1).

    The ``line`` of its references is the segment of a row, 0 for a rest; ``line`` and ``compute_feed_mm_min`` give the
    user's line and feed of a segment. Errors up to ``after_s`` behind a segment are its own.
    """

    at: Callable[[Mapping[int, float]], Trajectory]
    line: Callable[[int], int]
    feed_mm_min: Callable[[int], float]
    after_s: float = AFTER_S


def scale_feeds(motions: Sequence[Motion], share: Callable[[int], float]) -> list[Motion]:
    """Return the motions with every programmed feed times the share of its line; rapids and dwells stay."""
    return [replace(m, feed=m.feed * share(m.line)) if isinstance(m, Feed | Arc) else m for m in motions]


def make_program_source(motions: Sequence[Motion], config: MachineConfig) -> FeedScaledPath:
    """Return a program as a source: its stretches are its lines."""
    feeds: dict[int, float] = {}
    for motion in motions:
        if isinstance(motion, Feed | Arc):
            feeds[motion.line] = max(motion.feed, feeds.get(motion.line, 0.0))
    return FeedScaledPath(
        at=lambda shares: plan_program(scale_feeds(motions, lambda line: shares.get(line, 1.0)), config),
        line=lambda stretch: stretch,
        feed_mm_min=lambda stretch: feeds.get(stretch, 0.0),
    )


def label_segments(reference: Trajectory) -> Int:
    """Return (n,) the segment that each row belongs to, RAPID or REST."""
    # rows without a line are a rest: they settle from the line before
    return np.where(reference.rapid, RAPID, np.where(reference.line > 0, reference.line, REST))


def find_worst_rows(stretch: Int, contour_um: Float, dt_s: float, after_s: float) -> dict[int, tuple[float, int]]:
    """Return for each segment the largest error in it and ``after_s`` behind it, and its row; -1 where it is NaN."""
    judged = np.where(stretch != RAPID, np.nan_to_num(contour_um, nan=-1.0, posinf=np.inf), 0.0)
    size = round(after_s / dt_s) + 1
    ahead = maximum_filter1d(judged, size, origin=-(size // 2), mode="constant") if size > 1 else judged
    edges = np.flatnonzero(np.diff(stretch, prepend=REST - 1)).tolist()
    found: dict[int, tuple[float, int]] = {}
    for first, error in zip(edges, np.maximum.reduceat(ahead, edges).tolist(), strict=True):
        k = int(stretch[first])
        if k >= 0 and (k not in found or error > found[k][0]):
            found[k] = (error, first)
    worst = {}
    for k, (error, first) in found.items():
        row = first + int(np.argmax(ahead[first:] == error))
        worst[k] = (error, row + int(np.argmax(judged[row : row + size])))
    return worst


def evaluate_feeds(
    source: FeedScaledPath, shares: Mapping[int, float], judge: Judge
) -> tuple[Trajectory, dict[int, float]]:
    """Generate a path with its segments at some shares; return it, and each segment's largest error, -1: unknown."""
    reference = source.at(shares)
    worst = find_worst_rows(label_segments(reference), judge(reference), reference.dt_s, source.after_s)
    return reference, {k: error for k, (error, _) in worst.items()}


@dataclass(frozen=True, slots=True)
class SegmentFeeds:
    """The share of the feed of each segment as evaluated together, its largest error, and which are ``held`` by it.

    ``tried`` is the lowest tried share of each, with the largest error there.
    """

    share: Mapping[int, float]
    residual_um: Mapping[int, float]
    within_tolerance: frozenset[int]
    lowest_tried: Mapping[int, tuple[float, float]]


def search_highest_feeds(
    source: FeedScaledPath, over: Mapping[int, float], judge: Judge, tolerance_um: float
) -> SegmentFeeds:
    """Return the highest shares at which ``over`` (segment -> its error as programmed, um) keep the tolerance.

    Every trial predicts the whole path with each segment at its own share; a segment that leaves the tolerance because
    of its neighbours joins. The returned shares keep it together, except those that no share keeps.
    """
    search = _FeedSearch(source, judge, tolerance_um, over)
    search.run_until_settled()
    for _ in range(MOST_RISES):
        if not search.raise_slack_feeds():
            break
        search.run_until_settled()
    return search.collect_feeds()


@dataclass(slots=True)
class _FeedBracket:
    """The bracket of one segment: ``low`` keeps the tolerance, ``high`` does not; ``lost``: no share is worth a trial.

    ``risen`` counts successive higher shares within the tolerance.
    """

    share: float = 1.0
    low: float | None = None
    high: float | None = None
    lost: bool = False
    risen: int = 0
    tried: list[tuple[float, float]] = field(default_factory=list)

    def record_trial(self, share: float, error_um: float, holds: bool) -> None:
        self.tried.append((share, error_um))
        if not holds:
            self.risen = 0
        elif self.low is None or share > self.low:
            self.risen += 1
        if holds:
            self.low, self.lost = share, False
            if self.high is not None and self.high <= share:  # a neighbour has changed since
                self.high = None
        else:
            self.high = share if self.high is None else min(share, self.high)
            if self.low is not None and self.low >= share:
                self.low = None

    def choose_next_share(self, tolerance_um: float) -> float:
        """Return the share to try next, ``low`` when the search has ended."""
        share, error = self.tried[-1]
        if self.low is None and self._is_hopeless(share, error):
            self.lost = True
            return self._find_lowest_useful_share()
        if self.low is not None and (self.low >= 1.0 or (share == self.low and error > FULL * tolerance_um)):
            return self.low
        if self.low is not None and self.high is not None and self.high / self.low <= NARROW:
            return self.low
        wanted = (
            share * (AIM * tolerance_um / error) ** (1.0 / self._estimate_exponent()) if 0.0 < error < np.inf else 0.0
        )
        if self.low is None:
            return max(LOWEST, float(np.clip(wanted, MOST_FALL * share, LEAST_FALL * share)))
        if self.risen > PATIENCE:  # its error hardly depends on its own share: halve the bracket
            wanted = max(wanted, float(np.sqrt(self.low * (self.high or 1.0))))
        if self.high is None:
            return min(1.0, max(wanted, RISE * self.low))
        margin = (self.high / self.low) ** EDGE
        return float(np.clip(wanted, self.low * margin, self.high / margin))

    def _find_lowest_useful_share(self) -> float:
        """Return the highest tried share below which the error is hardly less."""
        least = min(error for _, error in self.tried)
        return max(share for share, error in self.tried if STILL * error <= least)

    def _is_hopeless(self, share: float, error_um: float) -> bool:
        faster = [e for s, e in self.tried if np.isfinite(e) and s >= FAR * share]
        return self.lost or share <= LOWEST or bool(faster and error_um > STILL * faster[-1])

    def _estimate_exponent(self) -> float:
        """Return p of error ~ share ** p by the last trials: 2 for inertia, near 0 for dry friction."""
        known = [(s, e) for s, e in self.tried if 0.0 < e < np.inf]
        if len(known) < 2 or known[-1][0] == known[-2][0]:
            return 2.0
        (s0, e0), (s1, e1) = known[-2:]
        return float(np.clip(np.log(e1 / e0) / np.log(s1 / s0), *POWERS))


class _FeedSearch:
    """Brackets of all segments at once."""

    def __init__(self, source: FeedScaledPath, judge: Judge, tolerance_um: float, over: Mapping[int, float]) -> None:
        self._source, self._judge, self._tolerance_um = source, judge, tolerance_um
        self._open = {k: _FeedBracket() for k in over}
        self._trials = 0
        self._longest_s = LONGEST_S
        self._kept: dict[int, tuple[float, float]] = {}

    def run_until_settled(self) -> None:
        """Run trials until the shares keep the tolerance together and no higher ones are worth a trial."""
        while self._trials < MOST_TRIALS:
            shares = {k: s.share for k, s in self._open.items()}
            bad = self._run_trial(shares)
            for k, stretch in self._open.items():
                if stretch.tried and stretch.tried[-1][0] == shares.get(k):
                    stretch.share = stretch.choose_next_share(self._tolerance_um)
            now = {k: s.share for k, s in self._open.items()}
            if not bad - {k for k, s in self._open.items() if s.lost}:
                self._kept = {k: s.tried[-1] for k, s in self._open.items() if s.tried}
                if sum(share > WORTH * shares.get(k, 1.0) for k, share in now.items()) <= FEW * len(now):
                    return
            if shares == now:
                return

    def raise_slack_feeds(self) -> bool:
        """Reopen segments with slack, whose bracket dates from faster neighbours; return whether there are any."""
        slack = [
            s
            for k, s in self._open.items()
            if s.low is not None and s.low < 1.0 and self._kept.get(k, (0.0, np.inf))[1] < SLACK * self._tolerance_um
        ]
        for stretch in slack:
            stretch.high = None
            stretch.share = stretch.choose_next_share(self._tolerance_um)
        return bool(slack)

    def collect_feeds(self) -> SegmentFeeds:
        known = {k: self._kept.get(k, s.tried[-1] if s.tried else (s.share, np.inf)) for k, s in self._open.items()}
        held = frozenset(k for k, (_, error_um) in self._kept.items() if error_um <= self._tolerance_um)
        tried = {k: min(s.tried, default=known[k]) for k, s in self._open.items()}
        return SegmentFeeds(
            {k: share for k, (share, _) in known.items()}, {k: um for k, (_, um) in known.items()}, held, tried
        )

    def _run_trial(self, shares: Mapping[int, float]) -> set[int]:
        """Evaluate the shares; return the segments that leave the tolerance."""
        reference, error_um = evaluate_feeds(self._source, shares, self._judge)
        seconds = float(reference.time_s[-1] - reference.time_s[0])
        if self._trials == 0:
            self._longest_s = max(LONGEST_S, LONGEST_SHARE * seconds)
        self._trials += 1
        bad = {k for k, error in error_um.items() if error > self._tolerance_um}
        for k in bad - self._open.keys():
            self._open[k] = _FeedBracket()
        for k, stretch in self._open.items():
            error = error_um.get(k, 0.0)
            if error >= 0.0:
                stretch.record_trial(shares.get(k, 1.0), error, k not in bad)
                stretch.lost |= seconds > self._longest_s and k in bad and stretch.low is None
        return bad


def refine_feeds(feeds: SegmentFeeds, source: FeedScaledPath, judge: Judge, tolerance_um: float) -> SegmentFeeds:
    """Return the feeds with each possible segment raised; together they keep the tolerance as before."""
    waiting = {k for k in feeds.within_tolerance if feeds.share[k] * STEP <= 1.0}
    if not waiting:
        return feeds
    raising = _FeedRefinement(feeds, source, judge, tolerance_um)
    for _ in range(MOST_GROUPS):
        if not waiting:
            break
        group = raising.select_separate(waiting)
        waiting -= group
        factors = dict.fromkeys(group, STEP)
        for _ in range(MOST_STEPS):
            factors = raising.try_factors(factors)
            if not factors:
                break
    return raising.collect_feeds()


class _FeedRefinement:
    """Shares, all of which were evaluated."""

    def __init__(self, feeds: SegmentFeeds, source: FeedScaledPath, judge: Judge, tolerance_um: float) -> None:
        self._before, self._source, self._judge, self._tolerance_um = feeds, source, judge, tolerance_um
        self._share = dict(feeds.share)
        self._apart_s = 2 * source.after_s
        self._reference, self._error_um = evaluate_feeds(source, self._share, judge)
        self._most_um = {k: max(tolerance_um, um / STILL) for k, um in self._error_um.items() if um > tolerance_um}

    def _find_violations(self, error_um: Mapping[int, float]) -> list[int]:
        return [k for k, um in error_um.items() if not 0.0 <= um <= self._most_um.get(k, self._tolerance_um)]

    def select_separate(self, waiting: Collection[int]) -> set[int]:
        """Return some of ``waiting`` that do not touch each other, in the order of the path."""
        chosen, end_s = set(), -np.inf
        for k, (first_s, last_s) in sorted(
            _compute_time_spans(self._reference, waiting).items(), key=lambda item: item[1]
        ):
            if first_s > end_s:
                chosen.add(k)
                end_s = last_s + self._apart_s
        return chosen

    def try_factors(self, factors: Mapping[int, float]) -> dict[int, float]:
        """Evaluate some shares times their factors and keep those within the tolerance; return their next factors."""
        tried = {k: min(1.0, self._share[k] * factor) for k, factor in factors.items()}
        reference, error_um = evaluate_feeds(self._source, self._share | tried, self._judge)
        corrupted = _compute_time_spans(reference, self._find_violations(error_um)).values()
        good = {k for k, span in _compute_time_spans(reference, tried).items() if not self._is_near(span, corrupted)}
        further = {
            k: self._estimate_next_factor(tried[k] / self._share[k], self._error_um[k], error_um[k]) for k in good
        }
        self._share |= {k: tried[k] for k in good}
        self._error_um |= {k: error_um[k] for k in good}
        return {k: factor for k, factor in further.items() if factor > WORTH and tried[k] < 1.0}

    def _is_near(self, span: Span, others: Iterable[Span]) -> bool:
        first_s, last_s = span
        return any(first - self._apart_s <= last_s and first_s <= last + self._apart_s for first, last in others)

    def _estimate_next_factor(self, factor: float, before_um: float, now_um: float) -> float:
        """Return the factor that brings an error to its target, by its change with the last one."""
        power = max(float(np.log(now_um / before_um) / np.log(factor)), LEAST_POWER) if before_um > 0.0 else 1.0
        return float(np.clip((AIM * self._tolerance_um / now_um) ** (1.0 / power), 1.0, MOST_STEP))

    def collect_feeds(self) -> SegmentFeeds:
        if self._share == self._before.share:
            return self._before
        _, error_um = evaluate_feeds(self._source, self._share, self._judge)
        if self._find_violations(error_um):
            return self._before
        return replace(self._before, share=self._share, residual_um={k: error_um.get(k, 0.0) for k in self._share})


def _compute_time_spans(reference: Trajectory, wanted: Collection[int]) -> dict[int, Span]:
    stretch = label_segments(reference)
    names, first = np.unique(stretch, return_index=True)
    _, last = np.unique(stretch[::-1], return_index=True)
    start, dt_s = float(reference.time_s[0]), reference.dt_s
    ends = zip(names.tolist(), first.tolist(), (stretch.size - last).tolist(), strict=True)
    return {k: (start + begin * dt_s, start + end * dt_s) for k, begin, end in ends if k in wanted}
