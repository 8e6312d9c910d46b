"""Window files are exact to the bit; a damaged file is never read as a window."""

from __future__ import annotations

import errno
import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fdhil.errors import RecordingError, StoreError
from fdhil.records import NcMove, Stages, Window, freeze_array
from fdhil.store.window_file import RawScale, WindowStore, decode_window, encode_window, list_windows, read_window
from tests.store.sample_records import INCREMENTS_PER_MM, is_bit_identical, make_window

SCALES = {
    "demand_mm": (RawScale(divisor=INCREMENTS_PER_MM),),
    "position_mm": (RawScale(divisor=INCREMENTS_PER_MM),),
    "speed_rad_s": (RawScale(2 * math.pi, 65536.0), RawScale(2 * math.pi / 65536)),
    "current_a": (RawScale(0.05),),
    "voltage_v": (RawScale(0.02),),
}


@pytest.mark.parametrize("scales", [None, SCALES])
@pytest.mark.parametrize("raw", [True, False])
def test_window_is_read_back_bit_identical(raw: bool, scales: Any) -> None:
    made = make_window(raw=raw)
    assert is_bit_identical(decode_window(encode_window(made, "c0ffee", scales)), made)


@pytest.mark.parametrize(
    "changes",
    [
        {"voltage_v": None, "voltage_delay_s": None, "temperature_c": None},
        {"stages": Stages(None, None, None), "gaps": (), "direction": -1, "voltage_sampling": "instant"},
        {
            "table_mm": freeze_array(np.r_[np.nan, np.linspace(0.0, 1.0, 599)]),
            "table_m_s2": freeze_array(np.full(600, -0.1)),
        },
        {"nc": NcMove(12, "part.ngc", (0.5, 1.0), True)},
        {"nc": NcMove()},
        {"source": 'umlaut ä "quoted" \x1b[31m', "start_tick": 2**40},
    ],
)
def test_every_field_is_read_back(changes: dict[str, Any]) -> None:
    made = make_window(**changes)
    assert is_bit_identical(decode_window(encode_window(made, "c0ffee", SCALES)), made)


def test_window_without_table_sensors_keeps_old_format() -> None:
    head = json.loads(
        pq.ParquetFile(pa.BufferReader(encode_window(make_window(), "c0ffee"))).metadata.metadata[b"fdhil"]
    )
    assert not [name for name in head["columns"] if name.startswith("table")]
    assert head["digest"].startswith("eca1bdd0318e6ce9")


def test_drive_column_is_stored_as_integers_with_scale() -> None:
    file = pq.ParquetFile(pa.BufferReader(encode_window(make_window(), "c0ffee", SCALES)))
    table = file.read()
    head = json.loads(file.metadata.metadata[b"fdhil"])
    assert {str(table.schema.field(name).type) for name in table.column_names} == {"int64"}
    assert head["columns"]["current_a"] == {"unit": "A", "factor": 0.05, "divisor": 1.0}
    assert head["clock"] == "SYNC tick"
    assert head["config_digest"] == "c0ffee"
    assert table.column("tick")[0].as_py() == 12_345
    assert table.column("current_a")[101].as_py() is None  # a lost sample is null, not a number


def test_integers_are_much_smaller_than_floats() -> None:
    assert len(encode_window(make_window(), "", SCALES)) < 0.6 * len(encode_window(make_window(), ""))


@settings(deadline=None, max_examples=40)
@given(hnp.arrays(np.float64, 50, elements=st.floats(allow_nan=True, allow_infinity=True, width=64)))
def test_any_floats_are_read_back(values: Any) -> None:
    made = make_window(n=50, raw=False)
    made = replace(made, speed_rad_s=freeze_array(values), current_a=freeze_array(-0.0 * np.ones(50)), gaps=())
    assert is_bit_identical(decode_window(encode_window(made, "", SCALES)), made)


@pytest.mark.parametrize("scale", [RawScale(-0.05), RawScale(2 * math.pi, -65536.0), RawScale(divisor=3276.8)])
def test_scale_is_used_only_if_bit_identical(scale: RawScale) -> None:
    raw = np.array([0.0, 1, -1, 12345, -(2**31), math.nan])
    encoded = scale.encode(freeze_array(scale.decode(raw)))
    assert encoded is not None
    assert np.array_equal(encoded, raw, equal_nan=True)
    assert scale.encode(freeze_array([0.3 * abs(scale.factor / scale.divisor)])) is None


def test_flipped_byte_never_yields_another_window() -> None:
    made = make_window(n=120, gaps=((100, 103),))
    content = encode_window(made, "c0ffee", SCALES)
    rng = np.random.default_rng(7)
    wrong = 0
    for place in rng.choice(len(content), 400, replace=False):
        broken = bytearray(content)
        broken[place] ^= 1 << int(rng.integers(8))
        try:
            read = decode_window(bytes(broken))
        except RecordingError:
            wrong += 1
            continue
        assert is_bit_identical(read, made), place
    assert wrong > 200


@pytest.mark.parametrize("length", [0, 1, 4, 8, 100, -1, -8, -100])
def test_truncated_file_is_reported_in_one_sentence(length: int, tmp_path: Path) -> None:
    path = tmp_path / "w00000001-X.parquet"
    path.write_bytes(encode_window(make_window(), "c0ffee")[:length])
    with pytest.raises(RecordingError) as error:
        read_window(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    foreign = tmp_path / "table.parquet"
    pq.write_table(pa.table({"a": [1, 2]}), foreign)
    with pytest.raises(RecordingError, match="format"):
        read_window(foreign)
    with pytest.raises(RecordingError, match="cannot be read"):
        read_window(tmp_path / "absent.parquet")
    with pytest.raises(RecordingError, match="cannot be read"):
        read_window(tmp_path)


def test_store_numbers_files_and_removes_the_oldest(tmp_path: Path) -> None:
    store = WindowStore(tmp_path / "windows", keep=3, config_digest="d")
    files = [store.append_window(make_window(n=60, seed=k, gaps=()), SCALES) for k in range(5)]
    assert [file.number for file in files] == [1, 2, 3, 4, 5]
    listing = list_windows(tmp_path / "windows")
    assert [file.number for file in listing.windows] == [3, 4, 5]
    assert is_bit_identical(read_window(files[4].path), make_window(n=60, seed=4, gaps=()))
    again = WindowStore(tmp_path / "windows", keep=3, config_digest="d")
    assert again.append_window(make_window(n=60)).number == 6
    assert again.append_window(make_window(n=60), at_least=41).number == 42


@pytest.mark.fault("F18")
def test_stray_files_are_listed_and_kept(tmp_path: Path) -> None:
    names = [
        "notes.txt",
        ".w00000009-X.parquet.part",
        "w1-X.parquet",
        "w00000003-X.parquet.bak",
        "\x1b[31m",
        "w00000002-x.parquet",
    ]
    for name in names:
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "w00000007-X.parquet").symlink_to(tmp_path / "notes.txt")
    (tmp_path / "w00000008-Y.parquet").mkdir()
    store = WindowStore(tmp_path, keep=1, config_digest="d")
    assert sorted(store.strays) == sorted([*names, "w00000007-X.parquet", "w00000008-Y.parquet"])
    assert store.append_window(make_window(n=60)).number == 1
    assert all((tmp_path / name).exists() for name in names)


def test_leftover_of_power_cut_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / ".w00000001-X.parquet.part").write_bytes(b"half of a window")
    store = WindowStore(tmp_path, keep=5, config_digest="d")
    assert is_bit_identical(read_window(store.append_window(make_window()).path), make_window())
    assert list_windows(tmp_path).strays == ()


@pytest.mark.parametrize(
    ("number", "code"),
    [(errno.ENOSPC, "DiskFull"), (errno.EROFS, "ReadOnlyStore"), (errno.EIO, "StoreFault")],
)
@pytest.mark.parametrize("step", ["open", "write", "fsync"])
@pytest.mark.fault("F3", "F4", "F5")
def test_failed_write_keeps_old_windows_and_leaves_no_partial_file(
    step: str, number: int, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = WindowStore(tmp_path, keep=1, config_digest="d")
    kept = store.append_window(make_window(n=60)).path

    def refuse(*_: Any, **__: Any) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(f"fdhil.store.atomic_file.os.{step}", refuse)
        with pytest.raises(StoreError) as error:
            store.append_window(make_window(n=60, seed=2))
    assert error.value.code == code
    assert [file.path for file in list_windows(tmp_path).windows] == [kept]
    assert store.append_window(make_window(n=60, seed=3)).number == 2


@pytest.mark.fault("F6")
def test_short_write_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    monkeypatch.setattr("fdhil.store.atomic_file.os.write", lambda fd, data: write(fd, bytes(data[:1000])))
    made: Window = make_window()
    assert is_bit_identical(read_window(WindowStore(tmp_path, 5, "d").append_window(made).path), made)


def test_file_that_cannot_be_removed_does_not_block_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = WindowStore(tmp_path, keep=2, config_digest="d")
    first = store.append_window(make_window(n=60)).path
    real = Path.unlink

    def unlink(path: Path, missing_ok: bool = False) -> None:
        if path == first:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        real(path, missing_ok)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink)
        for _ in range(5):
            store.append_window(make_window(n=60))
    assert [file.number for file in list_windows(tmp_path).windows] == [1, 5, 6]
    assert str(first) in str(store.removal_error)
    again = WindowStore(tmp_path, keep=2, config_digest="d")
    again.append_window(make_window(n=60))
    assert [file.number for file in list_windows(tmp_path).windows] == [6, 7]
    assert again.removal_error is None
