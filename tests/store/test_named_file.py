"""A name from outside opens only regular files of one folder."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fdhil.errors import StoreError
from fdhil.store.named_file import open_named


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    top = tmp_path_factory.mktemp("store")
    (top / "secret").write_bytes(b"the key")
    inside = top / "windows"
    (inside / "deeper").mkdir(parents=True)
    (inside / "w00000001-X.parquet").write_bytes(b"a rapid")
    (inside / "link").symlink_to(top / "secret")
    (inside / "dangling").symlink_to(top / "nothing")
    os.mkfifo(inside / "pipe")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(os.path.relpath(inside / "socket"))
    return inside


def test_file_of_the_folder_is_opened(folder: Path) -> None:
    with open_named(folder, "w00000001-X.parquet") as file:
        assert file.read() == b"a rapid"


@pytest.mark.fault("G4")
@pytest.mark.parametrize(
    "name",
    [
        "../secret", "..", ".", "", "/etc/passwd", "deeper/../../secret", "..\\secret", "w1\0.parquet", "w1.parquet\n",
        "a" * 65, "ä.parquet", "%2e%2e", "~", ".w1.parquet.part", "link", "dangling", "deeper", "pipe", "socket",
    ],
)  # fmt: skip
def test_invalid_name_or_special_file_is_refused(folder: Path, name: str) -> None:
    with pytest.raises(StoreError) as refused:
        open_named(folder, name)
    assert refused.value.code == "BadName"
    assert "nothing was read" in str(refused.value)
    assert str(folder) not in str(refused.value)


@pytest.mark.fault("G4")
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
@given(name=st.text(max_size=80) | st.text(alphabet="./\\%2eE0wX-\0", max_size=12))
def test_no_name_reaches_a_file_outside(folder: Path, name: str) -> None:
    assert _read_or_code(folder, name) in {b"a rapid", "BadName", "NotKept"}


def _read_or_code(folder: Path, name: str) -> bytes | str:
    try:
        with open_named(folder, name) as file:
            return file.read()
    except StoreError as error:
        return error.code


@pytest.mark.fault("G4")
def test_missing_folder_or_file_in_its_place_is_reported(folder: Path) -> None:
    for place in (folder / "nowhere", folder / "w00000001-X.parquet"):
        with pytest.raises(StoreError) as refused:
            open_named(place, "w00000001-X.parquet")
        assert refused.value.code == "NotKept"


def test_displaced_file_is_reported(folder: Path) -> None:
    with pytest.raises(StoreError, match="keep_windows") as refused:
        open_named(folder, "w00000002-X.parquet")
    assert refused.value.code == "NotKept"
