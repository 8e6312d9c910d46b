"""The corrected path: rows of demand and offset per axis in drive increments, and where on it the machine is.

A row's demand is what the NC will send as 0x607A, so that the guard finds its place by looking, not by a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

EPS = 2
"""Increments by which a sniffed target may differ from the table's demand."""
SEARCH = 8
"""Rows to either side of the expected one among which a start is looked for."""


@dataclass(frozen=True, slots=True)
class Path:
    """Rows [first, end) of a table; ``final``: no more rows follow. Per axis one sequence of integers.

    A streamed table is a Path that grows at its end and is cut at its begin: rows keep their number.
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

    def standing_rows(self) -> int:
        """Return the number of the last row that still stands at the first row's demand."""
        row = self.first
        start = [values[0] for values in self.demand]
        while self.has(row + 1) and self.mismatch(row + 1, start) == 0:
            row += 1
        return row


@dataclass(frozen=True, slots=True)
class Place:
    """A row that the machine may be at, and how far the targets were off it since the search began."""

    row: int
    cost: int = 0


def around(path: Path, row: int, targets: Sequence[int]) -> tuple[Place, ...]:
    """Return the rows near ``row`` whose demand is the targets', the nearest first: a place is looked for."""
    places = []
    for candidate in sorted(range(row - SEARCH, row + SEARCH + 1), key=lambda r: (abs(r - row), r)):
        distance = path.mismatch(candidate, targets)
        if distance is not None and distance <= EPS:
            places.append(Place(candidate, distance))
    return best_first(places)


def advance(path: Path, places: Sequence[Place], targets: Sequence[int] | None) -> tuple[Place, ...]:
    """Move each place one row on and keep those that the targets agree with; without targets time alone moves them."""
    if targets is None:
        return tuple([Place(place.row + 1, place.cost) for place in places])
    moved = []
    for place in places:
        distance = path.mismatch(place.row + 1, targets)
        if distance is not None and distance <= EPS:
            moved.append(Place(place.row + 1, place.cost + distance))
    return best_first(moved) if len(moved) > 1 else tuple(moved)


def best_first(places: Sequence[Place]) -> tuple[Place, ...]:
    """Sort by what they cost so far; equals keep their order."""
    return tuple(sorted(places, key=lambda place: place.cost))
