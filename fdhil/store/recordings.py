"""Reads a recording from any file: one of the recording formats, or another program's file with a column map."""

from pathlib import Path

from fdhil import tables
from fdhil.csv_text import read_content
from fdhil.errors import RecordingError
from fdhil.records import Recording
from fdhil.store import suffixes
from fdhil.store.column_map import ColumnMap, mapped
from fdhil.store.recording_table import RecordingTable, recording_of
from fdhil.store.trace_text import parse_trace


def read_recording(path: Path, columns: ColumnMap | None = None) -> Recording:
    """Read a recording; RecordingError names what is wrong with the file and what to do about it.

    With ``columns`` the file may be of another program.
    """
    return recording_of(read_table(path, columns), str(path))


def read_table(path: Path, columns: ColumnMap | None = None) -> RecordingTable:
    """Read headers and columns of a recording without looking at what they mean. Errors as :func:`read_recording`."""
    content = read_content(path)
    name = suffixes.RECORDINGS.get(path.suffix.lower(), "csv")
    if columns is None:
        return _decoded(name, content, str(path))
    raw = parse_trace(content, columns.text, str(path)) if name == "csv" else _decoded(name, content, str(path))
    return mapped(raw, columns, str(path))


def _decoded(name: str, content: bytes, source: str) -> RecordingTable:
    if not content:
        raise RecordingError(f"{source} is empty: record it again")
    table: RecordingTable = tables.load(tables.RECORDING_FORMATS, name).decode(content, source)
    return table
