"""What voids a commissioning record, what is compared, and what makes it valid again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.commissioning.bus_listener import Traffic
from fdhil.commissioning.compare import compare_again, compare_record, found_fingerprint
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.record import CommissioningRecord, load_record, save_record
from fdhil.commissioning.survey import Identity, Survey
from fdhil.commissioning.void import confirm_record, is_void, void_mark, void_path, void_record
from fdhil.errors import StoreError
from tests.bench import bench_document

RECORD = CommissioningRecord(
    "X", 1, 2, 3, 4, "c0ffee", "f1f2", {"6007": 1, "6065": 32768, "1402": 1025}, 1e4, True, 9.8, True, "proven", ""
)
FOUND = Survey(Identity(1, 2, 3, 4), "f1f2", {"6007": 1, "6065": 32768}, 1e4, ())


def test_a_mark_lasts_until_it_was_compared_or_commissioned_anew(tmp_path: Path) -> None:
    store = tmp_path / "store"
    save_record(RECORD, store)
    assert not is_void(store, "X")
    void_record(store, "X", "the first reason")
    void_record(store, "X", "the newest reason")
    assert is_void(store, "X")
    assert not is_void(store, "Y")
    assert "the newest reason" in void_path(store, "X").read_text()
    for _ in range(2):
        confirm_record(store, "X", void_mark(store, "X"))
    assert not is_void(store, "X")
    void_record(store, "X", "again")
    save_record(RECORD, store)
    assert not is_void(store, "X")
    assert load_record(store, "X") == RECORD
    assert not list(store.glob("*.part"))


def test_what_is_seen_while_a_drive_is_compared_leaves_its_record_void(tmp_path: Path) -> None:
    before = void_mark(tmp_path, "X")
    void_record(tmp_path, "X", "booted")
    confirm_record(tmp_path, "X", before)
    assert is_void(tmp_path, "X")
    before = void_mark(tmp_path, "X")
    void_record(tmp_path, "X", "booted again")
    confirm_record(tmp_path, "X", before)
    assert is_void(tmp_path, "X")
    confirm_record(tmp_path, "X", void_mark(tmp_path, "X"))
    assert not is_void(tmp_path, "X")


def test_a_store_that_cannot_be_read_voids(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert is_void(file, "X")
    with pytest.raises(StoreError, match="cannot be written"):
        void_record(file, "X", "why")
    void_path(tmp_path, "X").mkdir()
    with pytest.raises(StoreError, match="cannot be removed"):
        confirm_record(tmp_path, "X", void_mark(tmp_path, "X"))


def test_the_same_drive_is_found_again() -> None:
    """The RPDO that the feed-forward's commissioning made valid is in the PDOs' fingerprint, not an option."""
    finding = compare_record(RECORD, FOUND)
    assert finding.ok
    assert finding.found == found_fingerprint(FOUND) == RECORD.fingerprint


WRONG = Finding("scale", "1", "2", False, "it counts twice", "correct the drive's factors")


@pytest.mark.parametrize(
    ("found", "told"),
    [
        (replace(FOUND, options={"6007": 1, "6065": 0xFFFFFFFF}), "0x6065 is 4294967295, and was 32768"),
        (replace(FOUND, options={"6007": 0, "6065": 32768}), "0x6007 is 0, and was 1"),
        (replace(FOUND, options={"6007": 1}), "0x6065 is missing, and was 32768"),
        (replace(FOUND, options={**FOUND.options, "607D01": 5}), "0x607D01 is 5, and was missing"),
        (replace(FOUND, identity=Identity(1, 2, 3, 5)), "its serial number is 5, not 4"),
        (replace(FOUND, identity=Identity(1, 9, 3, 4)), "vendor, product or revision"),
        (replace(FOUND, fingerprint="other"), "its PDO mapping is different"),
        (replace(FOUND, findings=(WRONG,)), "it counts twice; correct the drive's factors"),
    ],
)
def test_another_drive_is_told_by_what_differs(found: Survey, told: str) -> None:
    finding = compare_record(RECORD, found)
    assert finding.ok is False
    assert told in finding.cause
    assert "fdhil commission --axis X" in finding.advice


def test_before_the_guard_starts_each_record_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = bench_document("XYZ")
    document["axis"]["Z"].pop("correction")
    config = machine_config.parse_config(document, folder=tmp_path)
    store, told = config.store.directory, list[str]()
    compared, nc = list[str](), [True]

    def compare(_config: object, record: CommissioningRecord) -> Finding:
        compared.append(record.axis)
        ok = record.axis == "Y"
        return Finding("", "", "", ok, "" if ok else "it differs", "mend it")

    monkeypatch.setattr("fdhil.commissioning.compare._listen", lambda *_: Traffic(sync_ns=[1] * nc[0]))
    monkeypatch.setattr("fdhil.commissioning.compare.compare_drive", compare)
    compare_again(config, "can0", told.append)
    for axis in "XYZ":
        save_record(replace(RECORD, axis=axis), store)
    void_record(store, "Y", "booted")
    compare_again(config, "can0", told.append)
    assert compared == told == []  # with an NC on the bus nothing is read
    assert is_void(store, "Y")
    nc[0] = False
    compare_again(config, "can0", told.append)
    assert compared == ["X", "Y"]
    assert is_void(store, "X")
    assert not is_void(store, "Y")
    assert told == ["RecordVoid: axis X: it differs; the axis cannot be armed or adopted; mend it"]
    (store / "commissioning-X.json").write_text("damaged")
    compare_again(config, "can0", told.append)
    assert compared == ["X", "Y", "Y"]
