"""Reads a recording from any file: a recording format, or another program's file with a column map."""

from pathlib import Path

from fdhil import tables
from fdhil.csv_text import read_content
from fdhil.errors import RecordingError
from fdhil.records import Recording, Window
from fdhil.store import file_suffixes
from fdhil.store.column_map import ColumnMap, apply_column_map
from fdhil.store.recording_table import RecordingTable, make_recording
from fdhil.store.trace_text import TraceText, parse_trace


def read_recording(path: Path, columns: ColumnMap | None = None) -> Recording:
    """Read a recording. Raises RecordingError with the file's fault and its remedy.

    With ``columns`` the file may be another program's.
    """
    return make_recording(read_table(path, columns), str(path))


def read_stored_window(path: Path) -> Window | None:
    """Return the window of a stored window file, None for any other file. RecordingError if it is damaged."""
    if path.suffix.lower() != ".parquet":
        return None
    from fdhil.store.recording_parquet import read_if_window  # late: an extra

    return read_if_window(path)


def read_table(path: Path, columns: ColumnMap | None = None) -> RecordingTable:
    """Read headers and columns of a recording without interpreting them. Errors as :func:`read_recording`."""
    if columns is not None:
        return apply_column_map(read_raw(path, columns.text), columns, str(path))
    return _decode_table(_find_format(path), read_content(path), str(path))


def read_raw(path: Path, text: TraceText | None = None) -> RecordingTable:
    """Read all columns of another program's file, ``text`` as a column map describes it. Errors as above."""
    content, name = read_content(path), _find_format(path)
    return (
        parse_trace(content, text or TraceText(), str(path))
        if name == "csv"
        else _decode_table(name, content, str(path))
    )


def _find_format(path: Path) -> str:
    return file_suffixes.RECORDING_SUFFIXES.get(path.suffix.lower(), "csv")


def _decode_table(name: str, content: bytes, source: str) -> RecordingTable:
    if not content:
        raise RecordingError(f"{source} is empty: record it again")
    table: RecordingTable = tables.load_entry(tables.RECORDING_FORMATS, name).decode(content, source)
    return table
