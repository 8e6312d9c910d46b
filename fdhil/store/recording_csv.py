"""Reads and writes recordings as CSV: header lines ``# key: value``, a line of names, then rows of numbers."""

import math

import numpy as np

from fdhil.csv_text import check_lengths, decode_text, quote_cell
from fdhil.errors import RecordingError
from fdhil.records import Float, Recording
from fdhil.store.recording_table import MIN_ROWS, TABLE, RecordingTable, check_headers, make_recording


def parse_recording(text: str, source: str = "recording") -> Recording:
    """Return the recording of a text; ``source`` names it in errors. RecordingError as :func:`recording_of`."""
    return make_recording(parse_table(text, source), source)


def decode(content: bytes, source: str) -> RecordingTable:
    """Return the table of a file's bytes. Raises RecordingError with the line at fault."""
    return parse_table(decode_text(content, source), source)


def parse_table(text: str, source: str) -> RecordingTable:
    """Return the table of a text. Raises RecordingError with the line at fault."""
    if not text.strip():
        raise RecordingError(f"{source} is empty: record it again")
    lines = text.splitlines()
    k = next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))
    if k == len(lines):
        raise RecordingError(f"{source} is truncated: it has headers but no columns; record it again")
    check_lengths(lines[k:], k + 1, source)
    names = [name.strip() for name in lines[k].split(",")]
    headers = check_headers(_parse_headers(lines[:k], len(names), source), dict.fromkeys(names), source)
    for name in names:
        if name and names.count(name) > 1:
            places = " and ".join(f"#{j + 1}" for j, other in enumerate(names) if other == name)
            raise RecordingError(f"{source} has {quote_cell(name)} above {places} (line {k + 1}): rename or remove one")
    if not text.endswith("\n"):
        raise RecordingError(
            f"{source} is truncated: line {len(lines)} is incomplete, its last number may be cut off; copy it again"
        )
    table = _parse_numbers(lines, k + 1, names, source)
    return RecordingTable(headers, {name: table[:, k] for k, name in reversed([*enumerate(names)])})


def _parse_headers(lines: list[str], width: int, source: str) -> dict[str, str]:
    """Return the headers, without the empty cells that a spreadsheet appends."""
    empty = "," * (width - 1)
    if all(line.endswith(empty) for line in lines):
        lines = [line.removesuffix(empty) for line in lines]
    headers: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        key, colon, value = line[1:].partition(":")
        key, value = key.strip(), value.strip()
        if colon and headers.setdefault(key, value) != value:
            both = f"{quote_cell(headers[key])} and again, in line {number}, {quote_cell(value)}"
            raise RecordingError(f"{source} has header {quote_cell(key)} = {both}: remove the wrong one")
    return headers


def encode(table: RecordingTable) -> bytes:
    """Return a table as the bytes of a CSV file, every number to its last bit."""
    lines = [f"# {key}: {value}" for key, value in table.headers.items()]
    lines.append(",".join(table.columns))
    columns = [map(repr, values.tolist()) for values in table.columns.values()]
    lines += map(",".join, zip(*columns, strict=True))
    return ("\n".join(lines) + "\n").encode()


def _parse_numbers(lines: list[str], first_row: int, names: list[str], source: str) -> Float:
    """Return the rows (n, k): all finite except sensors at the table."""
    rows = [line for line in lines[first_row:] if line.strip()]
    if len(rows) < MIN_ROWS:
        raise RecordingError(f"{source} is truncated: {len(rows)} rows are too few; record it again")
    try:
        table = np.loadtxt(rows, delimiter=",", comments=None, ndmin=2)
    except ValueError:
        raise _find_bad_row(lines, first_row, names, source) from None
    if table.shape[1] != len(names) or not (np.isfinite(table) | (np.isnan(table) & np.isin(names, TABLE))).all():
        raise _find_bad_row(lines, first_row, names, source)
    return table


def _find_bad_row(lines: list[str], first_row: int, names: list[str], source: str) -> RecordingError:
    width = len(names)
    last = max(k for k, line in enumerate(lines) if line.strip())
    for k, line in enumerate(lines[first_row:], start=first_row):
        if not line.strip():
            continue
        cells = line.split(",")
        if len(cells) != width:
            what = "is truncated" if k == last else "is damaged"
            return RecordingError(f"{source} {what}: line {k + 1} has {len(cells)} of {width} values; copy it again")
        for name, cell in zip(names, cells, strict=True):
            try:
                value = float(cell)
            except ValueError:
                return RecordingError(
                    f"{source} line {k + 1} has {quote_cell(cell.strip())} instead of a number: correct it"
                )
            if not (math.isfinite(value) or (math.isnan(value) and name in TABLE)):
                what = f"{source} line {k + 1} has the non-finite value {quote_cell(cell.strip())}"
                return RecordingError(f"{what}: leave out the row of a lost sample")
    return RecordingError(f"{source} does not contain numbers: export it again")
