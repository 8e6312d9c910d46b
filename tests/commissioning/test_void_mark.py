"""What voids a commissioning record, what is compared, and what makes it valid again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.commissioning.commissioning_record import CommissioningRecord, load_record, save_record
from fdhil.commissioning.drive_survey import DeviceIdentity, DriveSurvey
from fdhil.commissioning.finding import Finding
from fdhil.commissioning.record_comparison import compare_record, compute_survey_fingerprint, verify_commissioned_drives
from fdhil.commissioning.traffic_listener import BusTraffic
from fdhil.commissioning.void_mark import (
    build_mark_path,
    clear_void_mark,
    is_record_void,
    mark_record_void,
    read_void_mark,
)
from fdhil.errors import StoreError
from tests.bench import bench_document

RECORD = CommissioningRecord(
    "X", 1, 2, 3, 4, "c0ffee", "f1f2", {"6007": 1, "6065": 32768, "1402": 1025}, 1e4, True, 9.8, True, "proven", ""
)
FOUND = DriveSurvey(DeviceIdentity(1, 2, 3, 4), "f1f2", {"6007": 1, "6065": 32768}, 1e4, ())


def test_mark_lasts_until_comparison_or_commissioning(tmp_path: Path) -> None:
    store = tmp_path / "store"
    save_record(RECORD, store)
    assert not is_record_void(store, "X")
    mark_record_void(store, "X", "the first reason")
    mark_record_void(store, "X", "the newest reason")
    assert is_record_void(store, "X")
    assert not is_record_void(store, "Y")
    assert "the newest reason" in build_mark_path(store, "X").read_text()
    for _ in range(2):
        clear_void_mark(store, "X", read_void_mark(store, "X"))
    assert not is_record_void(store, "X")
    mark_record_void(store, "X", "again")
    save_record(RECORD, store)
    assert not is_record_void(store, "X")
    assert load_record(store, "X") == RECORD
    assert not list(store.glob("*.part"))


def test_new_mark_during_comparison_keeps_record_void(tmp_path: Path) -> None:
    before = read_void_mark(tmp_path, "X")
    mark_record_void(tmp_path, "X", "booted")
    clear_void_mark(tmp_path, "X", before)
    assert is_record_void(tmp_path, "X")
    before = read_void_mark(tmp_path, "X")
    mark_record_void(tmp_path, "X", "booted again")
    clear_void_mark(tmp_path, "X", before)
    assert is_record_void(tmp_path, "X")
    clear_void_mark(tmp_path, "X", read_void_mark(tmp_path, "X"))
    assert not is_record_void(tmp_path, "X")


def test_unreadable_store_counts_as_void(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert is_record_void(file, "X")
    with pytest.raises(StoreError, match="cannot be written"):
        mark_record_void(file, "X", "why")
    build_mark_path(tmp_path, "X").mkdir()
    with pytest.raises(StoreError, match="cannot be removed"):
        clear_void_mark(tmp_path, "X", read_void_mark(tmp_path, "X"))


def test_unchanged_drive_matches_record() -> None:
    """The RPDO that the feed-forward's commissioning made valid is in the PDOs' fingerprint, not an option."""
    finding = compare_record(RECORD, FOUND)
    assert finding.ok
    assert finding.found == compute_survey_fingerprint(FOUND) == RECORD.fingerprint


WRONG = Finding("scale", "1", "2", False, "it counts twice", "correct the drive's factors")


@pytest.mark.parametrize(
    ("found", "told"),
    [
        (replace(FOUND, options={"6007": 1, "6065": 0xFFFFFFFF}), "0x6065 is 4294967295, and was 32768"),
        (replace(FOUND, options={"6007": 0, "6065": 32768}), "0x6007 is 0, and was 1"),
        (replace(FOUND, options={"6007": 1}), "0x6065 is missing, and was 32768"),
        (replace(FOUND, options={**FOUND.options, "607D01": 5}), "0x607D01 is 5, and was missing"),
        (replace(FOUND, identity=DeviceIdentity(1, 2, 3, 5)), "its serial number is 5, not 4"),
        (replace(FOUND, identity=DeviceIdentity(1, 9, 3, 4)), "vendor, product or revision"),
        (replace(FOUND, fingerprint="other"), "its PDO mapping is different"),
        (replace(FOUND, findings=(WRONG,)), "it counts twice; correct the drive's factors"),
    ],
)
def test_changed_drive_is_reported_with_difference(found: DriveSurvey, told: str) -> None:
    finding = compare_record(RECORD, found)
    assert finding.ok is False
    assert told in finding.cause
    assert "fdhil commission --axis X" in finding.advice


def test_every_record_is_compared_before_guard_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = bench_document("XYZ")
    document["axis"]["Z"].pop("correction")
    config = machine_config.parse_config(document, folder=tmp_path)
    store, reported = config.store.directory, list[str]()
    compared, nc = list[str](), [True]

    def compare(_config: object, record: CommissioningRecord) -> Finding:
        compared.append(record.axis)
        ok = record.axis == "Y"
        return Finding("", "", "", ok, "" if ok else "it differs", "mend it")

    monkeypatch.setattr(
        "fdhil.commissioning.record_comparison._listen_to_bus", lambda *_: BusTraffic(sync_ns=[1] * nc[0])
    )
    monkeypatch.setattr("fdhil.commissioning.record_comparison.compare_drive", compare)
    verify_commissioned_drives(config, "can0", reported.append)
    for axis in "XYZ":
        save_record(replace(RECORD, axis=axis), store)
    mark_record_void(store, "Y", "booted")
    verify_commissioned_drives(config, "can0", reported.append)
    assert compared == reported == []  # with an NC on the bus nothing is read
    assert is_record_void(store, "Y")
    nc[0] = False
    verify_commissioned_drives(config, "can0", reported.append)
    assert compared == ["X", "Y"]
    assert is_record_void(store, "X")
    assert not is_record_void(store, "Y")
    assert reported == ["RecordVoid: axis X: it differs; the axis cannot be armed or adopted; mend it"]
    (store / "commissioning-X.json").write_text("damaged")
    verify_commissioned_drives(config, "can0", reported.append)
    assert compared == ["X", "Y", "Y"]
