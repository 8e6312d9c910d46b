"""Prints the result of ``fdhil advise``: consecutive lines as one range, with the worst line of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import click

from fdhil.program import cut_to_digits

if TYPE_CHECKING:
    from fdhil.prediction import FeedAdvice, FeedResult

BRACKETED = (
    "this demand does not match the averages of [nc] smoothing_s: the lower feed applies if the NC keeps its smoothing,"
    " the higher one if accelerations fall with the square of the feed"
)
MANY = 20  # ranges shown
SPREADS = (1.1, 1.5, 2.0, 4.0)  # highest to lowest feed within one range
Range = list["FeedAdvice"]


def show_advice(
    advice: Sequence[FeedAdvice],
    most: Mapping[float, FeedAdvice] | None,
    tolerance_um: float,
    corrects: bool,
    feeds: Callable[[int], bool],
) -> None:
    """Print one line per range; ``feeds`` returns whether a program line moves at a feed."""
    if not advice:
        click.echo(f"the whole path stays within {tolerance_um:g} um as programmed")
        return
    found = group_into_ranges(advice, feeds)
    if len(found) > MANY:
        slowest = min(cut_to_digits(a.plain.run * a.feed_mm_min) for a in advice)
        click.echo(f"{len(advice)} lines in {len(found)} ranges, down to F{slowest:g}; the {MANY} worst of them:")
    worst = sorted(found, key=lambda one: -_find_worst(one).error_um)[:MANY]
    for one in sorted(worst, key=lambda one: one[0].start_s):
        _show_range(one, most)
    if len(found) > len(worst):
        click.echo("--json lists every line")
    if most:
        click.echo(BRACKETED)
    if not corrects:
        click.echo("the correction was not evaluated: an axis lacks the section [axis.X.correction]")


def group_into_ranges(advice: Sequence[FeedAdvice], feeds: Callable[[int], bool]) -> list[Range]:
    """Group consecutive lines of similar feeds, widening the feed spread until at most ``MANY`` ranges remain."""
    found: list[Range] = []
    for spread in SPREADS:
        found = list(_split_by_feed(advice, feeds, spread))
        if len(found) <= MANY:
            break
    return found


def _split_by_feed(advice: Sequence[FeedAdvice], feeds: Callable[[int], bool], spread: float) -> Iterator[Range]:
    run: Range = []
    low = high = 0.0
    for a in advice:
        feed = a.plain.run * a.feed_mm_min
        wide = max(high, feed) > spread * min(low, feed)
        if run and (wide or not (_is_similar(run[-1], a) and _is_adjacent(run[-1], a, feeds))):
            yield run
            run = []
        low, high = (min(low, feed), max(high, feed)) if run else (feed, feed)
        run.append(a)
    yield run


def _is_adjacent(before: FeedAdvice, after: FeedAdvice, feeds: Callable[[int], bool]) -> bool:
    """Return whether no feed line lies between two lines; zones of a demand are never grouped."""
    return 0 < before.line < after.line and not any(map(feeds, range(before.line + 1, after.line)))


def _is_similar(one: FeedAdvice, other: FeedAdvice) -> bool:
    """Return whether two lines have the same programmed feed, and both or neither keep the tolerance at a lower one."""
    return one.feed_mm_min == other.feed_mm_min and (one.plain.share is None) == (other.plain.share is None)


def _find_worst(one: Range) -> FeedAdvice:
    return max(one, key=lambda a: a.error_um)


def _show_range(one: Range, most: Mapping[float, FeedAdvice] | None) -> None:
    worst, first, last = _find_worst(one), one[0], one[-1]
    at = f"at line {worst.line}, {worst.where}" if last is not first else f"at {worst.where}"
    name = f"lines {first.line}-{last.line}" if last is not first else f"line {first.line}"
    if not first.line:
        name = f"{first.start_s:.2f} s .. {first.end_s:.2f} s"
    fast = worst.corrected if worst.corrected and worst.corrected.share is not None else None
    better = "" if fast is None else f", with the correction F{cut_to_digits(fast.run * worst.feed_mm_min):g}"
    click.echo(
        f"{name}: F{_format_feed_span([a.feed_mm_min for a in one])} -> "
        f"F{_format_feed_span([cut_to_digits(a.plain.run * a.feed_mm_min) for a in one])}"
        f"{better}, worst {worst.error_um:.1f} um {at} ({worst.cause}, most of it axis {worst.axis})"
    )
    axis, what, share = max((a.load for a in one), key=lambda load: load[2])
    if share > 1.0:
        click.echo(f"  the drive of axis {axis} needs {share * 100:.0f} % of its {what} limit")
    other = (most or {}).get(worst.start_s, worst)
    for kind, held, hopeful in (
        ("without correction", worst.plain, other.plain),
        ("with the correction", worst.corrected, other.corrected),
    ):
        if held is not None and (held.share is None or _is_clearly_higher(held, hopeful)):
            click.echo(f"  {kind}: {_format_limit(held, hopeful, worst.feed_mm_min)}")


def _format_feed_span(feeds: Sequence[float]) -> str:
    low, high = min(feeds), max(feeds)
    return f"{high:g}" if cut_to_digits(low) == cut_to_digits(high) else f"{low:g}..{high:g}"


def _format_limit(held: FeedResult, most: FeedResult | None, feed_mm_min: float) -> str:
    if held.share is None:
        left = f": an error of {held.residual_um:.1f} um remains" if math.isfinite(held.residual_um) else ""
        with_it = (
            f"; the other lines keep the tolerance with this one at {cut_to_digits(held.run * feed_mm_min):g}"
            if held.run > held.tried
            else ""
        )
        return f"no feed down to {cut_to_digits(held.tried * feed_mm_min):g} mm/min keeps the tolerance{left}{with_it}"
    hopeful = most.share * feed_mm_min if most and most.share and _is_clearly_higher(held, most) else None
    more = "" if hopeful is None else f", perhaps {cut_to_digits(hopeful):g}"
    return f"at most {cut_to_digits(held.share * feed_mm_min):g} mm/min{more}"


def _is_clearly_higher(held: FeedResult, most: FeedResult | None) -> bool:
    return bool(most and most.share and held.share and most.share > 1.02 * held.share)
