"""A flipped bit in stored data is harmless or reported; it never yields other values or undeclared errors."""

from __future__ import annotations

import io
import random
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.errors import RecordingError, StoreError
from fdhil.records import Notice, Parameters, Skill
from fdhil.store import history_schema
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.history_rows import Acknowledgement, Comparison, UsedParameters
from fdhil.store.newest_parameters import read_newest_parameters
from fdhil.store.window_file import decode_window, encode_window
from tests.daemon.simulated_machine import config_of
from tests.store.sample_records import BENCH, STAMP, is_bit_identical, make_outcome, make_published, make_window

TABLES = ("windows", "revisions", "skills", "notices", "comparisons", "acknowledgements")
FLIPS_PER_PAGE = 16


def fill_history(folder: Path, wal: Path | None = None) -> bytes:
    with History.open(folder) as history:
        for k in range(8):
            for axis in "XY":
                history.add_window(
                    make_outcome(accepted=k % 3 > 0, of=make_window(axis=axis)), f"w{k + 1:08d}-{axis}.parquet", STAMP
                )
                history.add_revision(
                    make_published(k + 1, axis, Parameters(0.5 + k, 0.005, 0.8, 0.075, 0.05, 5.0)), [k], STAMP
                )
                history.add_skill(Skill(axis, k, 0.25, 1.5, 0.5, 24.0 + k), STAMP)
                history.add_notice(Notice("LoadChanged", "MAJOR", f"Jt rose by {k} %", axis, k), STAMP)
        zone = {"start_s": 0.1, "end_s": 0.3, "where": "X 1.0", "max_um": 98.5, "cause": "corner", "std_um": 0.5}
        used = {"X": UsedParameters(7, BENCH)}
        for k in range(8):
            history.add_comparison(Comparison("a" * 64, "p.ngc", "0123", used, 1.0 + k, (zone,) * 4), STAMP)
            history.add_acknowledgement(Acknowledgement((k + 1,), "anna", f"seen {k}", STAMP))
        if wal is not None:
            shutil.copytree(folder, wal)
    return (folder / HISTORY_FILE_NAME).read_bytes()


def read_contents(history: History) -> dict[str, list[Any]]:
    return {
        "windows": history.read_windows(),
        "revisions": [(r.number, r.window_ids, r.stamp, r.set.axis, r.set.revision, r.set.parameters, r.set.windows,
                       r.set.tick, r.set.temperature_c, r.set.config_digest, r.set.covariance.tobytes())
                      for r in history.read_revisions()],
        "skills": history.read_skills(),
        "notices": [replace(notice, acknowledged=None) for notice in history.read_notices()],
        "acknowledgements": history.read_acknowledgements(),
        "comparisons": history.read_comparisons("a" * 64, 99),
    }  # fmt: skip


def choose_positions(size: int, page: int, seed: int) -> list[tuple[int, int]]:
    """Return byte and bit: the file's header, then positions in every page, denser in its head."""
    rng = random.Random(seed)
    found = [(byte, rng.randrange(8)) for byte in range(100)]
    for start in range(0, size, page):
        heads = [rng.randrange(80) for _ in range(FLIPS_PER_PAGE // 4)]
        found += [(start + at, rng.randrange(8)) for at in heads + rng.sample(range(page), FLIPS_PER_PAGE)]
    return found


@pytest.mark.usefixtures("long_computation")
@pytest.mark.fault("F17")
def test_flipped_bit_of_a_history_never_changes_records(tmp_path: Path) -> None:
    whole = fill_history(tmp_path)
    with History.open_read_only(tmp_path) as history:
        true = read_contents(history)
    refused, left_out = list[StoreError](), 0
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for byte, bit in choose_positions(len(whole), 4096, 1):
        flipped = bytearray(whole)
        flipped[byte] ^= 1 << bit
        (damaged / HISTORY_FILE_NAME).write_bytes(flipped)
        reported: list[str] = []
        try:
            with History.open_read_only(damaged, reported.append) as history:
                found = read_contents(history)
                missing = {key for key in history._damaged if key[0] in TABLES}
        except StoreError as error:
            refused.append(error)
            continue
        for table in TABLES:
            rest = [row for row in true[table] if row in found[table]]
            assert found[table] == rest, (byte, bit, table)
            assert len(true[table]) - len(rest) == sum(name == table for name, _ in missing), (byte, bit, table)
        left_out += len(reported)
        assert len(reported) == (len(missing) > 0)
    assert len(refused) > 50
    assert all("start the daemon" in str(e) or e.code in ("SchemaVersion", "StoreFault") for e in refused)
    assert left_out > 100


def test_flipped_bit_of_the_log_loses_only_newest_rows(tmp_path: Path) -> None:
    fill_history(tmp_path / "whole", wal=tmp_path / "cut")
    log = (tmp_path / "cut" / f"{HISTORY_FILE_NAME}-wal").read_bytes()
    with History.open_read_only(tmp_path / "whole") as history:
        true = read_contents(history)
    lost = 0
    rng = random.Random(3)
    for byte in [*range(0, 32, 4), *rng.sample(range(32, len(log)), 24)]:
        flipped = bytearray(log)
        flipped[byte] ^= 1 << rng.randrange(8)
        folder = tmp_path / f"at-{byte}"
        shutil.copytree(tmp_path / "cut", folder)
        (folder / f"{HISTORY_FILE_NAME}-wal").write_bytes(flipped)
        (folder / f"{HISTORY_FILE_NAME}-shm").unlink(missing_ok=True)  # a power cut leaves none of it
        try:
            with History.open_read_only(folder) as history:
                found = read_contents(history)
        except StoreError:
            continue
        for table in TABLES:
            assert [row for row in true[table] if row in found[table]] == found[table], (byte, table)
            lost += len(true[table]) - len(found[table])
    assert lost > 0


def test_daemon_starts_after_any_flipped_bit(tmp_path: Path) -> None:
    whole = fill_history(tmp_path / "made")
    for byte, bit in choose_positions(len(whole), 4096, 2)[::37]:
        folder = tmp_path / f"{byte}-{bit}"
        directory = config_of(folder).store.directory
        directory.mkdir(parents=True)
        flipped = bytearray(whole)
        flipped[byte] ^= 1 << bit
        (directory / HISTORY_FILE_NAME).write_bytes(flipped)
        store = OutcomeStore(config_of(folder))
        first = [notice.code for notice in store.open()]
        store.close()
        if "SchemaVersion" in first:
            assert (directory / HISTORY_FILE_NAME).read_bytes() == flipped
            continue
        assert first in ([], ["CorruptFile"])
        again = OutcomeStore(config_of(folder))
        assert again.open() == []
        assert again.store_outcomes([make_published(9), make_outcome()]) == []
        again.close()
        assert read_newest_parameters(directory, "X")["X"].set.parameters == BENCH


def test_damaged_revision_is_reported_and_previous_one_used(tmp_path: Path) -> None:
    fill_history(tmp_path)
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    db.execute("UPDATE revisions SET K = 0.9 WHERE axis = 'X' AND revision = 8")
    db.commit()
    db.close()
    reported: list[str] = []
    assert read_newest_parameters(tmp_path, "X", reported.append)["X"].set.parameters.R == 0.5 + 6
    (sentence,) = reported
    assert "1 of revisions (row 15) damaged and left out" in sentence
    with History.open(tmp_path) as history:
        assert history.quarantine_damaged_rows() == "1 of revisions (row 15)"
        assert history.quarantine_damaged_rows() == ""
        assert history.read_revisions("X", 1)[0].set.revision == 7
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    ((of, row, content),) = db.execute("SELECT of, row, content FROM quarantine").fetchall()
    db.close()
    assert (of, row) == ("revisions", 15)
    assert "0.9" in content


def test_unreadable_row_of_older_schema_is_left_out(tmp_path: Path) -> None:
    db = sqlite3.connect(tmp_path / HISTORY_FILE_NAME)
    db.executescript(history_schema._FIRST + "PRAGMA user_version = 1;")
    row = (1, "X", 1, 0.5, 0.005, 0.8, 0.075, 0.05, 5.0, "[[1.0", 3, "[]", "0123", 5, None, 1.0, "boot", 1)
    db.execute(f"INSERT INTO revisions VALUES ({', '.join('?' * len(row))})", row)
    db.commit()
    db.close()
    reported: list[str] = []
    assert read_newest_parameters(tmp_path, "X", reported.append) == {}
    assert len(reported) == 1
    with History.open(tmp_path) as history:
        assert history.quarantine_damaged_rows() == "1 of revisions (row 1)"


@pytest.mark.parametrize("raw", [True, False])
@pytest.mark.fault("F17")
def test_flipped_bit_of_a_window_is_never_read_as_data(raw: bool) -> None:
    made = make_window(raw=raw)
    whole = encode_window(made, "0123456789abcdef")
    rng = random.Random(3)
    refused = list[str]()
    for byte in [*range(64), *rng.sample(range(len(whole)), 250), *range(len(whole) - 200, len(whole))]:
        flipped = bytearray(whole)
        flipped[byte] ^= 1 << rng.randrange(8)
        try:
            assert is_bit_identical(decode_window(bytes(flipped), "w.parquet"), made)
        except RecordingError as error:
            refused.append(str(error))
    assert len(refused) > 300
    assert all("w.parquet" in sentence for sentence in refused)


def make_parquet(columns: dict[str, Any], **options: Any) -> bytes:
    head = pq.ParquetFile(pa.BufferReader(encode_window(make_window(), "x"))).schema_arrow.metadata
    sink = io.BytesIO()
    pq.write_table(pa.table(columns).replace_schema_metadata(head), sink, **({"compression": "zstd"} | options))
    return sink.getvalue()


def make_large_page(rows: int) -> bytes:
    content = make_parquet({"tick": pa.array(np.arange(rows))}, use_dictionary=False)
    column = pq.ParquetFile(pa.BufferReader(content)).metadata.row_group(0).column(0)
    at = column.data_page_offset + 3  # after the page's type, field 1, and the head of field 2
    length = next(k for k in range(1, 6) if content[at + k - 1] < 0x80)
    largest = b"\xfe" + b"\xff" * (length - 2) + b"\x7f"  # as many bytes as there were
    return content[:at] + largest + content[at + length :]


ZEROS = np.zeros(400_000)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (make_parquet({name: np.zeros(600_000) for name in ("tick", "demand_mm")}), "declares 600000 rows"),
        (make_parquet(dict.fromkeys(("tick", "demand_mm", "x1"), ZEROS)), "columns unknown in windows"),
        (make_parquet({"tick": ZEROS}, use_dictionary=True), "has a dictionary"),
        (make_parquet({"tick": pa.array(["a" * 1000] * 600)}, use_dictionary=False), "does not contain plain numbers"),
        (make_parquet({"tick": pa.array([[0.0] * 1000] * 600)}, use_dictionary=False), "columns unknown in windows"),
        (make_large_page(40_000), "declares"),
    ],
    ids=["rows", "columns", "dictionary", "texts", "lists", "page"],
)
@pytest.mark.fault("G8")
def test_oversized_file_is_refused_before_reading(content: bytes, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def unread(*_: Any, **__: Any) -> None:
        raise AssertionError("the columns were read")

    monkeypatch.setattr(pq.ParquetFile, "read", unread)
    with pytest.raises(RecordingError, match=words):
        decode_window(content)
