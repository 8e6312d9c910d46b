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
from fdhil.store import schema
from fdhil.store.history import HISTORY_FILE_NAME, History
from fdhil.store.newest_sets import newest_loops, newest_sets, read_newest_sets
from fdhil.store.outbox import Outbox, OutboxReader
from fdhil.store.rows import Stamp
from tests.store.made import STAMP, published

DIGEST = published().config_digest
FOUND = {"structure": "p_pi_pi", "speed_filter_s": 2e-3, "position_ki_per_s2": 0.0}
LATER = Stamp(STAMP.wall_s + 60.0, STAMP.boot, STAMP.monotonic_ns + 60 * 10**9)


def found(*codes: str, accepted: bool = True) -> LoopEstimate:
    verdict = Verdict(accepted, None, (), 0.3, tuple(Reason(code, "72 um") for code in codes))
    return LoopEstimate(
        "X", "p_pi_pi", ("speed_filter_s",), freeze_array([2e-3]), freeze_array(np.array([[1e-10]])), verdict
    )


def test_a_set_comes_back_with_its_loops(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_revision(replace(published(1), loops={"speed_filter_s": 0.002 + 1e-18}), [], STAMP)
        history.add_revision(replace(published(1, "Y"), loops={}), [], STAMP)
        history.add_revision(published(2), [], STAMP)
        assert [r.set.loops for r in history.revisions()] == [{"speed_filter_s": 0.002 + 1e-18}, {}, None]
        assert [r.set.loops for r in history.revisions("X", limit=1)] == [None]
    assert {axis: r.set.loops for axis, r in read_newest_sets(tmp_path, "XYZ").items()} == {"X": None, "Y": {}}


def test_loops_found_after_the_set_take_their_place(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_revision(replace(published(), loops={"speed_kp": 21.0}), [], STAMP)
        history.add_loops(found(DIFFER, accepted=False), LATER)  # they explain nothing
        assert newest_sets(history, "X")["X"].set.loops == {"speed_kp": 21.0}
        history.add_loops(found(DIFFER), LATER)
        assert newest_sets(history, "X")["X"].set.loops == FOUND
        history.add_loops(found(), LATER)  # the configured ones explain as much
        assert newest_sets(history, "X")["X"].set.loops == {}


def test_loops_of_an_earlier_tuning_are_left_out(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_loops(found(DIFFER), STAMP)
        history.add_revision(replace(published(), loops={}), [], LATER)
        assert newest_sets(history, "X")["X"].set.loops == {}
        assert newest_loops(history, "X", DIGEST) is None


def test_an_older_history_opens_and_its_set_is_used_with_the_loops_it_has(tmp_path: Path) -> None:
    with History.open(tmp_path, also=Outbox(Uplink(), tmp_path).enter) as history:
        history.add_loops(found(DIFFER), STAMP)
        history.add_revision(published(), [], LATER)
    with closing(sqlite3.connect(tmp_path / HISTORY_FILE_NAME)) as db:
        before_loops(db)
    assert read_newest_sets(tmp_path, "X")["X"].set.loops == FOUND  # a reader leaves the file as it is
    with History.open(tmp_path) as history:
        assert history.revisions()[0].set.loops is None
        history.add_revision(replace(published(2), loops={}), [], LATER)
    assert read_newest_sets(tmp_path, "X")["X"].set.loops == {}
    with OutboxReader(tmp_path) as reader:
        assert [(entry.kind, entry.left_out) for entry in reader.entries(0, 9)] == [("loops", ""), ("parameters", "")]


def before_loops(db: sqlite3.Connection) -> None:
    db.row_factory = sqlite3.Row
    db.execute("ALTER TABLE revisions DROP COLUMN loops")
    for row in map(dict, db.execute("SELECT * FROM revisions").fetchall()):
        digest = schema.digest_of("revisions", row)
        db.execute("UPDATE revisions SET digest = ? WHERE id = ?", (digest, row["id"]))
        db.execute("UPDATE outbox SET message = ? WHERE of = 'revisions' AND row = ?", (digest, row["id"]))
    db.execute("PRAGMA user_version = 7")
    db.commit()
