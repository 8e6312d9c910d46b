"""Finds the rows of numbers in a text: where they begin and end, and what interrupts them."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from fdhil.csv_text import quote_cell
from fdhil.errors import RecordingError
from fdhil.store.trace_cells import is_clock, is_number, is_void, strip_cell

HEAD_LINES = 400  # searched for the first row of numbers
SAME_WIDTH = 3  # successive rows of numbers that mark their beginning
SAMPLE_ROWS = 600  # examined for the columns of numbers
MOST_FOOTER_ROWS = 12  # with numbers, such as a mean and a maximum
COMMENTS = ("#", "%", "//")
COMMENT_MARKS = "#%/ "


@dataclass(frozen=True, slots=True)
class TraceRow:
    """The cells of one record, and the number of the line on which it ends (1 is the first)."""

    line: int
    cells: list[str]


@dataclass(frozen=True, slots=True)
class RowLayout:
    """The number of cells of a row, and its columns (from 0) that are numbers, or empty, in most rows."""

    width: int
    numbers: tuple[int, ...]
    empty: tuple[int, ...] = ()

    @property
    def filled(self) -> int:
        return self.numbers[-1] + 1

    def is_row(self, row: TraceRow) -> bool:
        """Return whether a record is a row of numbers by its length and its first number."""
        return len(row.cells) == self.width and self._has_first_number(row)

    def is_short(self, row: TraceRow) -> bool:
        """Return whether a record is a row of numbers whose last cells are missing."""
        if len(row.cells) >= self.width or not self._has_first_number(row) or is_clock(row.cells[self.numbers[0]]):
            return False
        return len(self._find_numbers(row)) > 1 and self._is_clean(row)

    def has_numbers(self, row: TraceRow) -> bool:
        """Return whether a record has the length of a row and two numbers or more, after a text."""
        return len(row.cells) == self.width and len(self._find_numbers(row)) > 1

    def is_start_of_rows(self, rows: Sequence[TraceRow]) -> bool:
        """Return whether these records are all rows of two numbers or more, without texts."""
        return all(self.is_row(row) and len(self._find_numbers(row)) > 1 and self._is_clean(row) for row in rows)

    def is_doubtful(self, row: TraceRow) -> bool:
        """Return whether a record is a row of two numbers or more, whatever its other cells are."""
        return self.is_row(row) and len(self._find_numbers(row)) > 1

    def has_label(self, row: TraceRow) -> bool:
        """Return whether a row of numbers has a text where the others are empty."""
        return any(not is_void(row.cells[j]) for j in self.empty)

    def _has_first_number(self, row: TraceRow) -> bool:
        first = row.cells[self.numbers[0]] if len(row.cells) > self.numbers[0] else "text"
        return is_number(first) or (is_void(first) and bool(self._find_numbers(row)))

    def _find_numbers(self, row: TraceRow) -> list[str]:
        return [cell for cell in self._list_number_cells(row) if is_number(cell)]

    def _is_clean(self, row: TraceRow) -> bool:
        return all(is_number(cell) or is_void(cell) for cell in self._list_number_cells(row))

    def _list_number_cells(self, row: TraceRow) -> list[str]:
        return [row.cells[j] for j in self.numbers if j < len(row.cells)]


@dataclass(frozen=True, slots=True)
class TraceBody:
    """The rows of numbers of a text, the records before them, and the first interruption ("" without one)."""

    head: Sequence[TraceRow]
    rows: Sequence[TraceRow]
    layout: RowLayout
    interruption: str


def find_body(rows: Sequence[TraceRow], source: str, is_complete: bool) -> TraceBody | None:
    """Return the rows of numbers; None without any. An incomplete last row is left out.

    Empty lines, comments, repeated names and rows without a value may stand between rows. Raises RecordingError for
    anything else, and for a row with more or fewer cells than the others.
    """
    rows = [row for row in rows if len(row.cells) > 1 or any(cell.strip() for cell in row.cells)]
    layout = _find_layout(rows)
    first = None if layout is None else _find_first_row(rows, layout)
    if layout is None or first is None:
        return None
    if not is_complete and _is_cut_off(rows, layout):
        rows = rows[:-1]
    last_full = _find_last(rows, layout.is_row)
    end = 1 + max(last_full, _find_last(rows, layout.is_short))
    if (left := sum(map(layout.has_numbers, rows[end:]))) > MOST_FOOTER_ROWS:
        raise _make_no_row_error(rows[end], source, f"and {left} rows of numbers follow")
    head = {_normalise_row(row) for row in rows[:first]}
    spare = _find_spare_columns(rows[:first], layout)
    body: list[TraceRow] = []
    for k in range(first, end):
        row, cells = rows[k], _fit_width(rows[k], layout, k < last_full, source)
        is_wide = len(row.cells) > layout.width
        if cells is not None and any(is_number(cells[j]) or (is_wide and not is_void(cells[j])) for j in spare):
            raise _make_uneven_error(row, layout, source)
        if cells is not None:
            body.append(row if cells is row.cells else TraceRow(row.line, cells))
            continue
        words = _normalise_row(row)
        if words and words not in head and not row.cells[0].strip().startswith(COMMENTS):
            raise _make_no_row_error(row, source)
    return TraceBody(rows[:first], body, layout, _find_interruption(body))


def _find_interruption(body: Sequence[TraceRow]) -> str:
    steps = [below.line - above.line for above, below in pairwise(body)]
    k = next((k for k, step in enumerate(steps) if step != min(steps)), None)
    return "" if k is None else f"line {body[k].line + 1} interrupts the rows"


def _find_spare_columns(head: Sequence[TraceRow], layout: RowLayout) -> list[int]:
    """Return the empty columns after the last number without a name: a number there was moved out of its column."""
    after = [j for j in layout.empty if j >= layout.filled]
    return [j for j in after if not any(len(row.cells) > j and strip_cell(row.cells[j]) for row in head)]


def _is_cut_off(rows: Sequence[TraceRow], layout: RowLayout) -> bool:
    """Return whether the last row lacks cells, or its last cell has fewer digits than those of all other rows."""
    if len(rows[-1].cells) < layout.width:
        return True
    last = [row.cells[-1].strip() for row in rows[-SAMPLE_ROWS:] if layout.is_row(row)]
    endings = [len(re.split("[.,]", cell)[-1]) for cell in last]
    return len(set(endings[:-1])) == 1 and endings[-1] < endings[0]


def _find_last(rows: Sequence[TraceRow], is_one: Callable[[TraceRow], bool]) -> int:
    return next((k for k in range(len(rows) - 1, -1, -1) if is_one(rows[k])), -1)


def _fit_width(row: TraceRow, layout: RowLayout, is_before_full: bool, source: str) -> list[str] | None:
    """Return as many cells as the other rows have; None for a record that is not a row.

    Raises RecordingError if cells are missing before full rows, or if there are more than in the other rows.
    """
    missing = layout.width - len(row.cells)
    if layout.is_row(row) or (not missing and not any(cell.strip() for cell in row.cells)):
        return row.cells
    is_short, cut = layout.is_short(row), row.cells[: layout.width]
    is_wide = missing < 0 and layout.is_row(TraceRow(row.line, cut))
    if (is_short and is_before_full) or (is_wide and any(cell.strip() for cell in row.cells[layout.width :])):
        raise _make_uneven_error(row, layout, source)
    if is_short:
        return row.cells + [""] * missing
    return cut if is_wide else None


def _normalise_row(row: TraceRow) -> str:
    return " ".join(map(strip_cell, row.cells)).lstrip(COMMENT_MARKS)


def _make_no_row_error(row: TraceRow, source: str, more: str = "") -> RecordingError:
    text = quote_cell(" ".join(row.cells))
    return RecordingError(
        f"{source} line {row.line} is not a row of numbers: {text}{more and f', {more}'}; export it again"
    )


def _make_uneven_error(row: TraceRow, layout: RowLayout, source: str) -> RecordingError:
    filled = len(row.cells) if len(row.cells) != layout.width else sum(not is_void(cell) for cell in row.cells)
    most = layout.width if len(row.cells) != layout.width else layout.filled
    return RecordingError(
        f"{source} has {filled} cells in line {row.line}, the other rows have {most}: its numbers may be in the "
        "wrong columns; quote cells that contain commas, or export it again"
    )


def _find_layout(rows: Sequence[TraceRow]) -> RowLayout | None:
    rows = rows[:: max(1, len(rows) // SAMPLE_ROWS)]
    sample = [[is_number(cell) for cell in row.cells] for row in rows]
    numeric = [flags for flags in sample if sum(flags) > 1]
    if not numeric:
        return None
    width, _ = Counter(map(len, numeric)).most_common(1)[0]
    columns = [*zip(*(flags for flags in numeric if len(flags) == width), strict=True)]
    numbers = tuple(j for j, flags in enumerate(columns) if 2 * sum(flags) >= len(flags))
    full = [row for row in rows if len(row.cells) == width]
    void = [sum(is_void(row.cells[j]) for row in full) for j in range(width)]
    empty = tuple(j for j, count in enumerate(void) if j not in numbers and 2 * count > len(full))
    return RowLayout(width, numbers, empty) if numbers else None


def _find_first_row(rows: Sequence[TraceRow], layout: RowLayout) -> int | None:
    """Return where the rows of numbers begin: several in succession.

    Labels may stand next to the first of them; a head with numbers next to labels continues with other lines.
    """
    for k in range(min(len(rows) - SAME_WIDTH + 1, HEAD_LINES)):
        if layout.is_start_of_rows(rows[k : k + SAME_WIDTH]):
            after = next((row for row in rows[k:] if not layout.is_row(row) or not layout.has_label(row)), None)
            if after is not None and layout.is_row(after):
                return _include_doubtful_rows(rows, k, layout)
    return None


def _include_doubtful_rows(rows: Sequence[TraceRow], first: int, layout: RowLayout) -> int:
    while first and layout.is_doubtful(rows[first - 1]):
        first -= 1
    return first
