"""Recordings as MATLAB files: one vector each, the headers in a struct ``headers``, the units in a struct ``units``.

Written in version 5, which MATLAB, Octave and scipy read; version 7.3 is HDF5 and is read as such. A damaged file ends
scipy's process, so it is read in one of its own.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from fdhil.store.reading_process import read_apart
from fdhil.store.recording_table import UNITS, UNREADABLE, RecordingTable, check_size, unreadable

KIND = "MATLAB file"
MOST_VARIABLES = 1000
_V73 = b"MATLAB 7.3"
_NUMBERS = {"double", "single", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"}


def encode(table: RecordingTable) -> bytes:
    """Return a table as the bytes of a MATLAB file."""
    units = {name: UNITS[name] for name in table.columns if name in UNITS}
    content = io.BytesIO()
    content_of = {"headers": dict(table.headers), "units": units, **table.columns}
    library().savemat(content, content_of, long_field_names=True, oned_as="column", do_compression=True)
    return content.getvalue()


def decode(content: bytes, source: str) -> RecordingTable:
    """Return the table of a file's bytes; RecordingError when it is no MATLAB file."""
    return read_apart(__name__, KIND, content, source)


def read(content: bytes, source: str) -> RecordingTable:
    """Return the table in this process, which a damaged file may end."""
    if content.startswith(_V73):
        from fdhil.store import recording_hdf5

        return recording_hdf5.read(content, source)
    scipy_io = library()
    try:
        told = scipy_io.whosmat(io.BytesIO(content))
        vectors = [name for name, shape, kind in told[:MOST_VARIABLES] if kind in _NUMBERS and _is_vector(shape)]
        check_size(max((max(shape) for name, shape, _ in told if name in vectors), default=0), len(vectors), source)
        wanted = [*vectors, *(name for name, shape, kind in told if (name, kind) == ("headers", "struct"))]
        read: dict[str, Any] = scipy_io.loadmat(io.BytesIO(content), variable_names=wanted, squeeze_me=True)
        columns = {name: np.atleast_1d(np.asarray(read[name], dtype=np.float64)) for name in vectors}
        headers = _texts(read.get("headers"))
    except (scipy_io.matlab.MatReadError, *UNREADABLE) as error:
        raise unreadable(source, KIND, error) from None
    return RecordingTable(headers, columns)


def _is_vector(shape: tuple[int, ...]) -> bool:
    return len(shape) == 2 and min(shape) == 1


def _texts(headers: Any) -> dict[str, str]:
    """Return the fields of a struct of texts; of any other value nothing."""
    if headers is None or getattr(headers, "dtype", None) is None or headers.dtype.names is None:
        return {}
    return {name: str(headers[name]) for name in headers.dtype.names}


def library() -> Any:
    """Return scipy's reader and writer; its stubs know no file in memory."""
    from scipy import io as scipy_io  # late: it is slow to import

    return scipy_io
