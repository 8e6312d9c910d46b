"""Finds column names in the head of a text: the nearest line above the numbers with a matching number of cells."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fdhil.store.trace_cells import strip_cell
from fdhil.store.trace_rows import RowLayout, TraceRow

UNFILLED = ("comment", "comments", "kommentar", "remark")  # headings of a last column that may be left empty


@dataclass(frozen=True, slots=True)
class TraceHead:
    """The texts above the columns (numbered from 0).

    ``columns`` is the column of each name, ``twice`` those of a name above several columns, with its line, ``uneven``
    why a text belongs to no column, and ``texts`` the texts above each column.
    """

    columns: Mapping[str, int]
    twice: Mapping[str, tuple[int, Sequence[int]]]
    uneven: Mapping[str, str]
    texts: Mapping[int, Sequence[str]]


def read_head(lines: Sequence[Sequence[TraceRow]], layout: RowLayout) -> TraceHead:
    """Return the names of a head; ``lines`` has each line, from the top, in the possible ways to split it."""
    columns: dict[str, int] = {}
    twice: dict[str, tuple[int, Sequence[int]]] = {}
    uneven: dict[str, str] = {}
    texts: dict[int, list[str]] = {}
    for ways in reversed(lines):
        fitting = [row for row in ways if _is_aligned(row, layout)]
        for name, places in [each for row in fitting for each in _find_columns(row).items()]:
            for j in places:
                texts.setdefault(j, []).append(name)
            if name not in columns and len(places) > 1:
                twice.setdefault(name, (ways[0].line, places))
            elif name not in twice and places[0] < layout.width:
                columns.setdefault(name, places[0])
        for name in () if fitting else _find_columns(ways[0]):
            count = f"{len(ways[0].cells)} cells of line {ways[0].line}, the rows have {layout.width}"
            uneven.setdefault(name, f"is one of the {count}: name the column #1, #2 ... from the left instead")
    return TraceHead(columns, twice, uneven, texts)


def _is_aligned(row: TraceRow, layout: RowLayout) -> bool:
    filled = max((j + 1 for j, cell in enumerate(row.cells) if cell.strip()), default=0)
    if len(row.cells) == layout.width or filled == layout.filled:
        return True
    return filled == layout.filled + 1 and row.cells[filled - 1].strip().lower() in UNFILLED


def _find_columns(row: TraceRow) -> dict[str, list[int]]:
    places: dict[str, list[int]] = {}
    for j, cell in enumerate(row.cells):
        text = strip_cell(cell)
        for name in {text, " ".join(text.split())} - {""}:
            places.setdefault(name, []).append(j)
    return places
