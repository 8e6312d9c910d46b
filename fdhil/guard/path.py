"""Holds the corrected path, rows of demand and offset per axis in drive increments, and finds the machine on it.

A row's demand is what the NC will send as 0x607A, so that the guard finds its place by looking, not by a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

EPS = 2
"""Increments by which a sniffed target may differ from the table's demand."""
SEARCH = 8
"""Rows to either side of the expected one among which a start is looked for."""


@dataclass(frozen=True, slots=True)
class CorrectedPath:
    """Rows [first, end) of a table; ``final``: no more rows follow. Per axis one sequence of integers.

    A streamed table is a CorrectedPath that grows at its end and is cut at its begin: rows keep their number.
    """

    first: int
    demand: tuple[Sequence[int], ...]
    offset: tuple[Sequence[int], ...]
    final: bool
    program_digest: str
    sequence: int = 0

    @property
    def end(self) -> int:
        """One past the last row."""
        return self.first + len(self.demand[0])

    def has(self, row: int) -> bool:
        """Whether a row is in the table."""
        return self.first <= row < self.end

    def offsets_at(self, row: int) -> tuple[int, ...]:
        """Return the offsets of one row, per axis; row numbers outside give the nearest end's."""
        k = min(max(row, self.first), self.end - 1) - self.first
        return tuple([values[k] for values in self.offset])

    def mismatch(self, row: int, targets: Sequence[int]) -> int | None:
        """Return the largest distance of ``targets`` from a row's demand; None where there is no such row."""
        if not self.has(row):
            return None
        k = row - self.first
        return max([abs(values[k] - target) for values, target in zip(self.demand, targets, strict=True)])

    def stands(self, row: int) -> bool:
        """Whether the demand stands from this row to the next."""
        return self.has(row) and self.mismatch(row + 1, [values[row - self.first] for values in self.demand]) == 0

    def standing_rows(self) -> int:
        """Return the number of the last row that still stands at the first row's demand."""
        return self.first + min(map(_alike, self.demand)) - 1


def _alike(values: Sequence[int]) -> int:
    """Return how many values at the begin are equal; runs are compared, not values: a dwell has thousands of rows.

    A run of equal values is doubled until the next one differs, then halved to where it begins to.
    """
    step = 1
    while values[step : 2 * step] == values[:step]:
        step *= 2
    count = step
    while step := step // 2:
        if values[count : count + step] == values[:step]:
            count += step
    return count


@dataclass(frozen=True, slots=True)
class Place:
    """A row that the machine may be at, and how far the targets were off it since the search began."""

    row: int
    cost: int = 0


def around(path: CorrectedPath, row: int, targets: Sequence[int]) -> tuple[Place, ...]:
    """Return the rows near ``row`` whose demand is the targets', the nearest first: a place is looked for."""
    near = sorted(range(row - SEARCH, row + SEARCH + 1), key=lambda r: (abs(r - row), r))
    return _agreeing(path, [Place(candidate) for candidate in near], targets)


def advance(path: CorrectedPath, places: Sequence[Place], targets: Sequence[int] | None) -> tuple[Place, ...]:
    """Move each place one row on and keep those that the targets agree with; without targets time alone moves them."""
    moved = onward(places)
    return moved if targets is None else _agreeing(path, moved, targets)


def onward(places: Sequence[Place]) -> tuple[Place, ...]:
    """Move each place one row on."""
    return tuple([Place(place.row + 1, place.cost) for place in places])


def _agreeing(path: CorrectedPath, places: Sequence[Place], targets: Sequence[int]) -> tuple[Place, ...]:
    """Return the places that the targets agree with, by what they cost so far; equals keep their order."""
    off = [(place, path.mismatch(place.row, targets)) for place in places]
    agreeing = [Place(place.row, place.cost + by) for place, by in off if by is not None and by <= EPS]
    return tuple(sorted(agreeing, key=lambda place: place.cost))


def rate_between(path: CorrectedPath, row: int, last: Sequence[int], targets: Sequence[int]) -> float | None:
    """Return at what share of the planned rate the targets move along the path near ``row``; None: they leave it.

    Both targets must lie on the straights between neighbouring rows, which an override or a feed hold leads to.
    """
    here, there = _fraction(path, row, last), _fraction(path, row, targets)
    return None if here is None or there is None else there - here


def _fraction(path: CorrectedPath, row: int, targets: Sequence[int]) -> float | None:
    """Return where on the path the targets are, in rows, within ``2 SEARCH`` before and ``SEARCH`` behind ``row``."""
    for k in range(min(row + SEARCH, path.end - 2), max(row - 2 * SEARCH, path.first - 1), -1):
        rows = [(values[k - path.first], values[k + 1 - path.first]) for values in path.demand]
        longest = max(range(len(rows)), key=lambda axis: abs(rows[axis][1] - rows[axis][0]))
        begin, end = rows[longest]
        part = (targets[longest] - begin) / (end - begin) if end != begin else nan
        ways = zip(rows, targets, strict=True)
        if 0 <= part < 1 and all(abs(a + part * (b - a) - target) <= 2 * EPS for (a, b), target in ways):
            return k + part
    return None
