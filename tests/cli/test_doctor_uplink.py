"""``fdhil doctor`` examines the uplink without sending."""

from __future__ import annotations

import socket
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from fdhil.cli.doctor.uplink_check import examine_uplink
from fdhil.store import HISTORY_FILE
from fdhil.store.outbox import POSITION_FILE, OutboxPosition, OutboxReader, write_position
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.reserved_port import reserve_port

JETSTREAM = b'INFO {"server_id":"A","jetstream":true}\r\n'


@contextmanager
def start_server(words: bytes) -> Iterator[tuple[str, list[bytes]]]:
    """Answer one client with a server's greeting; yield the server address and the received bytes."""
    sent: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as door:

        def answer() -> None:
            caller, _ = door.accept()
            with caller:
                caller.sendall(words)
                sent.append(caller.recv(100))

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield f"nats://127.0.0.1:{door.getsockname()[1]}", sent
        thread.join(10)


def write_records(folder: Path, **uplink: str) -> RecordingMachine:
    """Return a machine with records that are marked as sent."""
    machine = RecordingMachine(write_history(folder, **uplink))
    machine.record_windows(1)
    machine.config.uplink_directory.mkdir()
    with OutboxReader(machine.config.store.directory) as reader:
        last = reader.read_entries(0, 100)[-1]
        write_position(machine.config.uplink_directory, OutboxPosition(reader.store, last.number, last.message))
    machine.close_store()
    return machine


def list_trouble_codes(machine: RecordingMachine, offline: bool = True) -> list[str]:
    troubles = list(examine_uplink(machine.config, offline))
    assert all(trouble.what and trouble.means and trouble.mend for trouble in troubles)
    return [trouble.code for trouble in troubles]


def execute_sql(machine: RecordingMachine, statement: str) -> None:
    with closing(sqlite3.connect(machine.config.store.directory / HISTORY_FILE)) as db, db:
        db.execute(statement)


def write_old_records(machine: RecordingMachine) -> None:
    (machine.config.uplink_directory / POSITION_FILE).unlink()
    execute_sql(machine, "DELETE FROM outbox WHERE of = 'windows'")
    execute_sql(machine, "UPDATE revisions SET wall_s = 5")  # damaged, with an invalid time


def damage_position(machine: RecordingMachine) -> None:
    (machine.config.uplink_directory / POSITION_FILE).write_text("{")


def replace_folder_by_file(machine: RecordingMachine) -> None:
    (machine.config.uplink_directory / POSITION_FILE).unlink()
    machine.config.uplink_directory.rmdir()
    machine.config.uplink_directory.write_text("")


def drop_records(machine: RecordingMachine) -> None:
    execute_sql(machine, "UPDATE outbox_of SET dropped = 3")


PLANTED: dict[Callable[[RecordingMachine], None], list[str]] = {
    write_old_records: ["UplinkWaits"],
    damage_position: ["UplinkPosition"],
    replace_folder_by_file: ["UplinkFolder"],
    drop_records: ["UplinkDropped"],
}


@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.__name__)
def test_planted_problem_is_reported(plant: Callable[[RecordingMachine], None], tmp_path: Path) -> None:
    machine = write_records(tmp_path)
    assert list_trouble_codes(machine) == []
    plant(machine)
    assert list_trouble_codes(machine) == PLANTED[plant]


def test_unsent_records_are_counted_with_oldest_time(tmp_path: Path) -> None:
    machine = write_records(tmp_path)
    write_old_records(machine)
    (trouble,) = examine_uplink(machine.config, True)
    assert trouble.what == "5 records are unsent, the oldest since 1970-01-01 00:00"


def test_missing_credentials_file_is_reported(tmp_path: Path) -> None:
    assert list_trouble_codes(write_records(tmp_path, user="mill-1", password_file="none")) == ["UplinkCredentials"]


def test_history_without_outbox_is_reported(tmp_path: Path) -> None:
    machine = write_records(tmp_path)
    execute_sql(machine, "DROP TABLE outbox")
    execute_sql(machine, "DROP TABLE outbox_of")
    execute_sql(machine, "ALTER TABLE revisions DROP COLUMN loops")
    execute_sql(machine, "PRAGMA user_version = 6")
    assert list_trouble_codes(machine) == ["UplinkOutbox"]


def test_machine_without_uplink_is_not_examined(tmp_path: Path) -> None:
    machine = write_records(tmp_path)
    write_old_records(machine)
    quiet = machine.config.model_copy(update={"uplink": None})
    assert list(examine_uplink(quiet, False)) == []


@pytest.mark.parametrize(
    ("words", "told"), [(JETSTREAM, ""), (b'INFO {"a":1}\r\n', "JetStream"), (b"220 mail\r\n", "greeting")]
)
def test_server_greeting_is_read_without_sending(words: bytes, told: str, tmp_path: Path) -> None:
    with start_server(words) as (server, sent):
        machine = write_records(tmp_path, server=server)
        troubles = list(examine_uplink(machine.config, False))
    assert [trouble.code for trouble in troubles] == (["UplinkServer"] if told else [])
    assert all(told in trouble.what for trouble in troubles)
    assert sent == [b""]


def test_unreachable_server_is_reported(tmp_path: Path) -> None:
    with reserve_port() as port:
        assert list_trouble_codes(write_records(tmp_path, server=f"nats://127.0.0.1:{port}"), offline=False) == [
            "UplinkServer"
        ]
