"""Text files of oscilloscopes, drives and NCs: a head of any kind, then rows of numbers.

Separator, decimal comma, encoding and the first row of numbers are found where the column map does not say them. A
column is found by any text that stands above it in the head: makers write names, addresses and units there.
"""

from __future__ import annotations

import codecs
import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from fdhil.config.section import Section
from fdhil.csv_text import check_lengths, text_of
from fdhil.errors import RecordingError
from fdhil.records import Float
from fdhil.store.recording_table import RecordingTable, check_size

SEPARATORS = "\t;,|"
HEAD_LINES = 400  # of a file's beginning, in which the first row of numbers is sought
SAME_WIDTH = 3  # rows of numbers in succession that show where they begin


class TraceText(Section):
    """[text] of a column map: what is not given is found."""

    separator: str | None = Field(None, min_length=1, max_length=1, description="between cells; left out: it shows")
    decimal: str | None = Field(None, pattern="^[.,]$", description="of numbers; left out: it shows")
    encoding: str | None = Field(None, max_length=20, description="left out: UTF-16 or UTF-8 where it is, else cp1252")


@dataclass(frozen=True, slots=True)
class _Shape:
    separator: str
    decimal: str


def parse_trace(content: bytes, told: TraceText, source: str) -> RecordingTable:
    """Return all columns of a text, under every name that stands above them and as ``#1``, ``#2`` ...

    A row of fewer cells has ``nan`` in those it lacks. RecordingError where there are no rows of numbers.
    """
    lines = _text(content, told, source).splitlines()
    check_lengths(lines, 1, source)
    shape = _shape(lines, told)
    first = _first_row(lines, shape)
    if first is None:
        raise RecordingError(
            f"{source} has no rows of numbers (looked for with separator {shape.separator!r} and decimal "
            f"{shape.decimal!r}): give separator and decimal under [text] of the column map, or export it as text"
        )
    values = _values(lines[first:], shape, source)
    columns: dict[str, Float] = {f"#{j + 1}": values[:, j] for j in range(values.shape[1])}
    for line in lines[:first]:
        for j, cell in enumerate(line.split(shape.separator)[: values.shape[1]]):
            if name := cell.strip().strip('"').strip():
                columns.setdefault(name, values[:, j])
    return RecordingTable({}, columns)


def _text(content: bytes, told: TraceText, source: str) -> str:
    if told.encoding is not None:
        try:
            codecs.lookup(told.encoding)
        except LookupError:
            raise RecordingError(f"{source}: {told.encoding} is no encoding: correct it in the column map") from None
        return text_of(content, source, told.encoding)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return text_of(content, source, "utf-16")
    try:
        content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return text_of(content, source, "cp1252")
    return text_of(content, source)


def _shape(lines: list[str], told: TraceText) -> _Shape:
    """Return how the last full row is written; a comma between digits is decimal where another separator is there."""
    row = next((line for line in reversed(lines) if sum(c.isdigit() for c in line) > 1), "")
    separator = told.separator or max(SEPARATORS, key=lambda s: (row.count(s) > 0, -SEPARATORS.index(s)))
    comma = separator != "," and "," in row
    return _Shape(separator, told.decimal or ("," if comma else "."))


def _first_row(lines: list[str], shape: _Shape) -> int | None:
    """Return where the rows of numbers begin: several in succession, of two cells or more."""
    for k in range(min(len(lines), HEAD_LINES)):
        rows = [_cells(line, shape) for line in lines[k : k + SAME_WIDTH]]
        if len(rows) == SAME_WIDTH and all(sum(math.isfinite(v) for v in row or ()) > 1 for row in rows):
            return k
    return None


def _cells(line: str, shape: _Shape) -> list[float] | None:
    """Return the numbers of a row, ``nan`` for an empty cell; None where one is no number."""
    numbers = []
    for cell in line.split(shape.separator):
        text = cell.strip().strip('"').strip()
        if shape.decimal == ",":
            text = text.replace(",", ".")
        try:
            numbers.append(float(text) if text else math.nan)
        except ValueError:
            return None
    return numbers


def _values(lines: list[str], shape: _Shape, source: str) -> Float:
    """Return the rows (n, k); the first line that is none must be the end of the file, as ``EOF``."""
    width = len(lines[0].split(shape.separator))
    check_size(len(lines), width, source)
    rows = []
    for k, line in enumerate(lines):
        row = _cells(line, shape) if line.strip() else [math.nan] * width
        if row is None or len(row) > width:
            if any(text.strip() for text in lines[k + 1 :]):
                raise RecordingError(f"{source} has a line that is no row of numbers: {line[:60]!r}; export it again")
            break
        rows.append(row + [math.nan] * (width - len(row)))
    return np.array(rows, dtype=np.float64)
