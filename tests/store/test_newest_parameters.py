"""The newest parameter set is returned with the regulators it belongs to."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from fdhil.config.uplink_section import Uplink
from fdhil.identification.drive_loops.loop_identification import DIFFER
from fdhil.records import LoopEstimate, Reason, Verdict, freeze_array
from fdhil.store import history_schema
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.history_rows import TimeStamp
from fdhil.store.newest_parameters import find_newest_loops, find_newest_parameters, read_newest_parameters
from fdhil.store.outbox import Outbox, OutboxReader
from tests.store.sample_records import STAMP, make_published

DIGEST = make_published().config_digest
FOUND = {"structure": "p_pi_pi", "speed_filter_s": 2e-3, "position_ki_per_s2": 0.0}
LATER = TimeStamp(STAMP.wall_s + 60.0, STAMP.boot, STAMP.monotonic_ns + 60 * 10**9)


def make_loops(*codes: str, accepted: bool = True) -> LoopEstimate:
    verdict = Verdict(accepted, None, (), 0.3, tuple(Reason(code, "72 um") for code in codes))
    return LoopEstimate(
        "X", "p_pi_pi", ("speed_filter_s",), freeze_array([2e-3]), freeze_array(np.array([[1e-10]])), verdict
    )


def test_set_is_read_with_its_loops(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_revision(replace(make_published(1), loops={"speed_filter_s": 0.002 + 1e-18}), [], STAMP)
        history.add_revision(replace(make_published(1, "Y"), loops={}), [], STAMP)
        history.add_revision(make_published(2), [], STAMP)
        assert [r.set.loops for r in history.read_revisions()] == [{"speed_filter_s": 0.002 + 1e-18}, {}, None]
        assert [r.set.loops for r in history.read_revisions("X", limit=1)] == [None]
    assert {axis: r.set.loops for axis, r in read_newest_parameters(tmp_path, "XYZ").items()} == {"X": None, "Y": {}}


def test_later_loops_replace_those_of_the_set(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_revision(replace(make_published(), loops={"speed_kp": 21.0}), [], STAMP)
        history.add_loops(make_loops(DIFFER, accepted=False), LATER)  # they explain nothing
        assert find_newest_parameters(history, "X")["X"].set.loops == {"speed_kp": 21.0}
        history.add_loops(make_loops(DIFFER), LATER)
        assert find_newest_parameters(history, "X")["X"].set.loops == FOUND
        history.add_loops(make_loops(), LATER)  # the configured ones explain as much
        assert find_newest_parameters(history, "X")["X"].set.loops == {}


def test_loops_of_an_earlier_tuning_are_ignored(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_loops(make_loops(DIFFER), STAMP)
        history.add_revision(replace(make_published(), loops={}), [], LATER)
        assert find_newest_parameters(history, "X")["X"].set.loops == {}
        assert find_newest_loops(history, "X", DIGEST) is None


def test_older_history_is_read_with_its_loops(tmp_path: Path) -> None:
    with History.open(tmp_path, also=Outbox(Uplink(), tmp_path).add_entry) as history:
        history.add_loops(make_loops(DIFFER), STAMP)
        history.add_revision(make_published(), [], LATER)
    with closing(sqlite3.connect(tmp_path / HISTORY_FILE_NAME)) as db:
        remove_loops_column(db)
    assert read_newest_parameters(tmp_path, "X")["X"].set.loops == FOUND  # a reader leaves the file as it is
    with History.open(tmp_path) as history:
        assert history.read_revisions()[0].set.loops is None
        history.add_revision(replace(make_published(2), loops={}), [], LATER)
    assert read_newest_parameters(tmp_path, "X")["X"].set.loops == {}
    with OutboxReader(tmp_path) as reader:
        assert [(entry.kind, entry.left_out) for entry in reader.read_entries(0, 9)] == [
            ("loops", ""),
            ("parameters", ""),
        ]


def remove_loops_column(db: sqlite3.Connection) -> None:
    db.row_factory = sqlite3.Row
    db.execute("ALTER TABLE revisions DROP COLUMN loops")
    for row in map(dict, db.execute("SELECT * FROM revisions").fetchall()):
        digest = history_schema.compute_digest("revisions", row)
        db.execute("UPDATE revisions SET digest = ? WHERE id = ?", (digest, row["id"]))
        db.execute("UPDATE outbox SET message = ? WHERE of = 'revisions' AND row = ?", (digest, row["id"]))
    db.execute("PRAGMA user_version = 7")
    db.commit()
