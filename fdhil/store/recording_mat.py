"""Reads and writes recordings as MATLAB files: one vector each, structs ``headers`` and ``units``.

Written in version 5, which MATLAB, Octave and scipy read; version 7.3 is HDF5 and read as such. A damaged file may
crash scipy, so that it is read in a separate process.
"""

import io
import math
from typing import Any

from fdhil.store.matlab_variables import MOST_DEPTH, convert_variables, extract_headers
from fdhil.store.reading_process import read_in_process
from fdhil.store.recording_table import UNITS, UNREADABLE, RecordingTable, check_size, make_unreadable_error

KIND = "MATLAB file"
MOST_VARIABLES = 1000
_V73 = b"MATLAB 7.3"
_NUMBERS = {"double", "single", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "logical"}
_READ = _NUMBERS | {"struct", "cell"}
_OBJECTS = {"object", "opaque", "function", "sparse"}


def encode(table: RecordingTable) -> bytes:
    units = {name: UNITS[name] for name in table.columns if name in UNITS}
    content = io.BytesIO()
    content_of = {"headers": dict(table.headers), "units": units, **table.columns}
    library().savemat(content, content_of, long_field_names=True, oned_as="column", do_compression=True)
    return content.getvalue()


def decode(content: bytes, source: str) -> RecordingTable:
    """Return the table of a file's bytes. Raises RecordingError if it is not a MATLAB file."""
    return read_in_process(__name__, KIND, content, source)


def read(content: bytes, source: str) -> RecordingTable:
    """Return the table, read in this process, which a damaged file may crash."""
    if content.startswith(_V73):
        from fdhil.store import recording_hdf5

        return recording_hdf5.read_matlab(content, source)
    scipy_io = library()
    try:
        listed = scipy_io.whosmat(io.BytesIO(content))
        wanted = [(name, shape) for name, shape, kind in listed[:MOST_VARIABLES] if kind in _READ]
        check_size(max((math.prod(shape) for _, shape in wanted), default=0), 1, source)
        names = [name for name, _ in wanted]
        read: dict[str, Any] = scipy_io.loadmat(io.BytesIO(content), variable_names=names, simplify_cells=False)
        variables = {name: _simplify_value(read[name]) for name in names if name in read}
        variables |= {str(name): None for name, _, kind in listed if kind in _OBJECTS}
    except (scipy_io.matlab.MatReadError, *UNREADABLE) as error:
        raise make_unreadable_error(source, KIND, error) from None
    return convert_variables(variables, extract_headers(variables.pop("headers", None)), source)


def _simplify_value(value: Any, depth: int = 0) -> Any:
    """Convert scipy's value: structures to mappings, structure arrays and cells to lists, texts to str."""
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    if kind == "V" and value.dtype.names and depth < MOST_DEPTH:
        parts = [{name: _simplify_value(part[name], depth + 1) for name in value.dtype.names} for part in value.ravel()]
        return parts[0] if len(parts) == 1 else parts
    if kind == "O" and depth < MOST_DEPTH:
        return [_simplify_value(part, depth + 1) for part in value.ravel()]
    if kind in "US":
        return str(value.ravel()[0]) if value.size == 1 else ""
    return value


def library() -> Any:
    """Return scipy's reader and writer; its stubs do not support files in memory."""
    from scipy import io as scipy_io  # late: it is slow to import

    return scipy_io
