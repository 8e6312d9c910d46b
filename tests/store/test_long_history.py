"""Reading a long history verifies only the rows that are needed."""

from __future__ import annotations

import sqlite3
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.store import history_database as module
from fdhil.store import history_schema
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from tests.store.sample_records import STAMP, make_outcome, make_published

CHECKED = 8
ROWS = 60


@pytest.fixture(autouse=True)
def _small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CHECKED", CHECKED)


@pytest.fixture
def digested_rows(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    counted, real = Counter[str](), history_schema.compute_digest

    def digest(table: str, row: Any) -> str:
        counted[table] += 1
        return real(table, row)

    monkeypatch.setattr(history_schema, "compute_digest", digest)
    return counted


def fill_history(folder: Path, rare: int = 3) -> History:
    history = History.open(folder)
    for k in range(ROWS):
        axis = "Y" if rare <= k < rare + 2 else "X"
        made = make_outcome()
        number = history.add_window(replace(made, window=replace(made.window, axis=axis)), f"w{k}.parquet", STAMP)
        history.add_revision(replace(make_published(), axis=axis, revision=k), [number], STAMP)
    return history


@pytest.mark.fault("F10")
def test_start_verifies_only_newest_rows(tmp_path: Path, digested_rows: Counter[str]) -> None:
    with fill_history(tmp_path) as history:
        digested_rows.clear()
        assert history.quarantine_damaged_rows() == ""
        assert digested_rows == {"windows": CHECKED, "revisions": CHECKED}


@pytest.mark.fault("F10")
def test_query_of_an_axis_skips_rows_of_others(tmp_path: Path, digested_rows: Counter[str]) -> None:
    with fill_history(tmp_path) as history:
        digested_rows.clear()
        assert history.read_windows("Z", limit=4) == []
        assert history.read_first_windows("Z") == {}
        assert history.count_windows("X") == (ROWS - 2, 0)
        assert digested_rows["windows"] <= 3 * CHECKED


def test_axis_without_recent_rows_is_still_found(tmp_path: Path) -> None:
    with fill_history(tmp_path) as history:
        assert [found.file for found in history.read_windows("Y", limit=4)] == ["w3.parquet", "w4.parquet"]
        assert [found.set.revision for found in history.read_revisions("Y", limit=1)] == [4]
        assert history.read_first_windows("Y")[1].file == "w3.parquet"
        assert len(history.read_windows()) == ROWS


@pytest.mark.fault("F17")
def test_old_damaged_row_is_left_out_when_read(tmp_path: Path) -> None:
    fill_history(tmp_path).close()
    with sqlite3.connect(tmp_path / HISTORY_FILE_NAME) as db:
        db.execute("UPDATE revisions SET K = 9.0 WHERE axis = 'Y' AND revision = 4")
        db.execute("UPDATE windows SET axis = 'Q' WHERE id = ?", (ROWS,))  # the very value that is compared
    db.close()
    reported: list[str] = []
    with History.open_read_only(tmp_path, reported.append) as history:
        assert [found.set.revision for found in history.read_revisions("Y", limit=2)] == [3]
        assert len(history.read_windows("X", limit=2)) == 2
    assert reported
    assert "1 of windows (row 60)" in reported[0]
    assert "1 of revisions (row 5)" in reported[0]
