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
from fdhil.store import history_database as history_module
from fdhil.store import history_schema
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.history_rows import Acknowledgement, Comparison, StoredNotice, TimeStamp, UsedParameters
from fdhil.store.newest_parameters import read_newest_parameters
from tests.store.sample_records import BENCH, STAMP, make_outcome, make_published
from tests.store.sample_records import make_window as made_window

DRIFTED = Parameters(0.5, 0.005, 0.8, 0.075, 0.01 + 1e-17, 1.0 / 3.0)


def test_revision_is_read_back_bit_identical(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        number = history.add_revision(make_published(), [4, 5], STAMP)
    with History.open_read_only(tmp_path) as history:
        (revision,) = history.read_revisions()
    assert (revision.number, revision.window_ids, revision.stamp) == (number, (4, 5), STAMP)
    stored, made = revision.set, make_published()
    assert stored.parameters == made.parameters
    assert stored.covariance.tobytes() == made.covariance.tobytes()
    assert (stored.axis, stored.revision, stored.windows, stored.tick) == ("X", 1, 3, 12_346)
    assert (stored.temperature_c, stored.config_digest) == (21.5, "0123456789abcdef")


@pytest.mark.fault("F9")
def test_newest_parameters_are_last_written_despite_wrong_clock(tmp_path: Path) -> None:
    assert read_newest_parameters(tmp_path, "X") == {}
    with History.open(tmp_path) as history:
        history.add_revision(make_published(1, "X", BENCH), [], STAMP)
        history.add_revision(make_published(1, "Y", BENCH), [], STAMP)
        history.add_revision(make_published(2, "X", DRIFTED), [], TimeStamp(0.0, "boot-2", 1))  # booted in 1970
        assert [r.set.revision for r in history.read_revisions("X")] == [1, 2]
        assert [r.set.revision for r in history.read_revisions("X", limit=1)] == [2]
    newest = read_newest_parameters(tmp_path, "XYZ")
    assert {axis: revision.set.parameters for axis, revision in newest.items()} == {"X": DRIFTED, "Y": BENCH}


def test_windows_keep_verdict_reasons_and_parameters(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_window(make_outcome(), "w00000007-X.parquet", STAMP)
        history.add_window(make_outcome(accepted=False, missing="ft"), "", STAMP)
        good, bad = history.read_windows("X")
        assert history.count_windows("X") == (1, 1)
        assert history.count_windows("Y") == (0, 0)
        assert history.find_last_window_number() == 7
    assert good.accepted
    assert good.parameters is not None
    assert good.parameters["Jt"] == {"value": 0.075, "std": pytest.approx(0.00075)}
    assert bad.reasons == ("MissingStage(cruise): no plateau",)
    assert bad.parameters is not None
    assert bad.parameters["ft"] == {"value": None, "reason": "MissingStage(cruise): no plateau"}
    assert bad.fit_percent == 97.25


def test_skills_and_notices_are_read_back(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_skill(Skill("X", 5, 0.25, 1.5, math.nan, 24.0), STAMP)
        history.add_notice(Notice("LoadChanged", "MAJOR", "Jt rose by 13 %", "X", 9), STAMP)
        (skill,) = history.read_skills("X")
        assert history.read_notices() == [
            StoredNotice(1, Notice("LoadChanged", "MAJOR", "Jt rose by 13 %", "X", 9), STAMP)
        ]
    assert (skill.rms_um, skill.measured_rms_um) == (0.25, 24.0)
    assert np.isnan(skill.delay_ms)


def test_notice_is_read_with_its_acknowledgement(tmp_path: Path) -> None:
    later = TimeStamp(STAMP.wall_s + 60.0, "boot-2", 1)
    with History.open(tmp_path) as history:
        numbers = [history.add_notice(Notice("BusDown", "MAJOR", f"bus {k}"), STAMP) for k in range(3)]
        given = Acknowledgement(tuple(numbers[:2]), "anna", "plug was out", later)
        history.add_acknowledgement(given)
        history.add_notice(Notice("BusDown", "info", "is back"), STAMP)
    with History.open_read_only(tmp_path) as history:
        notices = history.read_notices()
        assert history.read_acknowledgements() == [given]
    assert [notice.acknowledged for notice in notices] == [given, given, None, None]
    assert [notice.is_open for notice in notices] == [False, False, True, False]  # info asks for nobody


def test_oldest_acknowledgements_are_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_module, "KEEP_ACKNOWLEDGEMENTS", 2)
    with History.open(tmp_path) as history:
        for number in (1, 2, 3):
            history.add_acknowledgement(Acknowledgement((number,), "anna", "", STAMP))
        assert [given.notices for given in history.read_acknowledgements()] == [(2,), (3,)]


def test_readers_work_while_writing(tmp_path: Path) -> None:
    with History.open(tmp_path) as writer, History.open_read_only(tmp_path) as reader:
        writer.add_revision(make_published(), [], STAMP)
        assert len(reader.read_revisions()) == 1


def test_read_only_store_is_read_and_writing_refused(tmp_path: Path) -> None:
    History.open(tmp_path).close()
    with History.open_read_only(tmp_path) as history, pytest.raises(StoreError) as error:
        history.add_revision(make_published(), [], STAMP)
    assert error.value.code == "ReadOnlyStore"


def test_missing_history_is_reported(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="nothing was recorded") as error:
        History.open_read_only(tmp_path)
    assert error.value.code == "NoHistory"


@pytest.mark.fault("F19")
def test_unknown_schema_is_refused_and_left_unchanged(tmp_path: Path) -> None:
    History.open(tmp_path).close()
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    db.execute("PRAGMA user_version = 99")
    db.close()
    for opened in (History.open, History.open_read_only):
        with pytest.raises(StoreError, match="schema 99") as error:
            opened(tmp_path)
        assert error.value.code == "SchemaVersion"


def create_first_schema(folder: Path) -> None:
    with History.open(folder) as history:
        history.add_revision(make_published(), [4], STAMP)
        (row,) = history._db.execute("SELECT * FROM revisions").fetchall()
        row = row[: -len(("digest", "terms", "unexplained_um", "warnings", "loops"))]
    (folder / HISTORY_FILE_NAME).unlink()
    db = sqlite3.connect(folder / HISTORY_FILE_NAME)
    db.executescript(history_schema._FIRST + "PRAGMA user_version = 1;")
    db.execute(f"INSERT INTO revisions VALUES ({', '.join('?' * len(row))})", row)
    db.commit()
    db.close()


@pytest.mark.fault("F19")
def test_older_schema_is_upgraded_by_writer_and_read_unchanged(tmp_path: Path) -> None:
    create_first_schema(tmp_path)
    with History.open_read_only(tmp_path) as history:
        assert [r.set.revision for r in history.read_revisions()] == [1]
        assert history.read_comparisons("a" * 64, 5) == []
        assert history.read_acknowledgements() == []
    with History.open(tmp_path) as history:
        assert [r.window_ids for r in history.read_revisions()] == [(4,)]
        history.add_comparison(make_comparison(), STAMP)
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    assert db.execute("PRAGMA user_version").fetchone() == (history_schema.SCHEMA_VERSION,)
    db.close()
    for number in (1, 2):
        copy = sqlite3.connect(tmp_path / f"{HISTORY_FILE_NAME}.schema-{number}")
        assert copy.execute("PRAGMA user_version").fetchone() == (number,)
        assert copy.execute("SELECT revision FROM revisions").fetchall() == [(1,)]
        copy.close()


def test_new_history_makes_no_upgrade_copy(tmp_path: Path) -> None:
    History.open(tmp_path).close()
    assert [path.name for path in tmp_path.glob("*.schema-*")] == []


def test_upgrade_step_by_another_process_is_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create_first_schema(tmp_path)
    seen = history_schema.read_version
    late = iter([True])

    def slow(db: sqlite3.Connection) -> int:
        found = seen(db)
        if next(late, False):
            History.open(tmp_path).close()
        return found

    monkeypatch.setattr(history_schema, "check_file", lambda *_: history_schema.SCHEMA_VERSION)
    monkeypatch.setattr(history_schema, "read_version", slow)
    with History.open(tmp_path) as history:
        assert history.read_comparisons("a" * 64, 5) == []


def make_comparison(rms_um: float = 24.2, program: str = "a" * 64) -> Comparison:
    zone = {"start_s": 0.1, "end_s": 0.3, "where": "X 1.0", "line": 2, "max_um": 98.5, "cause": "corner", "std_um": 0.5}
    used = {"X": UsedParameters(7, BENCH), "Y": UsedParameters(0, DRIFTED)}
    return Comparison(program, "part.ngc", "0123456789abcdef", used, rms_um, (zone,))


def test_comparisons_of_a_program_are_read_newest_first(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        for rms_um in (1.0, 2.0, 3.0):
            history.add_comparison(make_comparison(rms_um), STAMP)
        history.add_comparison(make_comparison(4.0, "b" * 64), STAMP)
        assert history.read_comparisons("a" * 64, 2) == [(STAMP, make_comparison(3.0)), (STAMP, make_comparison(2.0))]
        assert history.read_comparisons("c" * 64, 2) == []


def test_oldest_comparisons_are_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history_module, "KEEP_COMPARISONS", 2)
    with History.open(tmp_path) as history:
        for rms_um in (1.0, 2.0, 3.0):
            history.add_comparison(make_comparison(rms_um), STAMP)
        assert [c.rms_um for _, c in history.read_comparisons("a" * 64, 9)] == [3.0, 2.0]


def test_database_error_of_comparisons_is_reported(tmp_path: Path) -> None:
    history = History.open(tmp_path)
    history.close()
    with pytest.raises(StoreError):
        history.read_comparisons("a" * 64, 2)


@pytest.mark.parametrize(
    "content", [b"this is no database at all, not even nearly" * 100, b"SQLite format 3\0" + b"\xff" * 5000]
)
def test_broken_database_is_reported(content: bytes, tmp_path: Path) -> None:
    (tmp_path / HISTORY_FILE_NAME).write_bytes(content)
    for opened in (History.open, History.open_read_only):
        with pytest.raises(StoreError) as error:
            opened(tmp_path)
        assert error.value.code == "CorruptFile"


def test_folder_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError) as error:
        History.open(tmp_path / "file" / "store")
    assert error.value.code == "ReadOnlyStore"


def test_terms_warnings_and_residuals_are_stored(tmp_path: Path) -> None:
    warning = Reason("OneDirection", "all moves are in one direction", "record both")
    made = make_outcome()
    warned = replace(made, verdict=replace(made.verdict, unexplained_um=1.25, warnings=(warning,)))
    loaded = replace(
        make_published(), parameters=BENCH.replace_values(load=2.5), unexplained_um=1.25, warnings=(warning,)
    )
    with History.open(tmp_path) as history:
        history.add_window(warned, "", STAMP)
        history.add_revision(loaded, [1], STAMP)
        (window,), (revision,) = history.read_windows(), history.read_revisions()
    assert (window.unexplained_um, window.warnings) == (1.25, ("OneDirection: all moves are in one direction",))
    assert window.friction is not None
    assert window.friction["value"] == pytest.approx(5.0 + 0.05 * window.friction["speed_rad_s"])
    assert revision.set.parameters == BENCH.replace_values(load=2.5)
    assert (revision.set.unexplained_um, revision.set.warnings) == (1.25, (warning,))
    assert read_newest_parameters(tmp_path, "X")["X"].set.parameters.get_term("load") == 2.5


def test_first_window_of_each_direction_is_found(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        for accepted, direction in ((False, 1), (True, 1), (True, 1), (True, -1)):
            history.add_window(make_outcome(accepted, of=made_window(direction=direction)), "", STAMP)
        assert {direction: found.number for direction, found in history.read_first_windows("X").items()} == {
            1: 2,
            -1: 4,
        }


def test_identified_loops_are_read_back(tmp_path: Path) -> None:
    verdict = Verdict(True, None, (), 0.75, (Reason("LoopsDiffer", "the speed filter is 1 ms, not 0"),))
    names = ("position_gain_per_s", "speed_filter_s")
    found = LoopEstimate(
        "X", "cascade", names, freeze_array([49.5, 1e-3]), freeze_array(np.diag([0.04, 1e-10])), verdict
    )
    with History.open(tmp_path) as history:
        history.add_loops(found, STAMP)
        ((stamp, stored),) = history.read_loops("X")
    assert stamp == STAMP
    assert (stored.structure, stored.names, stored.verdict) == ("cascade", names, verdict)
    assert stored.values.tobytes() == found.values.tobytes()
    assert stored.covariance.tobytes() == found.covariance.tobytes()


def test_damaged_row_stays_damaged_after_upgrade(tmp_path: Path) -> None:
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    for step in history_schema._STEPS[:3]:
        db.executescript(step)
    db.execute("PRAGMA user_version = 3")
    db.isolation_level = None
    for _ in range(2):
        history_schema.insert_row(
            db, "skills", {"axis": "X", "tick": 5, "rms_um": 0.5, "wall_s": 1.0, "boot": "b", "monotonic_ns": 1}
        )
    db.execute("UPDATE skills SET tick = 6 WHERE id = 2")
    db.close()
    with History.open(tmp_path) as history:
        assert [skill.tick for skill in history.read_skills()] == [5]
        assert history.quarantine_damaged_rows() == "1 of skills (row 2)"
        assert history.read_loops() == []


def test_repeated_reader_checks_intact_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with History.open(tmp_path) as history:
        history.add_window(make_outcome(), "w00000001-X.parquet", STAMP)
    checks: list[bool] = []
    real = history_schema.check_file

    def counted(*args: Any, pages: bool = True, **more: Any) -> int:
        checks.append(pages)
        return real(*args, pages=pages, **more)

    monkeypatch.setattr(history_schema, "check_file", counted)
    checked: set[tuple[int, int]] = set()
    for _ in range(2):
        with History.open_read_only(tmp_path, checked=checked) as history:
            assert len(history.read_windows()) == 1
    (tmp_path / HISTORY_FILE_NAME).rename(tmp_path / "aside")
    with History.open(tmp_path):
        checks.clear()
    with History.open_read_only(tmp_path, checked=checked) as history:
        assert history.read_windows() == []
    with History.open_read_only(tmp_path):
        pass
    assert checks == [True, True], "a new file is looked at again, and so is any for who keeps nothing"


LATIN_1 = "/nc/b\udcf6hlen.ngc"  # as Linux hands a Latin-1 file name over


def test_invalid_unicode_is_stored_escaped(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        history.add_notice(Notice("ArmRefused", "minor", f"{LATIN_1} cannot be read"), STAMP)
        history.add_comparison(replace(make_comparison(1.0), name=LATIN_1), STAMP)
        assert [each.notice.text for each in history.read_notices()] == ["/nc/b\\udcf6hlen.ngc cannot be read"]
        assert [found.name for _, found in history.read_comparisons("a" * 64, 2)] == ["/nc/b\\udcf6hlen.ngc"]


class Interrupted(BaseException):
    """What ends a thread in the middle of a row."""


def test_next_row_is_stored_after_interrupted_insert(tmp_path: Path) -> None:
    fails = [True]

    def also(*_: Any) -> None:
        if fails.pop():
            raise Interrupted

    with History.open(tmp_path, also) as history:
        with pytest.raises(Interrupted):
            history.add_notice(Notice("BusDown", "MAJOR", "lost"), STAMP)
        fails.append(False)
        history.add_notice(Notice("BusDown", "MAJOR", "kept"), STAMP)
        assert [each.notice.text for each in history.read_notices()] == ["kept"]


def test_unacknowledged_notices_are_not_displaced_by_information(tmp_path: Path) -> None:
    with History.open(tmp_path) as history:
        for severity, text in (("MAJOR", "old"), ("minor", "b"), ("MAJOR", "c"), *(("info", str(k)) for k in range(5))):
            history.add_notice(Notice("Tested", severity, text), STAMP)  # type: ignore[arg-type]
        assert [each.notice.text for each in history.read_notices(limit=2)] == ["b", "c", "3", "4"]


def test_reader_respects_lock_of_history(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    connect = sqlite3.connect
    History.open(tmp_path).close()
    db = connect(tmp_path / HISTORY_FILE_NAME, isolation_level=None)
    db.execute("PRAGMA journal_mode = DELETE")
    db.execute("BEGIN EXCLUSIVE")
    monkeypatch.setattr(
        "fdhil.store.history_schema.sqlite3.connect", lambda *a, **k: connect(*a, **{**k, "timeout": 0.0})
    )
    with pytest.raises(StoreError, match="locked") as error:
        History.open_read_only(tmp_path)
    db.close()
    assert error.value.code == "StoreFault"
