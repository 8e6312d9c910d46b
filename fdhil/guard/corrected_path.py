"""Holds the corrected path, rows of demand and offset per axis in drive increments, and locates the machine on it.

A row's demand is what the NC will send as 0x607A, so that the guard finds its position by comparison, not by a clock.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

EPS = 2
"""Increments by which a received target may differ from the table's demand."""
SEARCH = 8
"""Rows on either side of the expected one that are searched."""


@dataclass(frozen=True, slots=True)
class CorrectedPath:
    """Rows [first, end) of a table; ``final``: no more rows follow. Per axis one sequence of integers.

    A streamed table grows at its end and is cut at its start: rows keep their number.
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

    def has_row(self, row: int) -> bool:
        """Return whether a row is in the table."""
        return self.first <= row < self.end

    def get_row_offsets(self, row: int) -> tuple[int, ...]:
        """Return the offsets of one row, per axis; a row number outside gets those of the nearest end."""
        k = min(max(row, self.first), self.end - 1) - self.first
        return tuple([values[k] for values in self.offset])

    def measure_row_distance(self, row: int, targets: Sequence[int]) -> int | None:
        """Return the largest distance of ``targets`` from a row's demand; None where there is no such row."""
        if not self.has_row(row):
            return None
        k = row - self.first
        return max([abs(values[k] - target) for values, target in zip(self.demand, targets, strict=True)])

    def is_demand_standing(self, row: int) -> bool:
        """Return whether the demand is the same in this row and the next."""
        return (
            self.has_row(row)
            and self.measure_row_distance(row + 1, [values[row - self.first] for values in self.demand]) == 0
        )

    def count_standing_rows(self) -> int:
        """Return the number of the last row before the demand first changes."""
        return self.first + min(map(_count_equal_values, self.demand)) - 1


def _count_equal_values(values: Sequence[int]) -> int:
    """Return how many leading values are equal, comparing runs, not values: a dwell has thousands of rows.

    The run is doubled until the next one differs, then halved to find its end.
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
class PathPosition:
    """A row that the machine may be at, and how far the targets deviated from it since the search began (``cost``)."""

    row: int
    cost: int = 0


def search_near_row(path: CorrectedPath, row: int, targets: Sequence[int]) -> tuple[PathPosition, ...]:
    """Return the rows near ``row`` whose demand matches the targets, the nearest first."""
    near = sorted(range(row - SEARCH, row + SEARCH + 1), key=lambda r: (abs(r - row), r))
    return _select_matching(path, [PathPosition(candidate) for candidate in near], targets)


def advance_matching(
    path: CorrectedPath, places: Sequence[PathPosition], targets: Sequence[int] | None
) -> tuple[PathPosition, ...]:
    """Advance each candidate by one row and keep those that match; without targets all are kept."""
    moved = advance_positions(places)
    return moved if targets is None else _select_matching(path, moved, targets)


def advance_positions(places: Sequence[PathPosition]) -> tuple[PathPosition, ...]:
    """Advance each candidate by one row."""
    return tuple([PathPosition(place.row + 1, place.cost) for place in places])


def _select_matching(
    path: CorrectedPath, places: Sequence[PathPosition], targets: Sequence[int]
) -> tuple[PathPosition, ...]:
    """Return the candidates that match the targets, by their cost so far; the order of equals is kept."""
    off = [(place, path.measure_row_distance(place.row, targets)) for place in places]
    agreeing = [PathPosition(place.row, place.cost + by) for place, by in off if by is not None and by <= EPS]
    return tuple(sorted(agreeing, key=lambda place: place.cost))


def compute_path_rate(path: CorrectedPath, row: int, last: Sequence[int], targets: Sequence[int]) -> float | None:
    """Return the rate of the targets along the path near ``row``, 1 as planned; None: they leave the path.

    Both targets must lie on straight lines between neighbouring rows, as with an override or a feed hold.
    """
    here, there = _locate_between_rows(path, row, last), _locate_between_rows(path, row, targets)
    return None if here is None or there is None else there - here


def _locate_between_rows(path: CorrectedPath, row: int, targets: Sequence[int]) -> float | None:
    """Return the position of the targets on the path, in rows, from ``2 SEARCH`` before to ``SEARCH`` after ``row``."""
    for k in range(min(row + SEARCH, path.end - 2), max(row - 2 * SEARCH, path.first - 1), -1):
        rows = [(values[k - path.first], values[k + 1 - path.first]) for values in path.demand]
        longest = max(range(len(rows)), key=lambda axis: abs(rows[axis][1] - rows[axis][0]))
        begin, end = rows[longest]
        part = (targets[longest] - begin) / (end - begin) if end != begin else nan
        ways = zip(rows, targets, strict=True)
        if 0 <= part < 1 and all(abs(a + part * (b - a) - target) <= 2 * EPS for (a, b), target in ways):
            return k + part
    return None
