"""Reading a long history verifies only the rows that are needed."""

from __future__ import annotations

import sqlite3
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.store import history as module
from fdhil.store import schema
from fdhil.store.history import HISTORY_FILE_NAME, History
from tests.store.made import STAMP, outcome, published

CHECKED = 8
ROWS = 60


@pytest.fixture(autouse=True)
def _few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CHECKED", CHECKED)


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    counted, real = Counter[str](), schema.digest_of

    def digest(table: str, row: Any) -> str:
        counted[table] += 1
        return real(table, row)

    monkeypatch.setattr(schema, "digest_of", digest)
    return counted


def filled(folder: Path, rare: int = 3) -> History:
    history = History.open(folder)
    for k in range(ROWS):
        axis = "Y" if rare <= k < rare + 2 else "X"
        made = outcome()
        number = history.add_window(replace(made, window=replace(made.window, axis=axis)), f"w{k}.parquet", STAMP)
        history.add_revision(replace(published(), axis=axis, revision=k), [number], STAMP)
    return history


@pytest.mark.fault("F10")
def test_a_start_looks_at_the_newest_rows_alone(tmp_path: Path, looked_at: Counter[str]) -> None:
    with filled(tmp_path) as history:
        looked_at.clear()
        assert history.put_damaged_aside() == ""
        assert looked_at == {"windows": CHECKED, "revisions": CHECKED}


@pytest.mark.fault("F10")
def test_what_is_asked_of_an_axis_does_not_look_at_all_others(tmp_path: Path, looked_at: Counter[str]) -> None:
    with filled(tmp_path) as history:
        looked_at.clear()
        assert history.windows("Z", limit=4) == []
        assert history.first_windows("Z") == {}
        assert history.counts("X") == (ROWS - 2, 0)
        assert looked_at["windows"] <= 3 * CHECKED


def test_an_axis_that_moved_long_ago_is_known_all_the_same(tmp_path: Path) -> None:
    with filled(tmp_path) as history:
        assert [found.file for found in history.windows("Y", limit=4)] == ["w3.parquet", "w4.parquet"]
        assert [found.set.revision for found in history.revisions("Y", limit=1)] == [4]
        assert history.first_windows("Y")[1].file == "w3.parquet"
        assert len(history.windows()) == ROWS


@pytest.mark.fault("F17")
def test_an_old_row_that_is_damaged_is_left_out_when_it_is_read(tmp_path: Path) -> None:
    filled(tmp_path).close()
    with sqlite3.connect(tmp_path / HISTORY_FILE_NAME) as db:
        db.execute("UPDATE revisions SET K = 9.0 WHERE axis = 'Y' AND revision = 4")
        db.execute("UPDATE windows SET axis = 'Q' WHERE id = ?", (ROWS,))  # the very value that is compared
    db.close()
    told: list[str] = []
    with History.read(tmp_path, told.append) as history:
        assert [found.set.revision for found in history.revisions("Y", limit=2)] == [3]
        assert len(history.windows("X", limit=2)) == 2
    assert told
    assert "1 of windows (row 60)" in told[0]
    assert "1 of revisions (row 5)" in told[0]
