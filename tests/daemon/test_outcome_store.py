"""The daemon's store when full, read-only, damaged or foreign: the daemon continues in shadow and reports it."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.daemon import outcome_store
from fdhil.daemon.outcome_json import build_outcome_document
from fdhil.daemon.outcome_store import OutcomeStore, get_raw_scales
from fdhil.errors import StoreError
from fdhil.identification.window_pool import build_pool_member
from fdhil.records import LoopEstimate, Notice, Outcome, Verdict, freeze_array
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.history_rows import Comparison, TimeStamp
from fdhil.store.parameter_document import make_set_document
from fdhil.store.window_file import encode_window, list_windows
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import BENCH, make_outcome, make_published, make_window


def opened(folder: Path) -> tuple[OutcomeStore, list[Notice]]:
    store = OutcomeStore(config_of(folder))
    return store, store.open()


def test_outcomes_are_stored_in_order_and_loaded_again(tmp_path: Path) -> None:
    store, output = opened(tmp_path)
    notices: list[Outcome] = [
        make_outcome(),
        make_outcome(accepted=False),
        make_outcome(),
        make_published(1),
        Notice("A", "info", "b", "X"),
    ]
    assert output == []
    assert store.store_outcomes(notices) == []
    store.close()
    again, _ = opened(tmp_path)
    known = again.read_axis_history("X")
    assert again.count_windows("X") == (2, 1)
    assert known.first is not None
    assert known.newest is not None
    assert known.newest.parameters == make_published(1).parameters
    assert [point.tick for point in known.points] == [12_345, 12_345]
    assert again.read_newest_revisions()["X"].window_ids == (1, 3)
    again.close()


def test_window_of_a_drive_is_stored_as_integers(tmp_path: Path) -> None:
    scales = get_raw_scales(config_of(tmp_path), "X")
    raw = np.random.default_rng(1).integers(-(2**30), 2**30, 600).astype(float)
    columns: dict[str, Any] = {name: candidates[0].decode(raw) for name, candidates in scales.items()}
    content = encode_window(make_window(**columns), "", scales)
    assert b"factor" in content
    assert content.count(b'"factor"') == len(scales)


@pytest.mark.parametrize(("number", "code"), [(errno.ENOSPC, "DiskFull"), (errno.EROFS, "ReadOnlyStore")])
@pytest.mark.fault("F3", "F5")
def test_disk_error_is_reported_once_and_recovers(
    number: int, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, _ = opened(tmp_path)

    def refuse(*_: Any, **__: Any) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr("fdhil.store.atomic_file.os.write", refuse)
        output = store.store_outcomes([make_outcome()])
        assert [notice.code for notice in output] == [code]
        assert "continues in shadow" in output[0].text
        assert store.fault == code
        assert store.store_outcomes([make_outcome()]) == []
    assert [notice.code for notice in store.store_outcomes([make_outcome()])] == ["StoreRecovered"]
    assert store.fault != code
    assert len(list_windows(tmp_path / "fdhil-data" / "windows").windows) == 1
    store.close()


@pytest.mark.fault("F17")
def test_damaged_history_is_moved_aside_and_a_new_one_started(tmp_path: Path) -> None:
    directory = tmp_path / "fdhil-data"
    directory.mkdir()
    for k in (1, 2):
        (directory / HISTORY_FILE_NAME).write_bytes(b"garbage" * 1000)
        store, output = opened(tmp_path)
        assert [notice.code for notice in output] == ["CorruptFile"]
        assert store.fault is None
        assert store.store_outcomes([make_published(k)]) == []
        store.close()
        assert (directory / f"{HISTORY_FILE_NAME}.corrupt-{k}").read_bytes().startswith(b"garbage")


@pytest.mark.fault("F19")
def test_newer_schema_is_not_touched_in_shadow(tmp_path: Path) -> None:
    directory = tmp_path / "fdhil-data"
    History.open(directory).close()
    db = sqlite3.connect(directory / HISTORY_FILE_NAME)
    db.execute("PRAGMA user_version = 99")
    db.close()
    store, output = opened(tmp_path)
    assert [notice.code for notice in output] == ["SchemaVersion"]
    assert store.fault == "SchemaVersion"
    assert store.store_outcomes([make_outcome()]) == []
    assert store.read_axis_history("X").newest is None
    store.close()


def test_store_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    (tmp_path / "fdhil-data").write_text("in the way")
    store, output = opened(tmp_path)
    assert [notice.severity for notice in output] == ["MAJOR"]
    assert store.store_outcomes([make_outcome()]) == []


@pytest.mark.fault("F18")
def test_stray_files_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "fdhil-data" / "windows"
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("")
    store, output = opened(tmp_path)
    assert [notice.code for notice in output] == ["StrayFiles"]
    assert "notes.txt" in output[0].text
    store.close()


def test_pool_data_of_windows_are_loaded_again(tmp_path: Path) -> None:
    store, _ = opened(tmp_path)
    ways = (1, -1, 1)
    assert (
        store.store_outcomes(
            [make_outcome(of=make_window(direction=way, start_tick=1000 * k)) for k, way in enumerate(ways)]
        )
        == []
    )
    store.close()
    again, _ = opened(tmp_path)
    known = again.read_axis_history("X")
    again.close()
    assert set(known.first) == {1, -1}
    assert [result.direction for result in known.members] == list(ways)
    assert [result.place for result in known.members] == [-2, -1, 0]
    made = make_outcome(of=make_window())
    assert made.estimate is not None
    fresh = build_pool_member(made.window, made.estimate)
    for name in ("values", "own", "shared"):
        assert getattr(known.members[0], name).tobytes() == getattr(fresh, name).tobytes()


def test_loops_are_loaded_again_with_the_same_configuration(tmp_path: Path) -> None:
    found = LoopEstimate(
        "X", "cascade", ("speed_filter_s",), freeze_array([1e-3]), freeze_array([[1e-10]]), Verdict(True, None)
    )
    store, _ = opened(tmp_path)
    digest = config_of(tmp_path).digest
    assert store.store_outcomes([found, make_published(1)]) == []
    assert store.read_axis_history("X").loops is None
    assert store.store_outcomes([replace(make_published(2), config_digest=digest)]) == []
    loops = store.read_axis_history("X").loops
    store.close()
    assert loops is not None
    assert (loops.names, loops.values.tolist()) == (found.names, [1e-3])


def test_load_is_part_of_the_json_document() -> None:
    loaded = BENCH.replace_values(load=2.5)
    document = make_set_document(
        replace(make_published(), parameters=loaded, covariance=freeze_array(np.eye(7)), unexplained_um=0.5)
    )
    assert document["terms"]["load"]["value"] == 2.5
    assert document["terms"]["load"]["unit"] == "N.m"
    assert document["terms"]["load"]["high"] == pytest.approx(2.5 + 1.96, abs=0.01)
    assert (document["unexplained_um"], document["warnings"]) == (0.5, [])
    result = build_outcome_document(make_outcome())
    assert (result["terms"], result["warnings"], result["unexplained_um"]) == ({}, [], None)
    assert result["friction_at_rapid"]["value"] == pytest.approx(5.0 + 0.05 * 157.08, abs=0.01)


@pytest.mark.fault("F17")
def test_log_of_a_damaged_history_is_moved_with_it(tmp_path: Path) -> None:
    path = tmp_path / "fdhil-data" / HISTORY_FILE_NAME
    store, _ = opened(tmp_path)
    for k in range(50):
        assert store.store_outcomes([Notice("A", "MAJOR", f"record {k} " + "x" * 500)]) == []
    store.close()
    store, _ = opened(tmp_path)
    assert store.store_outcomes([Notice("A", "MAJOR", "the newest, in the log alone")]) == []
    reader = sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)  # as of fdhil web: the log outlives the daemon
    reader.execute("SELECT count(*) FROM notices").fetchone()
    store.close()
    log = path.with_name(HISTORY_FILE_NAME + "-wal").read_bytes()
    assert b"in the log alone" in log
    with path.open("r+b") as file:
        file.seek(14 * 4096)
        file.write(b"\xff" * 4096)
    store, output = opened(tmp_path)
    assert [notice.code for notice in output] == ["CorruptFile"]
    store.close()
    reader.close()
    assert path.with_name(f"{HISTORY_FILE_NAME}.corrupt-1-wal").read_bytes() == log


def test_undeletable_old_window_is_reported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = OutcomeStore(config_of(tmp_path, store={"keep_windows": 2}))
    store.open()

    def refuse(path: Path, **_: Any) -> None:
        if path.suffix == ".parquet":
            raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(Path, "unlink", refuse)
    notices = [notice for _ in range(6) for notice in store.store_outcomes([make_outcome()])]
    assert [(notice.code, notice.severity) for notice in notices] == [("StrayFiles", "minor")]
    assert "w00000001-X.parquet cannot be removed" in notices[0].text
    assert (store.count_windows("X"), store.fault) == ((6, 0), None)
    store.close()


def test_open_notices_stay_open_after_a_restart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outcome_store, "NEWEST", 3)
    store, _ = opened(tmp_path)
    store.store_outcomes(
        [Notice("MaintenanceDue", "MAJOR", "the screw"), *(Notice("A", "info", str(k)) for k in range(9))]
    )
    store.close()
    again, _ = opened(tmp_path)
    assert again.notices.build_status()["count"] == 1
    assert again.store_acknowledgement({"notices": [1], "by": "anna"})["ok"]
    again.close()


def test_non_unicode_stray_name_is_escaped(tmp_path: Path) -> None:
    folder = tmp_path / "fdhil-data" / "windows"
    folder.mkdir(parents=True)
    (folder / "b\udcf6hlen.txt").write_text("")
    store, _ = opened(tmp_path)
    assert store.strays == ("b\\udcf6hlen.txt",)
    store.close()


def replace_by_rename(history: Path, backup: Path) -> None:
    shutil.copy(backup, backup.with_name("other"))
    backup.with_name("other").replace(history)


def move_the_folder(history: Path, backup: Path) -> None:
    history.parent.rename(history.parent.with_name("moved"))


@pytest.mark.parametrize("read", [False, True])  # while somebody reads the log outlives its file
@pytest.mark.parametrize(
    "change",
    [
        replace_by_rename,
        lambda history, backup: shutil.copyfile(backup, history),
        lambda history, backup: history.unlink(),
        move_the_folder,
    ],
)
@pytest.mark.fault("F17")
def test_replaced_history_is_reported_and_the_new_file_used(
    change: Callable[[Path, Path], object], read: bool, tmp_path: Path
) -> None:
    history, backup = tmp_path / "fdhil-data" / HISTORY_FILE_NAME, tmp_path / "backup"
    store, _ = opened(tmp_path)
    assert store.store_outcomes([make_outcome(), Notice("A", "MAJOR", "seen")]) == []
    with closing(sqlite3.connect(history)) as db, closing(sqlite3.connect(backup)) as copy:
        db.backup(copy)
    for k in range(20):
        assert store.store_outcomes([Notice("B", "MAJOR", f"record {k} " + "x" * 1500)]) == []
    reader = sqlite3.connect(f"{history.as_uri()}?mode=ro", uri=True)
    if read:
        reader.execute("SELECT count(*) FROM notices").fetchone()
    change(history, backup)
    whole = make_outcome()
    notices = [
        notice.code for k in range(8) for notice in store.store_outcomes([whole, Notice("C", "MAJOR", f"after {k}")])
    ]
    assert (notices, store.fault) == (["StoreReplaced"], None)
    last = store.notices.build_status()["newest"][-1]["number"]
    assert store.store_acknowledgement({"notices": [last], "by": "anna"})["ok"]
    with History.open_read_only(tmp_path / "fdhil-data") as found:
        assert len(found.read_windows()) in (8, 9)
        assert [n.notice.text for n in found.read_notices()][-8:] == [f"after {k}" for k in range(8)]
        assert found.read_notices()[-1].acknowledged is not None
    reader.close()
    store.close()
    with closing(sqlite3.connect(history)) as db:
        assert db.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_removed_windows_folder_is_created_again(tmp_path: Path) -> None:
    store, _ = opened(tmp_path)
    assert store.store_outcomes([make_outcome()]) == []
    shutil.rmtree(tmp_path / "fdhil-data" / "windows")
    notices = [notice.code for _ in range(3) for notice in store.store_outcomes([make_outcome()])]
    assert (notices, store.fault) == (["StoreFault", "StoreRecovered"], None)
    assert len(list_windows(tmp_path / "fdhil-data" / "windows").windows) == 2
    store.close()


def test_acknowledgement_applies_only_to_the_current_history(tmp_path: Path) -> None:
    store, _ = opened(tmp_path)
    assert store.store_outcomes([Notice("A", "MAJOR", "of before")]) == []
    (tmp_path / "fdhil-data" / HISTORY_FILE_NAME).unlink()
    with pytest.raises(StoreError, match="was replaced; nothing is acknowledged"):
        store.store_acknowledgement({"notices": [1], "by": "anna"})
    assert [notice.code for notice in store.store_outcomes([])] == ["StoreReplaced"]
    assert store.store_acknowledgement({"notices": [1], "by": "anna"})["code"] == "NoSuchNotice"
    store.close()


def test_foreign_write_to_the_history_is_not_a_replacement(tmp_path: Path) -> None:
    store, _ = opened(tmp_path)
    assert store.store_outcomes([make_outcome()]) == []
    with History.open(tmp_path / "fdhil-data") as other:
        other.add_comparison(Comparison("p", "name", "", {}, 1.0, ()), TimeStamp.now())
    assert [store.store_outcomes([make_outcome()]) for _ in range(3)] == [[]] * 3
    store.close()
