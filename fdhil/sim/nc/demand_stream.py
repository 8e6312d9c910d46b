"""Receives a demand row by row from another NC and returns one row per SYNC.

The rows arrive on another clock than the SYNC, in bursts: a short lead is buffered, so that a late burst causes no
jerk.
"""

import math
from collections import deque
from collections.abc import Sequence

LEAD_S = 0.25  # buffered before the first row is played, and again after a gap
LONG_REST_S = 0.5  # a longer rest is shortened while rows pile up
FULL_ROWS = 20_000  # reading pauses while so many rows wait
_STEP_TOLERANCE = 0.01  # of the SYNC period, between two rows
_ROUNDING_S = 1.1e-6  # times may be written with 6 decimals


class StreamError(ValueError):
    """A row of the stream cannot be played; the message says why, and what is expected."""


class DemandStream:
    """A demand ``time_s,X_mm,Y_mm`` that arrives by :meth:`take` and is played by :meth:`step`, until :meth:`close`.

    Without a row it holds its position: before the first, where rows are late, and at the end. ``rows`` counts the
    played rows; ``starved`` those missing during a motion.
    """

    def __init__(self, axes: Sequence[str], period_s: float) -> None:
        self.rows = self.starved = 0
        self._axes, self._period_s = tuple(axes), period_s
        self._lead = math.ceil(LEAD_S / period_s)
        self._columns: list[int] | None = None
        self._width = 0
        self._waiting: deque[list[float]] = deque()
        self._time_s: float | None = None
        self._here: list[float] = []
        self._flows = self._moving = self._closed = False
        self._long_rest, self._rested = math.ceil(LONG_REST_S / period_s), 0

    def receive_line(self, line: str) -> None:
        """Receive one line: first the column names, then rows; StreamError when it cannot be played.

        An error ends the stream: later lines are ignored, as they would cause a jump.
        """
        if self._closed or not line.strip():
            return
        try:
            self._receive_cells(line.strip().split(","))
        except StreamError:
            self.close_stream()
            raise

    def _receive_cells(self, cells: list[str]) -> None:
        if self._columns is None:
            self._name_columns(cells)
            return
        try:
            numbers = [float(cell) for cell in cells]
        except ValueError:
            numbers = []
        if len(numbers) != self._width or not all(map(math.isfinite, numbers)):
            raise StreamError(f"the row {','.join(cells)[:60]!r} is not a list of {self._width} finite numbers")
        self._check_time(numbers[self._columns[0]])
        self._waiting.append([numbers[k] for k in self._columns[1:]])
        if not self._here:
            self._drop_leading_standstill()

    def _name_columns(self, cells: list[str]) -> None:
        names, wanted = [cell.strip() for cell in cells], ["time_s", *(f"{axis}_mm" for axis in self._axes)]
        if absent := [name for name in wanted if name not in names]:
            raise StreamError(f"column {', '.join(absent)} is missing; a demand starts with {','.join(wanted)}")
        self._columns, self._width = [names.index(name) for name in wanted], len(names)

    def _check_time(self, time_s: float) -> None:
        before, self._time_s = self._time_s, time_s
        off_s = 0.0 if before is None else abs(time_s - before - self._period_s)
        if off_s > _STEP_TOLERANCE * self._period_s + 2 * _ROUNDING_S:
            raise StreamError(
                f"the row of {time_s:g} s follows that of {before:g} s; rows are one SYNC ({self._period_s:g} s) apart"
            )

    def _drop_leading_standstill(self) -> None:
        """Limit the standstill before the first row to the lead."""
        if len(self._waiting) > self._lead and self._waiting[0] == self._waiting[1]:
            self._waiting.popleft()

    def close_stream(self) -> None:
        """End the input; buffered rows are still played."""
        self._closed = True

    @property
    def _has_lead(self) -> bool:
        return bool(self._waiting) and (self._closed or len(self._waiting) >= self._lead)

    @property
    def start_mm(self) -> list[float] | None:
        """The first row, once enough rows are there to start."""
        return self._waiting[0] if self._has_lead else None

    @property
    def is_waiting(self) -> bool:
        """Whether it holds its position until more rows come."""
        return not self._closed and not self._flows and not self._has_lead

    @property
    def runs_dry(self) -> bool:
        return self._flows and not self._waiting and not self._closed

    @property
    def is_full(self) -> bool:
        """Whether so many rows are buffered that reading should pause."""
        return len(self._waiting) >= FULL_ROWS

    @property
    def is_behind(self) -> bool:
        """Whether more rows wait than the lead: the machine is behind the source."""
        return len(self._waiting) > self._lead

    @property
    def has_ended(self) -> bool:
        return self._closed and not self._waiting

    def play_row(self, rate: float) -> tuple[list[float], bool]:
        """Return the next row (mm per axis) or the held position; ``rate`` is ignored, it belongs to the other NC.

        The demand does not mark rapids; the second value is always False.
        """
        self._flows = bool(self._waiting) and (self._flows or self._has_lead)
        if self._flows:
            row = self._waiting.popleft()
            self._moving = bool(self._here) and row != self._here
            self._rested = 0 if self._moving else self._rested + 1
            self._here = row
            self.rows += 1
            while self._rested > self._long_rest and self.is_behind and self._waiting[0] == row:
                self._waiting.popleft()
        elif self._moving:
            self.starved += 1
        return self._here, False
