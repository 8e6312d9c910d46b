"""Every recording format is lossless; damaged files are refused."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import tables
from fdhil.errors import RecordingError
from fdhil.records import Float, freeze_array
from fdhil.store import file_suffixes
from fdhil.store.recording_file import read_recording, read_table
from fdhil.store.recording_table import UNITS, RecordingTable, make_recording
from fdhil.store.window_export import convert_window, export_table
from tests.store.sample_records import make_window

SUFFIX = {name: file_suffixes.find_suffix(file_suffixes.RECORDING_SUFFIXES, name) for name in tables.RECORDING_FORMATS}


def _make_table() -> RecordingTable:
    made = make_window()
    lacking = np.where(np.arange(made.n) % 7 == 0, np.nan, made.position_mm)
    return convert_window(make_window(table_mm=freeze_array(lacking)))


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("name", tables.RECORDING_FORMATS)
def test_format_round_trip_is_bit_identical(name: str, tmp_path: Path) -> None:
    table, path = _make_table(), tmp_path / f"r{SUFFIX[name]}"
    export_table(table, path, name)
    back = read_table(path)
    assert dict(back.headers) == dict(table.headers)
    for column, values in table.columns.items():
        assert np.array_equal(back.columns[column], values, equal_nan=True), column
    read = read_recording(path)
    assert (read.axis, read.dt_s, read.gaps) == ("X", 0.001, make_recording(table).gaps)
    assert read.gaps


def _read_with_pyarrow(path: Path) -> tuple[Float, str]:
    import pyarrow.parquet as pq

    read = pq.read_table(path)
    return read.column("current_A").to_numpy(), read.schema.field("current_A").metadata[b"unit"].decode()


def _read_with_scipy(path: Path) -> tuple[Float, str]:
    from scipy import io

    read: Any = getattr(io, "loadmat")(path, simplify_cells=True)  # noqa: B009 - its stubs know no such option
    return read["current_A"], read["units"]["current_A"]


def _read_with_asammdf(path: Path) -> tuple[Float, str]:
    import asammdf

    with asammdf.MDF(path) as file:
        read = file.get("current_A")
        return read.samples, read.unit


def _read_with_h5py(path: Path) -> tuple[Float, str]:
    import h5py

    with h5py.File(path) as file:
        return file["current_A"][()], file["current_A"].attrs["unit"]


@pytest.mark.parametrize(
    ("name", "reader"),
    [
        ("parquet", _read_with_pyarrow),
        ("mat", _read_with_scipy),
        ("mdf4", _read_with_asammdf),
        ("hdf5", _read_with_h5py),
    ],
)
def test_format_library_reads_values_and_units(name: str, reader: Any, tmp_path: Path) -> None:
    table, path = _make_table(), tmp_path / f"r{SUFFIX[name]}"
    export_table(table, path, name)
    values, unit = reader(path)
    assert np.array_equal(values, table.columns["current_A"])
    assert unit == UNITS["current_A"] == "A"


def _is_refused(path: Path) -> bool:
    try:
        read_recording(path)
    except RecordingError as error:
        return "\n" not in str(error)
    return False


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("name", tables.RECORDING_FORMATS)
@pytest.mark.fault("G8")
def test_damaged_file_is_refused_or_read_as_numbers(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"r{SUFFIX[name]}"
    export_table(_make_table(), path, name)
    whole, dice = path.read_bytes(), random.Random(7)
    refused = 0
    for k in range(12):
        damaged = bytearray(whole[: dice.randrange(len(whole))] if k % 2 else whole)
        for _ in range(0 if k % 2 else 8):
            damaged[dice.randrange(len(damaged))] ^= 1 << dice.randrange(8)
        path.write_bytes(damaged)
        refused += _is_refused(path)
    assert refused >= 4  # every cut one, but for a format whose end tells nothing
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="is empty"):
        read_recording(path)


@pytest.mark.usefixtures("processes")
@pytest.mark.fault("G8")
def test_file_declaring_too_much_is_refused_before_reading(tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "vast.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("current_A", shape=(1 << 40,), dtype="f8", chunks=(1 << 16,))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(RecordingError, match="too many for a recording"):
        read_recording(path)


@pytest.mark.usefixtures("processes")
def test_matlab_7_3_file_is_read_as_hdf5(tmp_path: Path) -> None:
    import h5py

    path, table = tmp_path / "new.mat", _make_table()
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in table.columns.items():
            file.create_dataset(name, data=values.reshape(1, -1))
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + b"\0" * 8 + b"\0\2IM")
    back = read_table(path)
    assert np.array_equal(back.columns["current_A"], table.columns["current_A"])


def test_stored_window_is_a_recording_but_exported_one_is_not_a_window(tmp_path: Path) -> None:
    from fdhil.store.recording_parquet import is_recording
    from fdhil.store.window_file import encode_window

    stored, out = tmp_path / "w00000001-X.parquet", tmp_path / "out.parquet"
    stored.write_bytes(encode_window(make_window(), "c0ffee"))
    assert not is_recording(stored)
    export_table(read_table(stored), out, "parquet")
    assert is_recording(out)
    assert read_recording(out).gaps == read_recording(stored).gaps == ((100, 103),)
    assert json.dumps(dict(read_table(stored).headers)) == json.dumps(dict(convert_window(make_window()).headers))
