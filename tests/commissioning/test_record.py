"""The commissioning record is loaded unchanged or refused; without the key none can be made."""

from __future__ import annotations

import errno
import json
import os
import random
import stat
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.commissioning.commissioning_record import (
    KEY_NAME,
    SCHEMA,
    CommissioningRecord,
    build_record_path,
    load_record,
    save_record,
)
from fdhil.errors import StoreError

RECORD = CommissioningRecord(
    "X", 1, 2, 3, 4, "c0ffee", "f1f2", {"6007": 1}, 10_000.0, True, 9.8, True, "proven", "2026-01-01T00:00:00+00:00"
)


def test_saved_record_is_loaded_unchanged(tmp_path: Path) -> None:
    save_record(RECORD, tmp_path / "store")
    save_record(replace(RECORD, axis="Y"), tmp_path / "store")
    assert load_record(tmp_path / "store", "X") == RECORD
    assert load_record(tmp_path / "store", "Y") == replace(RECORD, axis="Y")
    assert load_record(tmp_path / "store", "Z") is None
    assert stat.S_IMODE((tmp_path / "store" / KEY_NAME).stat().st_mode) == 0o600


@pytest.mark.parametrize("key", ["offset_in_feedforward", "watchdog", "options", "serial", "digest", "schema", "axis"])
def test_modified_record_is_refused(key: str, tmp_path: Path) -> None:
    path = save_record(RECORD, tmp_path)
    document = json.loads(path.read_text())
    document[key] = {"6007": 0} if key == "options" else "other" if key != "serial" else 5
    path.write_text(json.dumps(document))
    with pytest.raises(StoreError, match="modified after the sign-off"):
        load_record(tmp_path, "X")


@pytest.mark.parametrize("seal", ["of no key", "of another key", "none", "no text", "not ASCII"])
def test_record_sealed_without_key_is_refused(seal: str, tmp_path: Path) -> None:
    """Anyone can recompute the digest; the seal needs the key."""
    path = save_record(RECORD, tmp_path)
    forged = replace(RECORD, watchdog="proven", options={"6007": 0})
    seals: dict[str, Any] = {"of no key": forged.compute_seal(b""), "of another key": forged.compute_seal(b"k" * 64),
                             "none": None, "no text": 5, "not ASCII": "\ud800é"}  # fmt: skip
    path.write_text(json.dumps({"schema": SCHEMA, **asdict(forged), "digest": forged.digest, "seal": seals[seal]}))
    with pytest.raises(StoreError, match="not sealed with this machine's key; commission the axis again"):
        load_record(tmp_path, "X")


def test_unsealed_record_requires_new_commissioning(tmp_path: Path) -> None:
    path = save_record(RECORD, tmp_path)
    document = json.loads(path.read_text()) | {"schema": "fdhil-commissioning-1"}
    del document["seal"]
    path.write_text(json.dumps(document))
    with pytest.raises(StoreError, match="predates sealed records; commission the axis again"):
        load_record(tmp_path, "X")


def _create_link(key: Path) -> None:
    key.rename(key.with_suffix(".old"))
    key.symlink_to(key.with_suffix(".old"))


def _create_fifo(key: Path) -> None:
    key.unlink()
    os.mkfifo(key, 0o600)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda key: key.chmod(0o644), "can be read by others"),
        (lambda key: key.unlink(), "cannot be read"),
        (lambda key: key.write_text("short"), "is damaged"),
        (_create_fifo, "can be read by others"),
        (_create_link, "cannot be read"),
    ],
    ids=["readable", "missing", "short", "fifo", "link"],
)
def test_readable_or_damaged_key_is_refused(spoil: Callable[[Path], object], words: str, tmp_path: Path) -> None:
    save_record(RECORD, tmp_path)
    spoil(tmp_path / KEY_NAME)
    with pytest.raises(StoreError, match=words) as error:
        load_record(tmp_path, "X")
    assert "commission every axis again" in str(error.value)


def test_caller_without_key_accepts_digest_only_on_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_record(RECORD, tmp_path)

    really_open = os.open

    def refuse_key(path: Any, *given: Any) -> int:
        if Path(path).name != KEY_NAME:
            return really_open(path, *given)
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", refuse_key)
    with pytest.raises(StoreError, match="may not be read by this user"):
        load_record(tmp_path, "X")
    assert load_record(tmp_path, "X", may_lack_key=True) == RECORD


@pytest.mark.timeout(60)
def test_pipe_instead_of_record_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(build_record_path(tmp_path, "X"))
    with pytest.raises(StoreError, match="is not a commissioning record"):
        load_record(tmp_path, "X")


def test_key_may_be_in_another_folder(tmp_path: Path) -> None:
    key = tmp_path / "elsewhere.key"
    save_record(RECORD, tmp_path / "store", key)
    assert load_record(tmp_path / "store", "X", key) == RECORD
    assert not (tmp_path / "store" / KEY_NAME).exists()
    with pytest.raises(StoreError, match="the key of the records, cannot be read"):
        load_record(tmp_path / "store", "X")


@pytest.mark.parametrize(
    "text",
    ["", "{}", "[]", '{"schema": 1', "\x00", '{"options": 3}', "[" * 60_000, '{"serial": ' + "9" * 5000 + "}",
     '{"schema": "' + "x" * 70_000 + '"}'],
    ids=lambda text: text[:12],
)  # fmt: skip
def test_invalid_record_file_is_refused(text: str, tmp_path: Path) -> None:
    build_record_path(tmp_path, "X").write_text(text)
    with pytest.raises(StoreError, match="is not a commissioning record; commission the axis again"):
        load_record(tmp_path, "X")


def test_flipped_bit_never_changes_loaded_record(tmp_path: Path) -> None:
    path = save_record(RECORD, tmp_path)
    whole, rng, refused = path.read_bytes(), random.Random(4), list[str]()
    for byte in range(len(whole)):
        flipped = bytearray(whole)
        flipped[byte] ^= 1 << rng.randrange(8)
        path.write_bytes(flipped)
        try:
            assert load_record(tmp_path, "X") == RECORD
        except StoreError as error:
            refused.append(str(error))
    assert len(refused) > len(whole) / 2
    assert all("commission the axis again" in sentence for sentence in refused)
