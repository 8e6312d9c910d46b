"""Where a path leaves a tolerance, why, and the highest feed of each stretch at which it would not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from fdhil.config import MachineConfig
from fdhil.prediction import load
from fdhil.prediction.predict import predict
from fdhil.program import Arc, Feed, Motion
from fdhil.program import plan as plan_program
from fdhil.records import Float, Int, Parameters, Prediction, Trajectory, Zone

# of the feed, tried first: a bracket for every stretch
SHARES = (1.0, 0.8, 0.6, 0.4, 0.25, 0.15, 0.08, 0.04, 0.02)
NARROW = 1.02  # two shares nearer than this are not parted further
AFTER_S = 0.2  # an error belongs to what was ordered up to so long before it: the loops need to settle
NEAR_S = 0.1  # an error that swings through 0 makes several zones of one corner
TOGETHER = 8  # rounds in which all stretches run at their own feeds
MOST_TRIALS = 30
RAPID, REST = -1, -2  # rows of no stretch: not judged at all, and judged for the stretch before
PIECES = 400  # of a recorded demand, which has no lines

Judge = Callable[[Trajectory], Float]


@dataclass(frozen=True, slots=True)
class Source:
    """A path that can be had at a share of its feed.

    ``at`` gives the reference at a share, ``mixed`` at a share per stretch (None where there is no such thing);
    ``stretch`` the stretch (n,) that each row belongs to, RAPID or REST; ``line`` and ``feed_mm_min`` of a stretch.
    """

    at: Callable[[float], Trajectory]
    mixed: Callable[[Mapping[int, float]], Trajectory] | None
    stretch: Callable[[Trajectory], Int]
    line: Callable[[int], int]
    feed_mm_min: Callable[[int], float]


@dataclass(frozen=True, slots=True)
class Advice:
    """One stretch that leaves the tolerance: its error as programmed, where and why, and the feeds that keep it.

    ``line`` 0: a recorded demand. ``demand``: (axis, "current" or "voltage", share of its limit) where the path asks
    for more than the drive has, else None. ``share`` of the feed without and ``corrected_share`` with the correction;
    None where no feed that was tried keeps the tolerance, or there is no correction.
    """

    line: int
    error_um: float
    where: str
    cause: str
    demand: tuple[str, str, float] | None
    feed_mm_min: float
    share: float | None
    corrected_share: float | None


def at_shares(motions: Sequence[Motion], share: Callable[[int], float]) -> list[Motion]:
    """Return the motions with every programmed feed times the share of its line; rapids and dwells stay."""
    return [replace(m, feed=m.feed * share(m.line)) if isinstance(m, Feed | Arc) else m for m in motions]


def program_source(motions: Sequence[Motion], config: MachineConfig) -> Source:
    """Return a program as a source: its stretches are its lines."""
    feeds: dict[int, float] = {}
    for motion in motions:
        if isinstance(motion, Feed | Arc):
            feeds[motion.line] = max(motion.feed, feeds.get(motion.line, 0.0))
    return Source(
        at=lambda share: plan_program(at_shares(motions, lambda _: share), config),
        mixed=lambda shares: plan_program(at_shares(motions, lambda line: shares.get(line, 1.0)), config),
        # rows without a line are a rest: what remains of the line before
        stretch=lambda reference: np.where(reference.rapid, RAPID, np.where(reference.line > 0, reference.line, REST)),
        line=lambda stretch: stretch,
        feed_mm_min=lambda stretch: feeds.get(stretch, 0.0),
    )


def demand_source(reference: Trajectory) -> Source:
    """Return a recorded demand as a source, played slower: its stretches are equal pieces of the way."""
    speeds = _way(reference, 1)

    def slower(share: float) -> Trajectory:
        rows = np.arange(0.0, reference.time_s.size - 1 + share, share)
        grid = np.arange(reference.time_s.size, dtype=np.float64)
        return Trajectory(
            dt_s=reference.dt_s,
            time_s=reference.time_s[0] + np.arange(rows.size) * reference.dt_s,
            position_mm={axis: np.interp(rows, grid, path) for axis, path in reference.position_mm.items()},
            rapid=np.zeros(rows.size, dtype=np.bool_),
            line=np.zeros(rows.size, dtype=np.int64),
        )

    pieces = _pieces(reference)
    fastest = np.zeros(PIECES)
    np.maximum.at(fastest, pieces, speeds * 60.0 / reference.dt_s)
    return Source(slower, None, _pieces, lambda _: 0, lambda stretch: float(fastest[stretch]))


def _way(reference: Trajectory, which: int) -> Float:
    """Return (n,) the way to each row (0) or the way from each row to the next (1), mm."""
    path = np.column_stack([reference.position_mm[axis] for axis in reference.axes])
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.append(step, 0.0) if which else np.append(0.0, np.cumsum(step))


def _pieces(reference: Trajectory) -> Int:
    way = _way(reference, 0)
    return np.minimum(way / max(float(way[-1]), 1e-9) * PIECES, PIECES - 1).astype(np.int64)


def advise(
    source: Source,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    tolerance_um: float,
    corrected: Judge | None = None,
) -> tuple[Advice, ...]:
    """Return one advice per stretch whose contour error exceeds ``tolerance_um``, in the order of the path.

    ``corrected`` judges a reference with its correction: contour error (n,) um. Every share is planned and predicted
    as a whole, so that a stretch is judged with its neighbours slowed alike, then all at their own feeds. Neighbouring
    stretches of a recorded demand that leave the tolerance for one reason are one.
    """
    reference = source.at(1.0)
    prediction = predict(reference, models, config, zones_above_um=tolerance_um)
    stretch = source.stretch(reference)
    worst = _worst(stretch, prediction.contour_um, reference.dt_s)
    over = [k for k, (error, _) in worst.items() if error > tolerance_um]
    if not over:
        return ()
    plain = _highest_shares(source, over, lambda r: predict(r, models, config).contour_um, tolerance_um)
    better = plain if corrected is None else _highest_shares(source, over, corrected, tolerance_um)
    loads = {
        axis: load.required(reference.position_mm[axis], models[axis], config.axis[axis], reference.dt_s)
        for axis in reference.axes
    }
    first = {k: int(np.argmax(stretch == k)) for k in over}
    found, zones = [], []
    for k in sorted(over, key=first.__getitem__):
        error, row = worst[k]
        zones.append(_zone(prediction, row))
        advice = Advice(
            line=source.line(k),
            error_um=error,
            where=" ".join(f"{axis} {reference.position_mm[axis][row]:.1f}" for axis in reference.axes),
            cause=zones[-1].cause if zones[-1] else "straight",
            demand=_demand(loads, stretch == k),
            feed_mm_min=source.feed_mm_min(k),
            share=plain[k],
            corrected_share=None if corrected is None else better[k],
        )
        found.append(advice)
    return tuple(found) if source.mixed else _joined(found, zones)


def _joined(found: Sequence[Advice], zones: Sequence[Zone | None]) -> tuple[Advice, ...]:
    """Join the advice on pieces whose worst rows are in one zone, or in two of one cause close to each other."""
    joined: list[Advice] = []
    before: Zone | None = None
    for zone, advice in zip(zones, found, strict=True):
        apart = before is None or zone is None or zone.cause != before.cause or zone.start_s > before.end_s + NEAR_S
        before = zone
        if apart:
            joined.append(advice)
            continue
        last = joined.pop()
        worse = max(last, advice, key=lambda a: a.error_um)
        demands = [a.demand for a in (last, advice) if a.demand]
        joined.append(
            replace(
                worse,
                share=_lower(last.share, advice.share),
                corrected_share=_lower(last.corrected_share, advice.corrected_share),
                demand=max(demands, key=lambda d: d[2], default=None),
                feed_mm_min=max(last.feed_mm_min, advice.feed_mm_min),
            )
        )
    return tuple(joined)


def _lower(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else min(one, other)


def _worst(stretch: Int, contour_um: Float, dt_s: float) -> dict[int, tuple[float, int]]:
    """Return for each stretch the largest error in it and ``AFTER_S`` behind it, and its row."""
    judged = np.where(stretch != RAPID, contour_um, 0.0)
    size = round(AFTER_S / dt_s) + 1
    ahead = maximum_filter1d(judged, size, origin=-((size - 1) // 2), mode="constant")
    rows = np.flatnonzero(stretch >= 0)
    order = rows[np.argsort(ahead[rows], kind="stable")]
    # the last one of a stretch in the order of the errors is its largest
    last = {int(stretch[row]): row for row in order.tolist()}
    return {k: (float(ahead[row]), row + int(np.argmax(judged[row : row + size]))) for k, row in last.items()}


def _zone(prediction: Prediction, row: int) -> Zone | None:
    """Return the zone around a row, or the one next to it: the shortest ones are left out."""
    time = float(prediction.reference.time_s[row])
    return min(prediction.zones, key=lambda z: max(z.start_s - time, time - z.end_s), default=None)


def _demand(loads: Mapping[str, tuple[Float, Float]], rows: Float) -> tuple[str, str, float] | None:
    """Return what is demanded beyond a limit in some rows, the worst of it."""
    demands = [
        (axis, what, float(shares[rows].max()))
        for axis, both in loads.items()
        for what, shares in zip(("current", "voltage"), both, strict=True)
    ]
    worst = max(demands, key=lambda demand: demand[2])
    return worst if worst[2] > 1.0 else None


def _highest_shares(source: Source, over: Sequence[int], judge: Judge, tolerance_um: float) -> dict[int, float | None]:
    """Return per stretch the highest share of the feed at which, and below which, it stays within the tolerance."""
    tried: dict[float, dict[int, tuple[float, int]]] = {}

    def trial(share: float) -> None:
        reference = source.at(share)
        tried[share] = _worst(source.stretch(reference), judge(reference), reference.dt_s)

    for share in SHARES:
        trial(share)
        if all(_kept(tried[share], k, tolerance_um) for k in over):
            break
    while len(tried) < MOST_TRIALS:
        brackets = {_bracket(tried, k, tolerance_um) for k in over}
        wide = [(high / low, low, high) for low, high in brackets if low > 0 and high / low > NARROW]
        if not wide:
            break
        _, low, high = max(wide)
        trial(float(np.sqrt(low * high)))
    shares = {k: _bracket(tried, k, tolerance_um)[0] or None for k in over}
    return _together(source, shares, judge, tolerance_um)


def _together(
    source: Source, shares: dict[int, float | None], judge: Judge, tolerance_um: float
) -> dict[int, float | None]:
    """Lower the shares until the path keeps the tolerance with every stretch at its own."""
    known = {k: share for k, share in shares.items() if share is not None}
    if source.mixed is None or len(known) < len(shares):
        return shares
    lowest = min(known.values())
    for _ in range(TOGETHER):
        reference = source.mixed(known)
        worst = _worst(source.stretch(reference), judge(reference), reference.dt_s)
        over = [k for k in known if worst.get(k, (0.0, 0))[0] > tolerance_um]
        if not over:
            return dict(known)
        # all of them at the lowest share are within it, so halfway to that helps
        known |= {k: max(lowest, 0.98 * float(np.sqrt(known[k] * lowest))) for k in over}
    return dict.fromkeys(shares, lowest)


def _kept(worst: Mapping[int, tuple[float, int]], stretch: int, tolerance_um: float) -> bool:
    return worst.get(stretch, (0.0, 0))[0] <= tolerance_um


def _bracket(
    tried: Mapping[float, Mapping[int, tuple[float, int]]], stretch: int, tolerance_um: float
) -> tuple[float, float]:
    """Return the highest share below which nothing exceeds the tolerance (0: none), and the next one that does."""
    low = 0.0
    for share in sorted(tried):
        if not _kept(tried[share], stretch, tolerance_um):
            return low, share
        low = share
    return low, low
