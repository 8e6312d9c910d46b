"""Recordings as Parquet tables: one column each, its unit in the field's metadata, the headers in the schema's."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fdhil.records import Window
from fdhil.store.export import table_of
from fdhil.store.recording_table import FORMAT, UNITS, UNREADABLE, RecordingTable, check_size, unreadable
from fdhil.store.windows import FORMAT as WINDOW_FORMAT
from fdhil.store.windows import decode_window, read_window

_META = b"fdhil"


def encode(table: RecordingTable) -> bytes:
    """Return a table as the bytes of a Parquet file."""
    fields = [pa.field(name, pa.float64(), metadata={"unit": UNITS.get(name, "")}) for name in table.columns]
    schema = pa.schema(fields, metadata={_META: json.dumps(dict(table.headers)).encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table([*table.columns.values()], schema=schema), sink, compression="zstd")
    written: bytes = sink.getvalue().to_pybytes()
    return written


def decode(content: bytes, source: str) -> RecordingTable:
    """Return the table of a file's bytes, also of a stored window's; RecordingError when it is no Parquet file."""
    try:
        file = pq.ParquetFile(pa.BufferReader(content))
        headers = json.loads((file.schema_arrow.metadata or {}).get(_META, b"{}"))
        if headers.get("format") == WINDOW_FORMAT:
            return table_of(decode_window(content, source))
        told = file.metadata
        check_size(told.num_rows, told.num_columns, source)
        numeric = [f.name for f in file.schema_arrow if pa.types.is_floating(f.type) or pa.types.is_integer(f.type)]
        read = file.read(columns=numeric)
        columns = {name: np.asarray(read.column(name).to_numpy(), dtype=np.float64) for name in numeric}
    except (pa.ArrowException, *UNREADABLE) as error:
        raise unreadable(source, "Parquet file", error) from None
    return RecordingTable({str(key): str(value) for key, value in headers.items()}, columns)


def is_recording(path: Path) -> bool:
    """Whether a Parquet file is a recording and not a stored window; False where it cannot be told."""
    return _format_of(path) == FORMAT


def stored_window(path: Path) -> Window | None:
    """Return the window of a file that is a stored one, None of any other. RecordingError where it is damaged."""
    is_one = path.suffix.lower() == ".parquet" and _format_of(path) == WINDOW_FORMAT
    return read_window(path) if is_one else None


def _format_of(path: Path) -> object:
    try:
        metadata = pq.read_schema(path).metadata or {}
        told = json.loads(metadata.get(_META, b"{}"))
    except (pa.ArrowException, *UNREADABLE):
        return None
    return told.get("format") if isinstance(told, dict) else None
