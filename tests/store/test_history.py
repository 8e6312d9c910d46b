"""The history database: rows are read back, schemas upgraded, damage and refusals reported."""

from __future__ import annotations

import math
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil.errors import StoreError
from fdhil.records import LoopEstimate, Notice, Parameters, Reason, Skill, Verdict, freeze_array
from fdhil.store import history as history_module
from fdhil.store import schema
from fdhil.store.history import HISTORY_FILE_NAME, History
from fdhil.store.newest_sets import read_newest_sets
from fdhil.store.rows import Acknowledgement, Comparison, Stamp, StoredNotice, UsedParameters
from tests.store.made import BENCH, STAMP, outcome, published
from tests.store.made import window as made_window

DRIFTED = Parameters(0.5, 0.005, 0.8, 0.075, 0.01 + 1e-17, 1.0 / 3.0)


def test_a_revision_comes_back_bit_by_bit(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        number = history.add_revision(published(), [4, 5], STAMP)
    with History.read(tmp_path) as history:
        (revision,) = history.revisions()
    assert (revision.number, revision.window_ids, revision.stamp) == (number, (4, 5), STAMP)
    stored, made = revision.set, published()
    assert stored.parameters == made.parameters
    assert stored.covariance.tobytes() == made.covariance.tobytes()
    assert (stored.axis, stored.revision, stored.windows, stored.tick) == ("X", 1, 3, 12_346)
    assert (stored.temperature_c, stored.config_digest) == (21.5, "0123456789abcdef")


@pytest.mark.fault("F9")
def test_the_newest_parameters_are_the_last_written_whatever_the_clock_says(tmp_path: Path) -> None:
    assert read_newest_sets(tmp_path, "X") == {}
    with History.open(tmp_path) as history:
        history.add_revision(published(1, "X", BENCH), [], STAMP)
        history.add_revision(published(1, "Y", BENCH), [], STAMP)
        history.add_revision(published(2, "X", DRIFTED), [], Stamp(0.0, "boot-2", 1))  # booted in 1970
        assert [r.set.revision for r in history.revisions("X")] == [1, 2]
        assert [r.set.revision for r in history.revisions("X", limit=1)] == [2]
    newest = read_newest_sets(tmp_path, "XYZ")
    assert {axis: revision.set.parameters for axis, revision in newest.items()} == {"X": DRIFTED, "Y": BENCH}


def test_windows_keep_verdict_reasons_and_parameters(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_window(outcome(), "w00000007-X.parquet", STAMP)
        history.add_window(outcome(accepted=False, missing="ft"), "", STAMP)
        good, bad = history.windows("X")
        assert history.counts("X") == (1, 1)
        assert history.counts("Y") == (0, 0)
        assert history.last_window_number() == 7
    assert good.accepted
    assert good.parameters is not None
    assert good.parameters["Jt"] == {"value": 0.075, "std": pytest.approx(0.00075)}
    assert bad.reasons == ("MissingStage(cruise): no plateau",)
    assert bad.parameters is not None
    assert bad.parameters["ft"] == {"value": None, "reason": "MissingStage(cruise): no plateau"}
    assert bad.fit_percent == 97.25


def test_skills_and_notices(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_skill(Skill("X", 5, 0.25, 1.5, math.nan, 24.0), STAMP)
        history.add_notice(Notice("LoadChanged", "MAJOR", "Jt rose by 13 %", "X", 9), STAMP)
        (skill,) = history.skills("X")
        assert history.notices() == [StoredNotice(1, Notice("LoadChanged", "MAJOR", "Jt rose by 13 %", "X", 9), STAMP)]
    assert (skill.rms_um, skill.measured_rms_um) == (0.25, 24.0)
    assert np.isnan(skill.delay_ms)


def test_a_notice_comes_back_with_who_answered_for_it(tmp_path: Path) -> None:
    later = Stamp(STAMP.wall_s + 60.0, "boot-2", 1)
    with History.open(tmp_path) as history:
        numbers = [history.add_notice(Notice("BusDown", "MAJOR", f"bus {k}"), STAMP) for k in range(3)]
        given = Acknowledgement(tuple(numbers[:2]), "anna", "plug was out", later)
        history.add_acknowledgement(given)
        history.add_notice(Notice("BusDown", "info", "is back"), STAMP)
    with History.read(tmp_path) as history:
        notices = history.notices()
        assert history.acknowledgements() == [given]
    assert [notice.acknowledged for notice in notices] == [given, given, None, None]
    assert [notice.is_open for notice in notices] == [False, False, True, False]  # info asks for nobody


def test_the_oldest_acknowledgements_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_module, "KEEP_ACKNOWLEDGEMENTS", 2)
    with History.open(tmp_path) as history:
        for number in (1, 2, 3):
            history.add_acknowledgement(Acknowledgement((number,), "anna", "", STAMP))
        assert [given.notices for given in history.acknowledgements()] == [(2,), (3,)]


def test_readers_work_beside_the_writer(tmp_path: Path) -> None:
    with History.open(tmp_path) as writer, History.read(tmp_path) as reader:
        writer.add_revision(published(), [], STAMP)
        assert len(reader.revisions()) == 1


def test_a_read_only_store_is_read_and_its_writer_told(tmp_path: Path) -> None:
    History.open(tmp_path).close()
    with History.read(tmp_path) as history, pytest.raises(StoreError) as error:
        history.add_revision(published(), [], STAMP)
    assert error.value.code == "ReadOnlyStore"


def test_nothing_recorded_yet(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="nothing was recorded") as error:
        History.read(tmp_path)
    assert error.value.code == "NoHistory"


@pytest.mark.fault("F19")
def test_another_schema_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    History.open(tmp_path).close()
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    db.execute("PRAGMA user_version = 99")
    db.close()
    for opened in (History.open, History.read):
        with pytest.raises(StoreError, match="schema 99") as error:
            opened(tmp_path)
        assert error.value.code == "SchemaVersion"


def first_schema(folder: Path) -> None:
    with History.open(folder) as history:
        history.add_revision(published(), [4], STAMP)
        (row,) = history._db.execute("SELECT * FROM revisions").fetchall()
        row = row[: -len(("digest", "terms", "unexplained_um", "warnings", "loops"))]
    (folder / HISTORY_FILE_NAME).unlink()
    db = sqlite3.connect(folder / HISTORY_FILE_NAME)
    db.executescript(schema._FIRST + "PRAGMA user_version = 1;")
    db.execute(f"INSERT INTO revisions VALUES ({', '.join('?' * len(row))})", row)
    db.commit()
    db.close()


@pytest.mark.fault("F19")
def test_an_older_schema_is_brought_up_by_the_writer_and_read_as_it_is(tmp_path: Path) -> None:
    first_schema(tmp_path)
    with History.read(tmp_path) as history:
        assert [r.set.revision for r in history.revisions()] == [1]
        assert history.comparisons("a" * 64, 5) == []
        assert history.acknowledgements() == []
    with History.open(tmp_path) as history:
        assert [r.window_ids for r in history.revisions()] == [(4,)]
        history.add_comparison(comparison(), STAMP)
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    assert db.execute("PRAGMA user_version").fetchone() == (schema.SCHEMA_VERSION,)
    db.close()
    for number in (1, 2):
        copy = sqlite3.connect(tmp_path / f"{HISTORY_FILE_NAME}.schema-{number}")
        assert copy.execute("PRAGMA user_version").fetchone() == (number,)
        assert copy.execute("SELECT revision FROM revisions").fetchall() == [(1,)]
        copy.close()


def test_a_new_history_keeps_no_copy_of_the_nothing_before_it(tmp_path: Path) -> None:
    History.open(tmp_path).close()
    assert [path.name for path in tmp_path.glob("*.schema-*")] == []


def test_a_step_that_another_process_made_meanwhile_is_not_made_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first_schema(tmp_path)
    seen = schema.version_of
    late = iter([True])

    def slow(db: sqlite3.Connection) -> int:
        found = seen(db)
        if next(late, False):
            History.open(tmp_path).close()
        return found

    monkeypatch.setattr(schema, "check_file", lambda *_: schema.SCHEMA_VERSION)
    monkeypatch.setattr(schema, "version_of", slow)
    with History.open(tmp_path) as history:
        assert history.comparisons("a" * 64, 5) == []


def comparison(rms_um: float = 24.2, program: str = "a" * 64) -> Comparison:
    zone = {"start_s": 0.1, "end_s": 0.3, "where": "X 1.0", "line": 2, "max_um": 98.5, "cause": "corner", "std_um": 0.5}
    used = {"X": UsedParameters(7, BENCH), "Y": UsedParameters(0, DRIFTED)}
    return Comparison(program, "part.ngc", "0123456789abcdef", used, rms_um, (zone,))


def test_comparisons_of_a_program_come_back_newest_first(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        for rms_um in (1.0, 2.0, 3.0):
            history.add_comparison(comparison(rms_um), STAMP)
        history.add_comparison(comparison(4.0, "b" * 64), STAMP)
        assert history.comparisons("a" * 64, 2) == [(STAMP, comparison(3.0)), (STAMP, comparison(2.0))]
        assert history.comparisons("c" * 64, 2) == []


def test_the_oldest_comparisons_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_module, "KEEP_COMPARISONS", 2)
    with History.open(tmp_path) as history:
        for rms_um in (1.0, 2.0, 3.0):
            history.add_comparison(comparison(rms_um), STAMP)
        assert [c.rms_um for _, c in history.comparisons("a" * 64, 9)] == [3.0, 2.0]


def test_comparisons_of_a_database_that_refuses_are_told(tmp_path: Path) -> None:
    history = History.open(tmp_path)
    history.close()
    with pytest.raises(StoreError):
        history.comparisons("a" * 64, 2)


@pytest.mark.parametrize(
    "content", [b"this is no database at all, not even nearly" * 100, b"SQLite format 3\0" + b"\xff" * 5000]
)
def test_a_broken_database_is_told(content: bytes, tmp_path: Path) -> None:
    (tmp_path / HISTORY_FILE_NAME).write_bytes(content)
    for opened in (History.open, History.read):
        with pytest.raises(StoreError) as error:
            opened(tmp_path)
        assert error.value.code == "CorruptFile"


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError) as error:
        History.open(tmp_path / "file" / "store")
    assert error.value.code == "ReadOnlyStore"


def test_terms_warnings_and_what_is_unexplained_are_kept(tmp_path: Path) -> None:
    warning = Reason("OneDirection", "all moves are in one direction", "record both")
    made = outcome()
    warned = replace(made, verdict=replace(made.verdict, unexplained_um=1.25, warnings=(warning,)))
    loaded = replace(published(), parameters=BENCH.replace_values(load=2.5), unexplained_um=1.25, warnings=(warning,))
    with History.open(tmp_path) as history:
        history.add_window(warned, "", STAMP)
        history.add_revision(loaded, [1], STAMP)
        (window,), (revision,) = history.windows(), history.revisions()
    assert (window.unexplained_um, window.warnings) == (1.25, ("OneDirection: all moves are in one direction",))
    assert window.friction is not None
    assert window.friction["value"] == pytest.approx(5.0 + 0.05 * window.friction["speed_rad_s"])
    assert revision.set.parameters == BENCH.replace_values(load=2.5)
    assert (revision.set.unexplained_um, revision.set.warnings) == (1.25, (warning,))
    assert read_newest_sets(tmp_path, "X")["X"].set.parameters.get_term("load") == 2.5


def test_the_first_window_of_either_direction_is_known(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        for accepted, direction in ((False, 1), (True, 1), (True, 1), (True, -1)):
            history.add_window(outcome(accepted, of=made_window(direction=direction)), "", STAMP)
        assert {direction: found.number for direction, found in history.first_windows("X").items()} == {1: 2, -1: 4}


def test_what_was_found_of_the_loops_comes_back(tmp_path: Path) -> None:
    verdict = Verdict(True, None, (), 0.75, (Reason("LoopsDiffer", "the speed filter is 1 ms, not 0"),))
    names = ("position_gain_per_s", "speed_filter_s")
    found = LoopEstimate(
        "X", "cascade", names, freeze_array([49.5, 1e-3]), freeze_array(np.diag([0.04, 1e-10])), verdict
    )
    with History.open(tmp_path) as history:
        history.add_loops(found, STAMP)
        ((stamp, stored),) = history.loops("X")
    assert stamp == STAMP
    assert (stored.structure, stored.names, stored.verdict) == ("cascade", names, verdict)
    assert stored.values.tobytes() == found.values.tobytes()
    assert stored.covariance.tobytes() == found.covariance.tobytes()


def test_a_row_that_was_damaged_before_its_schema_was_brought_up_stays_so(tmp_path: Path) -> None:
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    for step in schema._STEPS[:3]:
        db.executescript(step)
    db.execute("PRAGMA user_version = 3")
    db.isolation_level = None
    for _ in range(2):
        schema.insert(
            db, "skills", {"axis": "X", "tick": 5, "rms_um": 0.5, "wall_s": 1.0, "boot": "b", "monotonic_ns": 1}
        )
    db.execute("UPDATE skills SET tick = 6 WHERE id = 2")
    db.close()
    with History.open(tmp_path) as history:
        assert [skill.tick for skill in history.skills()] == [5]
        assert history.put_damaged_aside() == "1 of skills (row 2)"
        assert history.loops() == []


def test_a_reader_that_comes_again_and_again_looks_at_a_whole_file_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with History.open(tmp_path) as history:
        history.add_window(outcome(), "w00000001-X.parquet", STAMP)
    checks: list[bool] = []
    real = schema.check_file

    def counted(*args: Any, pages: bool = True, **more: Any) -> int:
        checks.append(pages)
        return real(*args, pages=pages, **more)

    monkeypatch.setattr(schema, "check_file", counted)
    checked: set[tuple[int, int]] = set()
    for _ in range(2):
        with History.read(tmp_path, checked=checked) as history:
            assert len(history.windows()) == 1
    (tmp_path / HISTORY_FILE_NAME).rename(tmp_path / "aside")
    with History.open(tmp_path):
        checks.clear()
    with History.read(tmp_path, checked=checked) as history:
        assert history.windows() == []
    with History.read(tmp_path):
        pass
    assert checks == [True, True], "a new file is looked at anew, and so is any for who keeps nothing"


LATIN_1 = "/nc/b\udcf6hlen.ngc"  # as Linux hands a Latin-1 file name over


def test_a_text_that_is_no_unicode_is_stored_escaped(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_notice(Notice("ArmRefused", "minor", f"{LATIN_1} cannot be read"), STAMP)
        history.add_comparison(replace(comparison(1.0), name=LATIN_1), STAMP)
        assert [each.notice.text for each in history.notices()] == ["/nc/b\\udcf6hlen.ngc cannot be read"]
        assert [found.name for _, found in history.comparisons("a" * 64, 2)] == ["/nc/b\\udcf6hlen.ngc"]


class Interrupted(BaseException):
    """What ends a thread in the middle of a row."""


def test_whatever_ends_a_row_early_the_next_one_is_stored(tmp_path: Path) -> None:
    fails = [True]

    def also(*_: Any) -> None:
        if fails.pop():
            raise Interrupted

    with History.open(tmp_path, also) as history:
        with pytest.raises(Interrupted):
            history.add_notice(Notice("BusDown", "MAJOR", "lost"), STAMP)
        fails.append(False)
        history.add_notice(Notice("BusDown", "MAJOR", "kept"), STAMP)
        assert [each.notice.text for each in history.notices()] == ["kept"]


def test_what_waits_is_not_displaced_by_news(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        for severity, text in (("MAJOR", "old"), ("minor", "b"), ("MAJOR", "c"), *(("info", str(k)) for k in range(5))):
            history.add_notice(Notice("Tested", severity, text), STAMP)  # type: ignore[arg-type]
        assert [each.notice.text for each in history.notices(limit=2)] == ["b", "c", "3", "4"]


def test_a_locked_history_is_not_read_past_its_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    connect = sqlite3.connect
    History.open(tmp_path).close()
    db = connect(tmp_path / HISTORY_FILE_NAME, isolation_level=None)
    db.execute("PRAGMA journal_mode = DELETE")
    db.execute("BEGIN EXCLUSIVE")
    monkeypatch.setattr("fdhil.store.schema.sqlite3.connect", lambda *a, **k: connect(*a, **{**k, "timeout": 0.0}))
    with pytest.raises(StoreError, match="locked") as error:
        History.read(tmp_path)
    db.close()
    assert error.value.code == "StoreFault"
