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
from fdhil.daemon.outcome_json import as_document
from fdhil.daemon.outcome_store import OutcomeStore, raw_scales
from fdhil.errors import StoreError
from fdhil.identification.pooling import member
from fdhil.records import LoopEstimate, Notice, Outcome, Verdict, frozen
from fdhil.store.history import FILE_NAME, History
from fdhil.store.rows import Comparison, Stamp
from fdhil.store.set_document import set_document
from fdhil.store.windows import encode_window, list_windows
from tests.daemon.machine import config_of
from tests.store.made import BENCH, outcome, published, window


def opened(folder: Path) -> tuple[OutcomeStore, list[Notice]]:
    store = OutcomeStore(config_of(folder))
    return store, store.open()


def test_outcomes_are_kept_in_their_order_and_known_again(tmp_path: Path) -> None:
    store, output = opened(tmp_path)
    notices: list[Outcome] = [
        outcome(),
        outcome(accepted=False),
        outcome(),
        published(1),
        Notice("A", "info", "b", "X"),
    ]
    assert output == []
    assert store.keep(notices) == []
    store.close()
    again, _ = opened(tmp_path)
    known = again.known("X")
    assert again.counts("X") == (2, 1)
    assert known.first is not None
    assert known.newest is not None
    assert known.newest.parameters == published(1).parameters
    assert [point.tick for point in known.points] == [12_345, 12_345]
    assert again.newest()["X"].window_ids == (1, 3)
    again.close()


def test_a_drives_window_is_kept_as_integers(tmp_path: Path) -> None:
    scales = raw_scales(config_of(tmp_path), "X")
    raw = np.random.default_rng(1).integers(-(2**30), 2**30, 600).astype(float)
    columns: dict[str, Any] = {name: candidates[0].decode(raw) for name, candidates in scales.items()}
    content = encode_window(window(**columns), "", scales)
    assert b"factor" in content
    assert content.count(b'"factor"') == len(scales)


@pytest.mark.parametrize(("number", "code"), [(errno.ENOSPC, "DiskFull"), (errno.EROFS, "ReadOnlyStore")])
@pytest.mark.fault("F3", "F5")
def test_a_disk_that_refuses_is_told_once_and_recovers(
    number: int, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, _ = opened(tmp_path)

    def refuse(*_: Any, **__: Any) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr("fdhil.store.atomic.os.write", refuse)
        output = store.keep([outcome()])
        assert [notice.code for notice in output] == [code]
        assert "continues in shadow" in output[0].text
        assert store.fault == code
        assert store.keep([outcome()]) == []
    assert [notice.code for notice in store.keep([outcome()])] == ["StoreRecovered"]
    assert store.fault != code
    assert len(list_windows(tmp_path / "fdhil-data" / "windows").windows) == 1
    store.close()


@pytest.mark.fault("F17")
def test_a_damaged_history_is_put_aside_and_a_new_one_begun(tmp_path: Path) -> None:
    directory = tmp_path / "fdhil-data"
    directory.mkdir()
    for k in (1, 2):
        (directory / FILE_NAME).write_bytes(b"garbage" * 1000)
        store, output = opened(tmp_path)
        assert [notice.code for notice in output] == ["CorruptFile"]
        assert store.fault is None
        assert store.keep([published(k)]) == []
        store.close()
        assert (directory / f"{FILE_NAME}.corrupt-{k}").read_bytes().startswith(b"garbage")


@pytest.mark.fault("F19")
def test_a_newer_schema_is_left_alone_in_shadow(tmp_path: Path) -> None:
    directory = tmp_path / "fdhil-data"
    History.open(directory).close()
    db = sqlite3.connect(directory / FILE_NAME)
    db.execute("PRAGMA user_version = 99")
    db.close()
    store, output = opened(tmp_path)
    assert [notice.code for notice in output] == ["SchemaVersion"]
    assert store.fault == "SchemaVersion"
    assert store.keep([outcome()]) == []
    assert store.known("X").newest is None
    store.close()


def test_a_store_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "fdhil-data").write_text("in the way")
    store, output = opened(tmp_path)
    assert [notice.severity for notice in output] == ["MAJOR"]
    assert store.keep([outcome()]) == []


@pytest.mark.fault("F18")
def test_strays_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "fdhil-data" / "windows"
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("")
    store, output = opened(tmp_path)
    assert [notice.code for notice in output] == ["StrayFiles"]
    assert "notes.txt" in output[0].text
    store.close()


def test_what_windows_tell_a_pool_is_known_again(tmp_path: Path) -> None:
    store, _ = opened(tmp_path)
    ways = (1, -1, 1)
    assert store.keep([outcome(of=window(direction=way, start_tick=1000 * k)) for k, way in enumerate(ways)]) == []
    store.close()
    again, _ = opened(tmp_path)
    known = again.known("X")
    again.close()
    assert set(known.first) == {1, -1}
    assert [result.direction for result in known.members] == list(ways)
    assert [result.place for result in known.members] == [-2, -1, 0]
    made = outcome(of=window())
    assert made.estimate is not None
    fresh = member(made.window, made.estimate)
    for name in ("values", "own", "shared"):
        assert getattr(known.members[0], name).tobytes() == getattr(fresh, name).tobytes()


def test_loops_are_known_again_as_long_as_the_configuration_is_the_same(tmp_path: Path) -> None:
    found = LoopEstimate("X", "cascade", ("speed_filter_s",), frozen([1e-3]), frozen([[1e-10]]), Verdict(True, None))
    store, _ = opened(tmp_path)
    digest = config_of(tmp_path).digest
    assert store.keep([found, published(1)]) == []
    assert store.known("X").loops is None
    assert store.keep([replace(published(2), config_digest=digest)]) == []
    loops = store.known("X").loops
    store.close()
    assert loops is not None
    assert (loops.names, loops.values.tolist()) == (found.names, [1e-3])


def test_a_load_is_part_of_what_is_told_in_json() -> None:
    loaded = BENCH.changed(load=2.5)
    document = set_document(replace(published(), parameters=loaded, covariance=frozen(np.eye(7)), unexplained_um=0.5))
    assert document["terms"]["load"]["value"] == 2.5
    assert document["terms"]["load"]["unit"] == "N.m"
    assert document["terms"]["load"]["high"] == pytest.approx(2.5 + 1.96, abs=0.01)
    assert (document["unexplained_um"], document["warnings"]) == (0.5, [])
    result = as_document(outcome())
    assert (result["terms"], result["warnings"], result["unexplained_um"]) == ({}, [], None)
    assert result["friction_at_rapid"]["value"] == pytest.approx(5.0 + 0.05 * 157.08, abs=0.01)


@pytest.mark.fault("F17")
def test_the_log_of_a_damaged_history_is_kept_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "fdhil-data" / FILE_NAME
    store, _ = opened(tmp_path)
    for k in range(50):
        assert store.keep([Notice("A", "MAJOR", f"record {k} " + "x" * 500)]) == []
    store.close()
    store, _ = opened(tmp_path)
    assert store.keep([Notice("A", "MAJOR", "the newest, in the log alone")]) == []
    reader = sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)  # as of fdhil web: the log outlives the daemon
    reader.execute("SELECT count(*) FROM notices").fetchone()
    store.close()
    log = path.with_name(FILE_NAME + "-wal").read_bytes()
    assert b"in the log alone" in log
    with path.open("r+b") as file:
        file.seek(14 * 4096)
        file.write(b"\xff" * 4096)
    store, output = opened(tmp_path)
    assert [notice.code for notice in output] == ["CorruptFile"]
    store.close()
    reader.close()
    assert path.with_name(f"{FILE_NAME}.corrupt-1-wal").read_bytes() == log


def test_an_old_window_that_cannot_be_removed_is_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = OutcomeStore(config_of(tmp_path, store={"keep_windows": 2}))
    store.open()

    def refuse(path: Path, **_: Any) -> None:
        if path.suffix == ".parquet":
            raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(Path, "unlink", refuse)
    notices = [notice for _ in range(6) for notice in store.keep([outcome()])]
    assert [(notice.code, notice.severity) for notice in notices] == [("StrayFiles", "minor")]
    assert "w00000001-X.parquet cannot be removed" in notices[0].text
    assert (store.counts("X"), store.fault) == ((6, 0), None)
    store.close()


def test_what_waits_to_be_acknowledged_waits_after_a_restart_whatever_news_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outcome_store, "NEWEST", 3)
    store, _ = opened(tmp_path)
    store.keep([Notice("MaintenanceDue", "MAJOR", "the screw"), *(Notice("A", "info", str(k)) for k in range(9))])
    store.close()
    again, _ = opened(tmp_path)
    assert again.notices.status()["count"] == 1
    assert again.acknowledge({"notices": [1], "by": "anna"})["ok"]
    again.close()


def test_a_stray_whose_name_is_no_unicode_is_named_escaped(tmp_path: Path) -> None:
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
def test_a_history_that_is_replaced_is_reported_and_what_follows_is_in_the_file_that_stands_there(
    change: Callable[[Path, Path], object], read: bool, tmp_path: Path
) -> None:
    history, backup = tmp_path / "fdhil-data" / FILE_NAME, tmp_path / "backup"
    store, _ = opened(tmp_path)
    assert store.keep([outcome(), Notice("A", "MAJOR", "seen")]) == []
    with closing(sqlite3.connect(history)) as db, closing(sqlite3.connect(backup)) as copy:
        db.backup(copy)
    for k in range(20):
        assert store.keep([Notice("B", "MAJOR", f"record {k} " + "x" * 1500)]) == []
    reader = sqlite3.connect(f"{history.as_uri()}?mode=ro", uri=True)
    if read:
        reader.execute("SELECT count(*) FROM notices").fetchone()
    change(history, backup)
    whole = outcome()
    notices = [notice.code for k in range(8) for notice in store.keep([whole, Notice("C", "MAJOR", f"after {k}")])]
    assert (notices, store.fault) == (["StoreReplaced"], None)
    last = store.notices.status()["newest"][-1]["number"]
    assert store.acknowledge({"notices": [last], "by": "anna"})["ok"]
    with History.read(tmp_path / "fdhil-data") as found:
        assert len(found.windows()) in (8, 9)
        assert [n.notice.text for n in found.notices()][-8:] == [f"after {k}" for k in range(8)]
        assert found.notices()[-1].acknowledged is not None
    reader.close()
    store.close()
    with closing(sqlite3.connect(history)) as db:
        assert db.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_a_folder_of_windows_that_is_removed_is_made_again(tmp_path: Path) -> None:
    store, _ = opened(tmp_path)
    assert store.keep([outcome()]) == []
    shutil.rmtree(tmp_path / "fdhil-data" / "windows")
    notices = [notice.code for _ in range(3) for notice in store.keep([outcome()])]
    assert (notices, store.fault) == (["StoreFault", "StoreRecovered"], None)
    assert len(list_windows(tmp_path / "fdhil-data" / "windows").windows) == 2
    store.close()


def test_an_acknowledgement_names_notices_of_the_file_that_stands_there(tmp_path: Path) -> None:
    store, _ = opened(tmp_path)
    assert store.keep([Notice("A", "MAJOR", "of before")]) == []
    (tmp_path / "fdhil-data" / FILE_NAME).unlink()
    with pytest.raises(StoreError, match="was replaced; nothing is acknowledged"):
        store.acknowledge({"notices": [1], "by": "anna"})
    assert [notice.code for notice in store.keep([])] == ["StoreReplaced"]
    assert store.acknowledge({"notices": [1], "by": "anna"})["code"] == "NoSuchNotice"
    store.close()


def test_another_program_that_writes_to_the_history_does_not_replace_it(tmp_path: Path) -> None:
    store, _ = opened(tmp_path)
    assert store.keep([outcome()]) == []
    with History.open(tmp_path / "fdhil-data") as other:
        other.add_comparison(Comparison("p", "name", "", {}, 1.0, ()), Stamp.now())
    assert [store.keep([outcome()]) for _ in range(3)] == [[]] * 3
    store.close()
