"""Join short lines within Q (G64 P Q): consecutive feeds become one if none of their ends is far from it.

As LinuxCNC does before planning: a feed is joined to the previous ones while every intermediate end is within Q of the
line from the start of the first to the end of the last, up to a hundred feeds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fdhil.program.motions import Feed, Motion, Point
from fdhil.program.planner.linuxcnc.path_shapes import add_scaled, compute_dot, subtract_points

_MOST = 100


def join_short_feeds(motions: Iterable[Motion], start: Point = (0.0, 0.0, 0.0)) -> Iterator[Motion]:
    """Yield motions with the feeds joined as their corner's ``joining_mm`` allows."""
    chain: list[Feed] = []
    at = start
    for motion in motions:
        if chain and not (isinstance(motion, Feed) and not motion.rotary and _is_joinable(at, chain, motion)):
            yield chain[-1]
            at = chain[-1].end
            chain.clear()
        if isinstance(motion, Feed) and motion.corner.mode == "blend" and not motion.rotary:
            if motion.end != at or chain:
                chain.append(motion)
            continue
        yield motion
        at = getattr(motion, "end", at)
    if chain:
        yield chain[-1]


def _is_joinable(at: Point, chain: list[Feed], motion: Feed) -> bool:
    last = chain[-1]
    if motion.corner != last.corner or motion.feed != last.feed or len(chain) > _MOST or motion.end == at:
        return False
    way = subtract_points(motion.end, at)
    square = compute_dot(way, way)
    for feed in chain:
        off = subtract_points(feed.end, at)
        share = min(1.0, max(0.0, compute_dot(way, off) / square))
        deviation = subtract_points(off, add_scaled((0.0, 0.0, 0.0), way, share))
        if compute_dot(deviation, deviation) > last.corner.joining_mm**2:
            return False
    return True
