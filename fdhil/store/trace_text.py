"""Parses text files of oscilloscopes, drives and NCs: a head of any kind, then rows of numbers, by RFC 4180.

Separator, decimal mark, encoding and the first row of numbers are detected unless the column map gives them. A column
is named by the nearest text above its numbers, or ``#1``, ``#2`` ... from the left. An ambiguous text is refused with
both readings: a name above two columns, a mark that is decimal or separates thousands.
"""

import codecs
import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from pydantic import Field

from fdhil.config import Section
from fdhil.csv_text import check_lengths, decode_text, quote_cell
from fdhil.errors import RecordingError
from fdhil.records import Float
from fdhil.store.recording_table import RecordingTable, check_size
from fdhil.store.trace_cells import DECIMALS, is_number, is_void, is_written_by, parse_column, strip_cell
from fdhil.store.trace_head import TraceHead, read_head
from fdhil.store.trace_rows import SAMPLE_ROWS, TraceBody, TraceRow, find_body

SEPARATORS = "\t;,| "  # a blank means a run of blanks
MOST_LINES_IN_ROW = 8
ENCODINGS = ("utf-8-sig", "cp1252", "cp932")  # tried in turn; Western and Japanese programs
BINARY = {  # first bytes of a file -> its format and the remedy
    b"MDF     4": "an MDF 4 file: name it .mf4",
    b"MDF     ": "an MDF file of version 3 or older: save it as MDF 4, .mf4",
    b"MATLAB ": "a MATLAB file: name it .mat",
    b"\x89HDF": "an HDF5 file: name it .h5 (MATLAB 7.3: .mat)",
    b"PAR1": "a Parquet file: name it .parquet",
    b"PK\x03\x04": "a packed file, such as an Excel workbook: save the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook: save the sheet as CSV",
    b"TDSm": "a LabVIEW TDMS file: export it as CSV or HDF5",
}
_EXCEL = re.compile(r"\"?sep=(.)\"?\s*", re.IGNORECASE)
_WHOLE_LINE = re.compile(r'"((?:[^"]|"")*)"\s*')
_COMMENT = re.compile(r"\s*(?:#+|%+|//+)\s*")
_WIDE_BLANKS = re.compile(r"\t|\s{2,}")


class TraceText(Section):
    """[text] of a column map: what is not given is detected."""

    separator: str | None = Field(None, min_length=1, max_length=1, description="between cells; default: detected")
    decimal: str | None = Field(None, pattern="^[.,]$", description="of numbers; default: detected")
    encoding: str | None = Field(None, max_length=20, description="default: UTF-16, UTF-8, cp1252, else cp932")


def parse_trace(content: bytes, settings: TraceText, source: str) -> RecordingTable:
    """Return all columns of a text, under the nearest names above them and as ``#1``, ``#2`` ...

    A lost value is ``nan``. Raises RecordingError if there are no rows of numbers, or if they are ambiguous.
    """
    lines = _decode_text(content, settings, source).replace("\r\r\n", "\n").splitlines(keepends=True)
    check_lengths(lines, 1, source)
    lines = _remove_outer_quotes(lines)
    separator = settings.separator
    if lines and (stated := _EXCEL.fullmatch(lines[0])):
        separator, lines[0] = separator or stated[1], "\n"
    separator = separator or _find_separator(lines)
    body = find_body(_read_rows(lines, separator, source), source, lines[-1:] == [] or lines[-1][-1] in "\r\n")
    if body is None:
        raise _make_no_rows_error(lines, separator, source)
    check_size(len(body.rows), body.layout.width, source)
    decimal = settings.decimal or _find_decimal_mark(body, separator, source)
    return _make_table(body, read_head(_split_head_lines(lines, body, separator), body.layout), decimal)


def _decode_text(content: bytes, settings: TraceText, source: str) -> str:
    if kind := next((kind for mark, kind in BINARY.items() if content.startswith(mark)), None):
        raise RecordingError(f"{source} is not a text but {kind}")
    if settings.encoding is not None:
        try:
            codecs.lookup(settings.encoding)
        except LookupError:
            raise RecordingError(
                f"{source}: unknown encoding {settings.encoding}: correct it in the column map"
            ) from None
        return decode_text(content, source, settings.encoding)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return decode_text(content, source, "utf-16")
    if b"\0" in content[:2]:  # UTF-16 without its mark
        return decode_text(content, source, "utf-16-be" if content[:1] == b"\0" else "utf-16-le")
    for encoding in ENCODINGS:
        try:
            content.decode(encoding)
        except UnicodeDecodeError:
            continue
        return decode_text(content, source, encoding)
    return decode_text(content, source)


def _remove_outer_quotes(lines: list[str]) -> list[str]:
    """Undo a spreadsheet's quoting of whole rows as single cells."""
    quoted = [_WHOLE_LINE.fullmatch(line) for line in lines]
    if 2 * sum(match is not None for match in quoted) <= len(lines):
        return lines
    if any(match is None and '"' in line for match, line in zip(quoted, lines, strict=True)):
        return lines
    return [match[1].replace('""', '"') + "\n" if match else line for match, line in zip(quoted, lines, strict=True)]


def _find_separator(lines: Sequence[str]) -> str:
    some = [line for line in lines if any(map(str.isdigit, line))]
    sample = some[:: max(1, len(some) // SAMPLE_ROWS)]

    def score_separator(separator: str) -> int:
        total = 0
        for line in sample:
            cells = [cell for _, row in _split_cells([line], separator) for cell in row if not is_void(cell)]
            numbers = sum(map(is_number, cells))
            total += 2 * numbers - len(cells) if numbers > 1 else 0
        return total

    return max(SEPARATORS, key=score_separator)  # the first of equally good ones


def _split_cells(
    lines: Iterable[str], separator: str, quoting: int = csv.QUOTE_MINIMAL
) -> Iterator[tuple[int, list[str]]]:
    is_blank = separator == " "
    if is_blank:
        lines = (re.sub(r"[ \t]+", " ", line.strip()) for line in lines)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=not is_blank, quoting=quoting)  # type: ignore[arg-type]
    for cells in reader:
        yield reader.line_num, cells


def _read_rows(lines: Sequence[str], separator: str, source: str) -> list[TraceRow]:
    try:
        rows = [TraceRow(*record) for record in _split_cells(lines, separator)]
        ends = [0, *(row.line for row in rows)]
        if any(below - above > MOST_LINES_IN_ROW for above, below in pairwise(ends)):  # a quote without an end
            rows = [TraceRow(*record) for record in _split_cells(lines, separator, csv.QUOTE_NONE)]
    except (csv.Error, TypeError, ValueError) as error:  # a separator that is a quote or an end of line
        raise RecordingError(
            f"{source} cannot be split with separator {separator!r} ({error}): correct it in the column map"
        ) from None
    return rows


def _make_no_rows_error(lines: Sequence[str], separator: str, source: str) -> RecordingError:
    last = next((line.strip() for line in reversed(lines) if any(map(str.isdigit, line))), "")
    return RecordingError(
        f"{source} has no rows of numbers (separator {separator!r}; the last line with a digit is "
        f"{quote_cell(last)}): give separator and decimal under [text] of the column map, or export it as text"
    )


def _find_decimal_mark(body: TraceBody, separator: str, source: str) -> str:
    """Return the decimal mark, by the first number that only one of them can have written."""
    marked = ""
    padded = ""
    for row in body.rows:
        for j in body.layout.numbers:
            cell = strip_cell(row.cells[j])
            marks = [mark for mark in DECIMALS if is_written_by(cell, mark)]
            if len(marks) == 1:
                return marks[0]
            if marks and not cell.isdigit():
                marked = marked or next((cell for mark in DECIMALS if mark in cell), "")
            elif marks and cell[0] == "0" and cell.strip("0"):
                padded = padded or cell
    if marked:
        raise RecordingError(
            f"{source} has numbers such as {quote_cell(marked)} only, whose mark may be decimal or separate "
            "thousands: give decimal under [text] of the column map"
        )
    if padded and separator == ",":
        raise RecordingError(
            f"{source} has cells such as {quote_cell(padded)} and no decimal point: commas between cells may be "
            "decimal commas; export it with quoted cells, or with another separator"
        )
    return "."


def _split_head_lines(lines: Sequence[str], body: TraceBody, separator: str) -> list[list[TraceRow]]:
    """Return the lines above the rows in the possible ways to split them."""
    head: list[list[TraceRow]] = []
    for row in body.head:
        cells = row.cells
        if cells and (mark := _COMMENT.match(cells[0])):
            cells = cells[1:] if mark[0] == cells[0] and separator == " " else [cells[0][mark.end() :], *cells[1:]]
        ways = [TraceRow(row.line, cells), row]
        if separator == " ":
            ways.append(TraceRow(row.line, _WIDE_BLANKS.split(_COMMENT.sub("", lines[row.line - 1], count=1).strip())))
        head.append(ways)
    return head


def _make_table(body: TraceBody, head: TraceHead, decimal: str) -> RecordingTable:
    named: dict[int, list[str]] = {j: [f"#{j + 1}"] for j in range(body.layout.width)}
    for name, j in head.columns.items():
        named[j].append(name)
    columns: dict[str, Float] = {}
    doubts: dict[str, str] = {}
    clocks: set[str] = set()
    texts: dict[str, Sequence[str]] = {}
    for j, cells in enumerate(zip(*(row.cells for row in body.rows), strict=True)):
        read = parse_column(cells, decimal)
        columns |= dict.fromkeys(named[j], read.values)
        texts |= dict.fromkeys(named[j], head.texts.get(j, ()))
        if read.bad is not None:
            text = f"has {quote_cell(cells[read.bad])} in line {body.rows[read.bad].line}, instead of a number"
            doubts |= dict.fromkeys(named[j], f"{text}: correct it, or export the file again")
        if read.is_clock:
            clocks.update(named[j])
    unclear = dict(head.uneven)
    for name, (line, places) in head.twice.items():
        columns_of_name = " and ".join(f"#{j + 1}" for j in places)
        unclear[name] = f"names {columns_of_name} (line {line}): use one of these as its name"
        doubts |= _find_uneven_times(name, [f"#{j + 1}" for j in places if j < body.layout.width], columns)
    doubts |= {name: why for name, why in unclear.items() if name not in columns}
    return RecordingTable({}, columns, frozenset(clocks), doubts, body.interruption, texts=texts)


def _find_uneven_times(name: str, places: Sequence[str], columns: Mapping[str, Float]) -> dict[str, str]:
    """Return the doubt about columns of one name that are differing times: each channel has times of its own."""
    every = [columns[place][np.isfinite(columns[place])] for place in places]
    is_time = all(
        values.size > 2 and np.diff(values).min() > 0 and np.ptp(np.diff(values)) < 0.01 * np.diff(values).mean()
        for values in every
    )
    if not is_time or all(np.array_equal(values, every[0]) for values in every):
        return {}
    text = f"is a separate time of each channel ({name}): export all channels with one sample time"
    return dict.fromkeys(places, text)
