"""Records enter the outbox together with the store, in order and bounded; invalid entries are reported."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.cli.doctor.uplink_check import _examine_outbox
from fdhil.errors import ConfigError, StoreError
from fdhil.records import Notice
from fdhil.store import outbox
from fdhil.store.history_database import HISTORY_FILE_NAME, History
from fdhil.store.outbox import OutboxPosition, OutboxReader, read_position, write_position
from tests.bench import bench_document
from tests.fleet.recording_machine import RecordingMachine, write_history


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[RecordingMachine]:
    made = RecordingMachine(write_history(tmp_path, windows="all"))
    yield made
    made.close_store()


@contextmanager
def read_outbox(machine: RecordingMachine) -> Iterator[OutboxReader]:
    with OutboxReader(machine.config.store.directory) as reader:
        yield reader


def change_database(machine: RecordingMachine, statement: str) -> None:
    with closing(sqlite3.connect(machine.config.store.directory / HISTORY_FILE_NAME)) as db, db:
        db.execute(statement)


def test_all_records_enter_outbox_in_order(machine: RecordingMachine) -> None:
    count = machine.record_windows(2)
    with read_outbox(machine) as reader:
        entries = reader.read_entries(0, 1000)
    assert [entry.number for entry in entries] == list(range(1, count + 1))
    of_x = [entry.kind for entry in entries if entry.axis == "X"]
    assert of_x == ["window", "parameters", "skill", "notice"] * 2
    assert entries[0].row["digest"] == entries[0].message
    assert entries[0].with_file


def test_acknowledgement_enters_outbox(machine: RecordingMachine) -> None:
    machine.record_windows(1)
    machine.store.store_acknowledgement({"up_to": 1, "by": "Anna"})
    with read_outbox(machine) as reader:
        assert reader.read_entries(0, 1000)[-1].kind == "acknowledgement"


def test_outbox_is_empty_without_uplink(tmp_path: Path) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(format_toml(bench_document()))
    machine = RecordingMachine(file)
    machine.record_windows(1)
    machine.close_store()
    with read_outbox(machine) as reader:
        assert reader.count_waiting(0) == 0


def test_record_and_outbox_entry_are_written_together(machine: RecordingMachine) -> None:
    machine.record_windows(1)
    when = "BEFORE INSERT ON outbox WHEN NEW.of = 'notices'"
    change_database(machine, f"CREATE TRIGGER refuses {when} BEGIN SELECT RAISE(FAIL, 'no'); END")
    with pytest.raises(AssertionError):
        machine.record_windows(1)  # its notice is refused
    with read_outbox(machine) as reader, History.open_read_only(machine.config.store.directory) as history:
        assert len(history.read_notices()) == 1
        assert [entry.kind for entry in reader.read_entries(0, 1000)].count("notice") == 1
        assert len(history.read_windows()) == 4


@pytest.mark.parametrize(
    ("policy", "sent"),
    [({"windows": "all"}, 12), ({"windows": "refused"}, 4), ({"windows": "some", "every_window": 4}, 4),
     ({"windows": "none"}, 0), ({}, 4)],
)  # fmt: skip
def test_windows_are_sent_by_policy(policy: dict[str, Any], sent: int, tmp_path: Path) -> None:
    machine = RecordingMachine(write_history(tmp_path, **policy))
    machine.record_windows(6)  # every third is refused
    with read_outbox(machine) as reader:
        assert sum(entry.with_file for entry in reader.read_entries(0, 1000)) == sent
    machine.close_store()


@pytest.fixture
def frequent_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "PRUNE_EVERY", 10)


@pytest.mark.parametrize("running", [True, False])
def test_restored_history_copy_gets_new_identity(running: bool, machine: RecordingMachine) -> None:
    machine.record_windows(1)
    history = machine.config.store.directory / HISTORY_FILE_NAME
    shutil.copy(history, history.with_name("backup"))
    machine.record_windows(2)
    with read_outbox(machine) as reader:
        *_, last = reader.read_entries(0, 1000)
        sent = OutboxPosition(reader.store, last.number, last.message)
    write_position(find_folder(machine), sent)
    if running:
        history.with_name("backup").replace(history)
        assert [notice.code for notice in machine.store.store_outcomes([])] == ["StoreReplaced"]
    else:
        machine.close_store()
        history.with_name("backup").replace(history)
        with read_outbox(machine) as reader, pytest.raises(StoreError, match="is an older copy"):
            reader.resume_from(sent)
        assert [trouble.code for trouble in _examine_outbox(machine.config)] == ["UplinkOutbox"]
        assert machine.store.open() == []
    machine.store.store_outcomes([Notice("A", "minor", "after")])
    with read_outbox(machine) as reader:
        assert reader.store != sent.store
        assert reader.resume_from(sent) == OutboxPosition(reader.store)
        assert [(entry.number, entry.row["text"]) for entry in reader.read_entries(0, 1000)] == [(1, "after")]


@pytest.mark.usefixtures("frequent_windows")
def test_sent_entries_are_removed_except_the_last(machine: RecordingMachine) -> None:
    machine.record_windows(3)
    with read_outbox(machine) as reader:
        last = reader.read_entries(0, 1000)[14]
        sent = OutboxPosition(reader.store, last.number, last.message)
    write_position(find_folder(machine), sent)
    machine.record_windows(3)
    with read_outbox(machine) as reader:
        assert reader.read_entries(0, 1)[0].number == last.number
        assert reader.resume_from(read_position(find_folder(machine))) == sent
        assert reader.dropped == 0


def find_folder(machine: RecordingMachine) -> Path:
    folder = machine.config.uplink_directory
    folder.mkdir(exist_ok=True)
    return folder


@pytest.mark.usefixtures("frequent_windows")
def test_full_outbox_drops_and_counts_oldest_entries(tmp_path: Path) -> None:
    machine = RecordingMachine(write_history(tmp_path), keep_unsent=20)
    count = sum(machine.record_windows(1) for _ in range(9))
    with read_outbox(machine) as reader:
        kept = reader.read_entries(0, 5000)
        assert 20 <= len(kept) < 30
        assert kept[-1].number == count
        assert reader.dropped == count - len(kept)
    machine.close_store()


@pytest.mark.usefixtures("frequent_windows")
@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", "{}", '{"entry": "7"}', '{"store": 1, "entry": 3}', '{"entry": 1e9}', "[" * 2000,
     '{"entry": -1}', '{"entry": 9223372036854775808}'],
)  # fmt: skip
def test_damaged_position_restarts_from_beginning(content: str, machine: RecordingMachine) -> None:
    machine.record_windows(1)
    (find_folder(machine) / outbox.POSITION_FILE).write_text(content)
    with read_outbox(machine) as reader:
        assert reader.resume_from(read_position(find_folder(machine))).entry == 0
    machine.record_windows(2)  # which lets go what was sent


def test_position_of_another_history_restarts_from_beginning(machine: RecordingMachine) -> None:
    machine.record_windows(1)
    with read_outbox(machine) as reader:
        third = reader.read_entries(0, 10)[2]
        good = OutboxPosition(reader.store, third.number, third.message)
        assert reader.resume_from(good) == good
        for other in (replace(good, store="0" * 32), replace(good, message="0" * 64)):
            assert reader.resume_from(other) == OutboxPosition(reader.store)


def test_damaged_or_deleted_row_is_reported_as_such(machine: RecordingMachine) -> None:
    machine.record_windows(1)
    change_database(machine, "UPDATE revisions SET ft = 99 WHERE axis = 'X'")
    change_database(machine, "DELETE FROM notices")
    change_database(machine, "UPDATE outbox SET row = 2 WHERE of = 'skills' AND axis = 'X'")
    with read_outbox(machine) as reader:
        reported = {(entry.axis, entry.kind): entry.left_out for entry in reader.read_entries(0, 10)}
    assert reported == {
        ("X", "window"): "",
        ("X", "parameters"): "damaged",
        ("X", "skill"): "damaged",
        ("X", "notice"): "no longer kept",
        ("Y", "window"): "",
        ("Y", "parameters"): "",
        ("Y", "skill"): "",
    }


def test_uplink_settings_do_not_change_machine_digest(tmp_path: Path) -> None:
    """Adding an uplink requires no new commissioning."""
    document = bench_document()
    plain = machine_config.parse_config(document)
    document["uplink"] = {"labels": {"type": "V-800"}}
    assert machine_config.parse_config(document).digest == plain.digest


@pytest.mark.parametrize(
    ("uplink", "told"),
    [
        ({"server": "nats://works.example:4222"}, "tls_ca_file"),
        ({"server": "nats://user:secret@localhost"}, "uplink.server"),
        ({"user": "mill-1"}, "password_file"),
        ({"tls_key_file": "key.pem"}, "tls_certificate_file"),
        ({"machine": "mill 1"}, "uplink.machine"),
        ({"axis_labels": {"Q": {"screw": "A"}}}, "there is no [axis.Q]"),
        ({"labels": {"Type": "V"}}, "uplink.labels"),
    ],
)
def test_invalid_uplink_is_refused(uplink: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError) as error:
        machine_config.parse_config(bench_document() | {"uplink": uplink})
    assert told in str(error.value)


@pytest.fixture
def older_history(tmp_path: Path) -> Path:
    """A machine's file whose store has four rounds recorded without [uplink]."""
    file = write_history(tmp_path, windows="some", every_window=2)
    machine = RecordingMachine(file, quiet=True)
    machine.record_windows(4)
    machine.store.store_acknowledgement({"up_to": 1, "by": "Anna"})
    machine.close_store()
    return file


def test_earlier_records_are_sent_once_in_order(older_history: Path) -> None:
    for _ in range(2):
        machine = RecordingMachine(older_history)
        with read_outbox(machine) as reader:
            entries = reader.read_entries(0, 1000)
        assert [entry.number for entry in entries] == list(range(1, 30))
        assert {entry.left_out for entry in entries} == {""}
        for kind in ("window", "parameters", "skill", "notice"):
            rows = [entry.row["id"] for entry in entries if entry.kind == kind]
            assert rows == sorted(rows)
        assert entries[-1].kind == "acknowledgement"
        whole = [entry.with_file for entry in entries if entry.kind == "window"]
        assert whole == [True, False] * 4
        machine.close_store()
    machine = RecordingMachine(older_history)
    machine.record_windows(1)
    with read_outbox(machine) as reader:
        assert len(reader.read_entries(0, 1000)) == 29 + 7
    machine.close_store()


def test_clock_set_back_does_not_change_order(older_history: Path) -> None:
    config = machine_config.load_config(older_history)
    assert config.uplink is not None
    with closing(sqlite3.connect(config.store.directory / HISTORY_FILE_NAME)) as db:
        db.execute("UPDATE revisions SET wall_s = 1000 - id")
        outbox.Outbox(config.uplink, config.uplink_directory).add_earlier_rows(db)
        rows = db.execute("SELECT row FROM outbox WHERE of = 'revisions' ORDER BY id").fetchall()
    assert rows == sorted(rows)
    assert len(rows) == 8


def test_newest_of_too_many_earlier_records_are_sent(older_history: Path) -> None:
    machine = RecordingMachine(older_history, keep_unsent=5)
    with read_outbox(machine) as reader:
        kinds = [entry.kind for entry in reader.read_entries(0, 1000)]
    assert len(kinds) == 5
    assert kinds[-1] == "acknowledgement"
    machine.close_store()
