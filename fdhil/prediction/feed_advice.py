"""Advises feeds: where a path leaves a tolerance, why, and the highest feed of each segment that keeps it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.prediction.feed_search import (
    FeedScaledPath,
    Judge,
    SegmentFeeds,
    find_worst_rows,
    label_segments,
    refine_feeds,
    search_highest_feeds,
)
from fdhil.prediction.inverse_dynamics import compute_required_shares
from fdhil.prediction.path_prediction import predict_contour_um, predict_path
from fdhil.records import Float, Int, Parameters, Prediction, Zone

ALONG_MM = 1e-9  # rows that move less have no direction


@dataclass(frozen=True, slots=True)
class FeedResult:
    """The highest ``share`` of the feed that keeps a segment within the tolerance; None if no tried share does.

    ``left_um`` is its largest error at ``tried``: at ``share``, or at the lowest tried share. ``run`` is the share used
    while the other segments were searched.
    """

    share: float | None
    tried: float
    residual_um: float
    run: float


@dataclass(frozen=True, slots=True)
class FeedAdvice:
    """One segment that leaves the tolerance: its error as programmed, where and why, and the feeds that keep it.

    ``line`` 0: a recorded demand, from ``start_s`` to ``end_s``. ``axis`` has the largest error across the path.
    ``load``: (axis, "current" or "voltage", share of its limit) of the largest demand. ``corrected`` None: not tried.
    """

    line: int
    start_s: float
    end_s: float
    error_um: float
    where: str
    cause: str
    axis: str
    load: tuple[str, str, float]
    feed_mm_min: float
    plain: FeedResult
    corrected: FeedResult | None


def advise_feeds(
    source: FeedScaledPath,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    tolerance_um: float,
    corrected: Judge | None = None,
) -> tuple[FeedAdvice, ...]:
    """Return one advice per segment whose contour error exceeds ``tolerance_um``, in the order of the path.

    Segments that exceed it only once their neighbours are slowed are included. ``corrected`` predicts a reference with
    its correction. The feeds are valid together: the path with every segment at its own was predicted as a whole.
    """
    reference = source.at({})
    prediction = predict_path(reference, models, config, zones_above_um=tolerance_um)
    stretch = label_segments(reference)
    worst = find_worst_rows(stretch, prediction.contour_um, reference.dt_s, source.after_s)
    over = {k: error for k, (error, _) in worst.items() if error > tolerance_um}
    if not over:
        return ()
    plain = _search_feeds(source, over, lambda r: predict_contour_um(r, models, config), tolerance_um)
    better = _search_feeds(source, over, corrected, tolerance_um) if corrected is not None else None
    loads = {
        axis: compute_required_shares(reference.position_mm[axis], models[axis], config.axis[axis], reference.dt_s)
        for axis in reference.axes
    }
    slowed = {k for feeds in (plain, better) if feeds for k, share in feeds.share.items() if share < 1.0}
    found = []
    for k in sorted(over.keys() | slowed, key=lambda k: int(np.argmax(stretch == k))):
        error, row = worst[k]
        rows = np.flatnonzero(stretch == k)
        zone = _find_zone(prediction, row)
        advice = FeedAdvice(
            line=source.line(k),
            start_s=float(reference.time_s[rows[0]]),
            end_s=float(reference.time_s[rows[-1]]) + reference.dt_s,
            error_um=error,
            where=reference.describe_position(row),
            cause=zone.cause if zone else "straight",
            axis=_find_worst_axis(prediction, row),
            load=_find_largest_load(loads, rows),
            feed_mm_min=source.feed_mm_min(k),
            plain=_get_feed_result(plain, k),
            corrected=None if better is None else _get_feed_result(better, k),
        )
        found.append(advice)
    return tuple(found)


def _search_feeds(source: FeedScaledPath, over: Mapping[int, float], judge: Judge, tolerance_um: float) -> SegmentFeeds:
    return refine_feeds(search_highest_feeds(source, over, judge, tolerance_um), source, judge, tolerance_um)


def _get_feed_result(feeds: SegmentFeeds, stretch: int) -> FeedResult:
    if stretch not in feeds.share:
        return FeedResult(1.0, 1.0, 0.0, 1.0)  # it needs no advice
    run = feeds.share[stretch]
    if stretch in feeds.within_tolerance:
        return FeedResult(run, run, feeds.residual_um[stretch], run)
    return FeedResult(None, *feeds.lowest_tried[stretch], run)


def _find_zone(prediction: Prediction, row: int) -> Zone | None:
    """Return the zone around a row, or the nearest one: the shortest zones are left out."""
    time = float(prediction.reference.time_s[row])
    return min(prediction.zones, key=lambda z: max(z.start_s - time, time - z.end_s), default=None)


def _find_worst_axis(prediction: Prediction, row: int) -> str:
    reference = prediction.reference
    error = np.array([prediction.error_um[axis][row] for axis in reference.axes])
    first, last = max(row - 1, 0), min(row + 1, reference.time_s.size - 1)
    way = np.array([reference.position_mm[axis][last] - reference.position_mm[axis][first] for axis in reference.axes])
    length = float(np.linalg.norm(way))
    across = error - way * float(way @ error) / length**2 if length > ALONG_MM and len(way) > 1 else error
    return reference.axes[int(np.argmax(np.abs(across)))]


def _find_largest_load(loads: Mapping[str, tuple[Float, Float]], rows: Int) -> tuple[str, str, float]:
    return max(
        (
            (axis, what, float(shares[rows].max()))
            for axis, both in loads.items()
            for what, shares in zip(("current", "voltage"), both, strict=True)
        ),
        key=lambda asked: asked[2],
    )
