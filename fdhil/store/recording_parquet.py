"""Reads and writes recordings as Parquet tables: units in the fields' metadata, headers in the schema's."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from fdhil.records import Float, Window
from fdhil.store.parquet_library import pa, pc, pq
from fdhil.store.recording_table import (
    RECORDING_FORMAT,
    UNIT_KEYS,
    UNITS,
    UNREADABLE,
    RecordingTable,
    check_size,
    make_unreadable_error,
)
from fdhil.store.trace_cells import unwrap_midnight
from fdhil.store.window_export import convert_window
from fdhil.store.window_file import FORMAT as WINDOW_FORMAT
from fdhil.store.window_file import decode_window, read_window

_META = b"fdhil"


def encode(table: RecordingTable) -> bytes:
    fields = [pa.field(name, pa.float64(), metadata={"unit": UNITS.get(name, "")}) for name in table.columns]
    schema = pa.schema(fields, metadata={_META: json.dumps(dict(table.headers)).encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table([*table.columns.values()], schema=schema), sink, compression="zstd")
    written: bytes = sink.getvalue().to_pybytes()
    return written


def decode(content: bytes, source: str) -> RecordingTable:
    """Return the table of a file's bytes, also of a stored window's. Raises RecordingError if it is not Parquet."""
    try:
        file = pq.ParquetFile(pa.BufferReader(content))
        headers = json.loads((file.schema_arrow.metadata or {}).get(_META, b"{}"))
        if headers.get("format") == WINDOW_FORMAT:
            return convert_window(decode_window(content, source))
        metadata = file.metadata
        check_size(metadata.num_rows, metadata.num_columns, source)
        kinds = [*_list_types(file.schema_arrow)]
        units = {field.name: _read_units(field) for field in file.schema_arrow}
        read = file.read(columns=[name for name, kind in kinds if _is_number(kind) or pa.types.is_temporal(kind)])
        columns, clocks, doubts = _read_columns(read)
        others = {name: kind for name, kind in kinds if name not in columns and name not in doubts}
        doubts |= {name: f"is of type {kind}: write it as a number or a time" for name, kind in others.items()}
    except (pa.ArrowException, *UNREADABLE) as error:
        raise make_unreadable_error(source, "Parquet file", error) from None
    return RecordingTable({str(k): str(v) for k, v in headers.items()}, columns, clocks, doubts, texts=units)


def _read_units(field: pa.Field) -> list[str]:
    metadata = (field.metadata or {}).items()
    return [
        value.decode(errors="replace") for key, value in metadata if key.decode(errors="replace").lower() in UNIT_KEYS
    ]


def _list_types(fields: Iterable[pa.Field], above: str = "") -> Iterator[tuple[str, pa.DataType]]:
    """Yield name and type of each column, of a structure's field as ``structure.field``."""
    for field in fields:
        if pa.types.is_struct(field.type):
            yield from _list_types(field.type, f"{above}{field.name}.")
        else:
            yield f"{above}{field.name}", field.type


def _read_columns(read: pa.Table) -> tuple[dict[str, Float], frozenset[str], dict[str, str]]:
    """Return the columns of numbers and times, which of them are times in s, and unusable names with the reason."""
    while any(pa.types.is_struct(field.type) for field in read.schema):
        read = read.flatten()
    columns: dict[str, Float] = {}
    clocks: set[str] = set()
    doubts: dict[str, str] = {}
    for k, field in enumerate(read.schema):
        places = read.schema.get_all_field_indices(field.name)
        if len(places) > 1:
            doubts[field.name] = f"names {len(places)} columns: write them with different names"
        elif pa.types.is_temporal(field.type):
            columns[field.name] = _convert_seconds(read.column(k))
            clocks.add(field.name)
        else:
            columns[field.name] = np.asarray(read.column(k).cast(pa.float64(), safe=False).to_numpy())
    return columns, frozenset(clocks), doubts


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_decimal(kind))


def _convert_seconds(times: pa.ChunkedArray) -> Float:
    """Return times, durations or times of day in s from the first on; a lost one is ``nan``."""
    kind = times.type
    if pa.types.is_date(kind):
        return np.asarray(times.cast(pa.timestamp("s")).cast(pa.int64()).cast(pa.float64()).to_numpy())
    counts = times.cast(pa.int32() if kind.bit_width == 32 else pa.int64())
    first = next((value.as_py() for value in counts if value.is_valid), 0)
    per_s = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[kind.unit]
    seconds = np.asarray(pc.subtract(counts, pa.scalar(first, counts.type)).cast(pa.float64()).to_numpy()) / per_s
    return unwrap_midnight(seconds) if pa.types.is_time(kind) else seconds


def is_recording(path: Path) -> bool:
    """Return whether a Parquet file is a recording and not a stored window; False if unknown."""
    return _read_format(path) == RECORDING_FORMAT


def read_if_window(path: Path) -> Window | None:
    """Return the window of a Parquet file if it is a stored one, else None. RecordingError if it is damaged."""
    return read_window(path) if _read_format(path) == WINDOW_FORMAT else None


def _read_format(path: Path) -> object:
    try:
        metadata = pq.read_schema(path).metadata or {}
        headers = json.loads(metadata.get(_META, b"{}"))
    except (pa.ArrowException, *UNREADABLE):
        return None
    return headers.get("format") if isinstance(headers, dict) else None
