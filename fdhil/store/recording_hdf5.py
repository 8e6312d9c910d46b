"""Recordings as HDF5 files: one dataset each with its unit as attribute, the headers as attributes of the file."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from fdhil.errors import FdhilError
from fdhil.records import Float
from fdhil.store.reading_process import read_apart
from fdhil.store.recording_table import UNITS, UNREADABLE, RecordingTable, check_size, unreadable

KIND = "HDF5 file"
MOST_DATASETS = 1000


def encode(table: RecordingTable) -> bytes:
    """Return a table as the bytes of an HDF5 file. FdhilError without the extra ``hdf5``."""
    content = io.BytesIO()
    with library().File(content, "w") as file:
        file.attrs.update(table.headers)
        for name, values in table.columns.items():
            stored = file.create_dataset(name, data=values, compression="gzip", shuffle=True)
            stored.attrs["unit"] = UNITS.get(name, "")
    return content.getvalue()


def decode(content: bytes, source: str) -> RecordingTable:
    """Return the table of a file's bytes; datasets in groups by their path. RecordingError when it is no HDF5 file."""
    return read_apart(__name__, KIND, content, source)


def read(content: bytes, source: str) -> RecordingTable:
    """Return the table in this process, which a damaged file may end."""
    h5py = library()
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            found = _vectors(file, h5py)
            check_size(max((stored.size for stored in found.values()), default=0), len(found), source)
            columns: dict[str, Float] = {
                name: np.asarray(stored[()], dtype=np.float64).ravel() for name, stored in found.items()
            }
            headers = {str(key): _text(value) for key, value in file.attrs.items()}
    except UNREADABLE as error:
        raise unreadable(source, KIND, error) from None
    return RecordingTable(headers, columns)


def _vectors(file: Any, h5py: Any) -> dict[str, Any]:
    """Return the datasets of real numbers along one dimension, by path; links out of the file are not followed."""
    found: dict[str, Any] = {}

    def look(name: str, item: Any) -> None:
        plain = isinstance(item, h5py.Dataset) and not item.external and not item.is_virtual
        if plain and item.dtype.kind in "fiu" and item.size == max(item.shape or (0,)) and len(found) < MOST_DATASETS:
            found[name] = item

    file.visititems(look)
    return found


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def library() -> Any:
    """Return what reads and writes such files. FdhilError without the extra."""
    try:
        import h5py
    except ImportError:
        raise FdhilError("HDF5 files need the extra 'hdf5': pip install 'fdhil[hdf5]'") from None
    return h5py
