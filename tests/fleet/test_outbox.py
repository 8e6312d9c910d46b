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
from fdhil.cli.demo.toml import to_toml
from fdhil.cli.doctor.uplink import _outbox
from fdhil.errors import ConfigError, StoreError
from fdhil.records import Notice
from fdhil.store import outbox
from fdhil.store.history import HISTORY_FILE_NAME, History
from fdhil.store.outbox import OutboxReader, Position, read_position, write_position
from tests.bench import bench_document
from tests.fleet.machine import Machine, written


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    made = Machine(written(tmp_path, windows="all"))
    yield made
    made.close()


@contextmanager
def reading(machine: Machine) -> Iterator[OutboxReader]:
    with OutboxReader(machine.config.store.directory) as reader:
        yield reader


def change(machine: Machine, statement: str) -> None:
    with closing(sqlite3.connect(machine.config.store.directory / HISTORY_FILE_NAME)) as db, db:
        db.execute(statement)


def test_everything_that_is_recorded_is_entered_in_order(machine: Machine) -> None:
    count = machine.record(2)
    with reading(machine) as reader:
        entries = reader.entries(0, 1000)
    assert [entry.number for entry in entries] == list(range(1, count + 1))
    of_x = [entry.kind for entry in entries if entry.axis == "X"]
    assert of_x == ["window", "parameters", "skill", "notice"] * 2
    assert entries[0].row["digest"] == entries[0].message
    assert entries[0].with_file


def test_an_acknowledgement_is_told_too(machine: Machine) -> None:
    machine.record(1)
    machine.store.store_acknowledgement({"up_to": 1, "by": "Anna"})
    with reading(machine) as reader:
        assert reader.entries(0, 1000)[-1].kind == "acknowledgement"


def test_without_an_uplink_nothing_is_kept_for_one(tmp_path: Path) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(to_toml(bench_document()))
    machine = Machine(file)
    machine.record(1)
    machine.close()
    with reading(machine) as reader:
        assert reader.waiting(0) == 0


def test_neither_is_there_without_the_other(machine: Machine) -> None:
    machine.record(1)
    when = "BEFORE INSERT ON outbox WHEN NEW.of = 'notices'"
    change(machine, f"CREATE TRIGGER refuses {when} BEGIN SELECT RAISE(FAIL, 'no'); END")
    with pytest.raises(AssertionError):
        machine.record(1)  # its notice is refused
    with reading(machine) as reader, History.read(machine.config.store.directory) as history:
        assert len(history.notices()) == 1
        assert [entry.kind for entry in reader.entries(0, 1000)].count("notice") == 1
        assert len(history.windows()) == 4


@pytest.mark.parametrize(
    ("policy", "sent"),
    [({"windows": "all"}, 12), ({"windows": "refused"}, 4), ({"windows": "some", "every_window": 4}, 4),
     ({"windows": "none"}, 0), ({}, 4)],
)  # fmt: skip
def test_windows_are_sent_whole_by_the_policy(policy: dict[str, Any], sent: int, tmp_path: Path) -> None:
    machine = Machine(written(tmp_path, **policy))
    machine.record(6)  # every third is refused
    with reading(machine) as reader:
        assert sum(entry.with_file for entry in reader.entries(0, 1000)) == sent
    machine.close()


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "PRUNE_EVERY", 10)


@pytest.mark.parametrize("running", [True, False])
def test_an_older_copy_of_the_history_is_sent_under_an_identity_of_its_own(running: bool, machine: Machine) -> None:
    machine.record(1)
    history = machine.config.store.directory / HISTORY_FILE_NAME
    shutil.copy(history, history.with_name("backup"))
    machine.record(2)
    with reading(machine) as reader:
        *_, last = reader.entries(0, 1000)
        sent = Position(reader.store, last.number, last.message)
    write_position(folder_of(machine), sent)
    if running:
        history.with_name("backup").replace(history)
        assert [notice.code for notice in machine.store.store_outcomes([])] == ["StoreReplaced"]
    else:
        machine.close()
        history.with_name("backup").replace(history)
        with reading(machine) as reader, pytest.raises(StoreError, match="is an older copy"):
            reader.start(sent)
        assert [trouble.code for trouble in _outbox(machine.config)] == ["UplinkOutbox"]
        assert machine.store.open() == []
    machine.store.store_outcomes([Notice("A", "minor", "after")])
    with reading(machine) as reader:
        assert reader.store != sent.store
        assert reader.start(sent) == Position(reader.store)
        assert [(entry.number, entry.row["text"]) for entry in reader.entries(0, 1000)] == [(1, "after")]


@pytest.mark.usefixtures("often")
def test_what_was_sent_goes_and_the_last_stays_to_be_known_again(machine: Machine) -> None:
    machine.record(3)
    with reading(machine) as reader:
        last = reader.entries(0, 1000)[14]
        sent = Position(reader.store, last.number, last.message)
    write_position(folder_of(machine), sent)
    machine.record(3)
    with reading(machine) as reader:
        assert reader.entries(0, 1)[0].number == last.number
        assert reader.start(read_position(folder_of(machine))) == sent
        assert reader.dropped == 0


def folder_of(machine: Machine) -> Path:
    folder = machine.config.uplink_directory
    folder.mkdir(exist_ok=True)
    return folder


@pytest.mark.usefixtures("often")
def test_when_it_is_full_the_oldest_go_and_are_counted(tmp_path: Path) -> None:
    machine = Machine(written(tmp_path), keep_unsent=20)
    count = sum(machine.record(1) for _ in range(9))
    with reading(machine) as reader:
        kept = reader.entries(0, 5000)
        assert 20 <= len(kept) < 30
        assert kept[-1].number == count
        assert reader.dropped == count - len(kept)
    machine.close()


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", "{}", '{"entry": "7"}', '{"store": 1, "entry": 3}', '{"entry": 1e9}', "[" * 2000,
     '{"entry": -1}', '{"entry": 9223372036854775808}'],
)  # fmt: skip
def test_a_damaged_position_is_the_beginning(content: str, machine: Machine) -> None:
    machine.record(1)
    (folder_of(machine) / outbox.POSITION_FILE).write_text(content)
    with reading(machine) as reader:
        assert reader.start(read_position(folder_of(machine))).entry == 0
    machine.record(2)  # which lets go what was sent


def test_the_position_of_another_file_is_the_beginning(machine: Machine) -> None:
    machine.record(1)
    with reading(machine) as reader:
        third = reader.entries(0, 10)[2]
        good = Position(reader.store, third.number, third.message)
        assert reader.start(good) == good
        for other in (replace(good, store="0" * 32), replace(good, message="0" * 64)):
            assert reader.start(other) == Position(reader.store)


def test_a_row_that_is_damaged_or_gone_is_told_as_that(machine: Machine) -> None:
    machine.record(1)
    change(machine, "UPDATE revisions SET ft = 99 WHERE axis = 'X'")
    change(machine, "DELETE FROM notices")
    change(machine, "UPDATE outbox SET row = 2 WHERE of = 'skills' AND axis = 'X'")
    with reading(machine) as reader:
        told = {(entry.axis, entry.kind): entry.left_out for entry in reader.entries(0, 10)}
    assert told == {
        ("X", "window"): "",
        ("X", "parameters"): "damaged",
        ("X", "skill"): "damaged",
        ("X", "notice"): "no longer kept",
        ("Y", "window"): "",
        ("Y", "parameters"): "",
        ("Y", "skill"): "",
    }


def test_an_uplink_is_not_the_machine(tmp_path: Path) -> None:
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
def test_a_wrong_uplink_is_refused(uplink: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError) as error:
        machine_config.parse_config(bench_document() | {"uplink": uplink})
    assert told in str(error.value)


@pytest.fixture
def older(tmp_path: Path) -> Path:
    """A machine's file whose store has four rounds recorded without [uplink]."""
    file = written(tmp_path, windows="some", every_window=2)
    machine = Machine(file, quiet=True)
    machine.record(4)
    machine.store.store_acknowledgement({"up_to": 1, "by": "Anna"})
    machine.close()
    return file


def test_what_was_recorded_before_is_told_once_in_its_order(older: Path) -> None:
    for _ in range(2):
        machine = Machine(older)
        with reading(machine) as reader:
            entries = reader.entries(0, 1000)
        assert [entry.number for entry in entries] == list(range(1, 30))
        assert {entry.left_out for entry in entries} == {""}
        for kind in ("window", "parameters", "skill", "notice"):
            rows = [entry.row["id"] for entry in entries if entry.kind == kind]
            assert rows == sorted(rows)
        assert entries[-1].kind == "acknowledgement"
        whole = [entry.with_file for entry in entries if entry.kind == "window"]
        assert whole == [True, False] * 4
        machine.close()
    machine = Machine(older)
    machine.record(1)
    with reading(machine) as reader:
        assert len(reader.entries(0, 1000)) == 29 + 7
    machine.close()


def test_a_clock_that_was_set_back_turns_nothing_round(older: Path) -> None:
    config = machine_config.load_config(older)
    assert config.uplink is not None
    with closing(sqlite3.connect(config.store.directory / HISTORY_FILE_NAME)) as db:
        db.execute("UPDATE revisions SET wall_s = 1000 - id")
        outbox.Outbox(config.uplink, config.uplink_directory).begin(db)
        rows = db.execute("SELECT row FROM outbox WHERE of = 'revisions' ORDER BY id").fetchall()
    assert rows == sorted(rows)
    assert len(rows) == 8


def test_of_too_much_from_before_the_newest_is_told(older: Path) -> None:
    machine = Machine(older, keep_unsent=5)
    with reading(machine) as reader:
        kinds = [entry.kind for entry in reader.entries(0, 1000)]
    assert len(kinds) == 5
    assert kinds[-1] == "acknowledgement"
    machine.close()
