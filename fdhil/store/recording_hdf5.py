"""Reads and writes recordings as HDF5: one dataset each with its unit as attribute, the headers as file attributes."""

import io
from typing import Any

import numpy as np

from fdhil.errors import FdhilError
from fdhil.records import Float
from fdhil.store.matlab_variables import MOST_DEPTH, convert_variables, extract_headers
from fdhil.store.reading_process import read_in_process
from fdhil.store.recording_table import UNIT_KEYS, UNITS, UNREADABLE, RecordingTable, check_size, make_unreadable_error

KIND = "HDF5 file"
MATLAB = "MATLAB 7.3 file"
MOST_DATASETS = 1000


def encode(table: RecordingTable) -> bytes:
    """Return a table as the bytes of an HDF5 file. Raises FdhilError without the extra ``hdf5``."""
    content = io.BytesIO()
    with library().File(content, "w") as file:
        file.attrs.update(table.headers)
        for name, values in table.columns.items():
            stored = file.create_dataset(name, data=values, compression="gzip", shuffle=True)
            stored.attrs["unit"] = UNITS.get(name, "")
    return content.getvalue()


def decode(content: bytes, source: str) -> RecordingTable:
    """Return the table of a file's bytes; datasets in groups by their path. RecordingError if it is not HDF5."""
    return read_in_process(__name__, KIND, content, source)


def read(content: bytes, source: str) -> RecordingTable:
    """Return the table, read in this process, which a damaged file may crash."""
    h5py = library()
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            found = _find_vectors(file, h5py)
            check_size(max((max(stored.shape) for stored, _ in found.values()), default=0), len(found), source)
            columns: dict[str, Float] = {
                name: np.asarray(stored[part], dtype=np.float64).ravel() for name, (stored, part) in found.items()
            }
            headers = {str(key): _decode_text(value) for key, value in file.attrs.items()}
            units = {name: _read_units(stored) for name, (stored, _) in found.items()}
    except UNREADABLE as error:
        raise make_unreadable_error(source, KIND, error) from None
    return RecordingTable(headers, columns, texts=units)


def _read_units(stored: Any) -> list[str]:
    return [_decode_text(value) for key, value in stored.attrs.items() if key.lower() in UNIT_KEYS]


def read_matlab(content: bytes, source: str) -> RecordingTable:
    """Return the table of a MATLAB 7.3 file, read in this process, which a damaged file may crash."""
    h5py = library()
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            names = [name for name in file if not name.startswith("#")][:MOST_DATASETS]
            sizes: list[int] = []
            variables = {name: _read_variable(file, file[name], h5py, sizes, source) for name in names}
    except UNREADABLE as error:
        raise make_unreadable_error(source, MATLAB, error) from None
    return convert_variables(variables, extract_headers(variables.pop("headers", None)), source)


def _read_variable(file: Any, item: Any, h5py: Any, sizes: list[int], source: str, depth: int = 0) -> Any:
    """Return a variable as in MATLAB; ``sizes`` of those read so far limit the total to a recording's."""
    kind = _decode_text(item.attrs.get("MATLAB_class", b""))
    if depth > MOST_DEPTH or len(sizes) > MOST_DATASETS:
        return None
    if isinstance(item, h5py.Group):
        fields = {name: _read_variable(file, item[name], h5py, sizes, source, depth + 1) for name in item}
        return _merge_structures(fields)
    if "MATLAB_empty" in item.attrs or item.external or item.is_virtual:
        return "" if kind == "char" else np.zeros(0)
    sizes.append(item.size)
    check_size(sum(sizes), 1, source)
    if item.dtype.kind == "O" and h5py.check_ref_dtype(item.dtype):
        places = item[()].T.ravel()[:MOST_DATASETS]
        parts = [_read_variable(file, file[place], h5py, sizes, source, depth + 1) for place in places]
        return parts if kind == "cell" else tuple(parts)
    if kind == "char":
        return "".join(map(chr, item[()].T.ravel()))
    return item[()].T if item.dtype.kind in "fiub" else None


def _merge_structures(fields: dict[str, Any]) -> Any:
    if not fields or not all(isinstance(part, tuple) for part in fields.values()):
        return fields
    return [dict(zip(fields, parts, strict=True)) for parts in zip(*fields.values(), strict=True)]


def _find_vectors(file: Any, h5py: Any) -> dict[str, tuple[Any, Any]]:
    """Return dataset and selection of each vector of real numbers by path, excluding external links.

    A column of a matrix is ``path[:,0]`` or ``path[0,:]``, a field of a table ``path/field``.
    """
    found: dict[str, Any] = {}

    def visit_item(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual or len(found) >= MOST_DATASETS:
            return
        shape = item.shape or (0,)
        if item.dtype.names and len(shape) == 1:
            for field in item.dtype.names:
                if item.dtype[field].kind in "fiu" and not item.dtype[field].shape:
                    found[f"{name}/{field}"] = (item, field)
        elif item.dtype.kind in "fiu" and item.size == max(shape):
            found[name] = (item, ())
        elif item.dtype.kind in "fiu" and len(shape) == 2 and min(shape) <= MOST_DATASETS:
            is_tall = shape[0] == max(shape)
            for k in range(min(shape)):
                place = (slice(None), k) if is_tall else (k, slice(None))
                found[f"{name}[:,{k}]" if is_tall else f"{name}[{k},:]"] = (item, place)

    file.visititems(visit_item)
    return found


def _decode_text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def library() -> Any:
    try:
        import h5py
    except ImportError:
        raise FdhilError("HDF5 files need the extra 'hdf5': pip install 'fdhil[hdf5]'") from None
    return h5py
