"""A database with the records of many machines, stored by the collector itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psycopg

from fdhil.config import MachineConfig
from fdhil.config.fleet_config import Database, Fleet, Objects
from fdhil.fleet import schema_migrations
from fdhil.fleet.collector import _INCOMING, Collector, ReceivedRecord
from fdhil.fleet.record_message import Message, Record, decode_message, encode_entry, encode_machine
from fdhil.fleet.record_uplink import _describe_machine
from fdhil.store import WINDOWS_FOLDER
from fdhil.store.outbox import OutboxReader
from tests.fleet.recording_machine import RecordingMachine
from tests.fleet.servers import Postgres

STORED = datetime(2027, 1, 15, 8, 0, tzinfo=UTC)


def build_fleet(database: Postgres, folder: Path) -> Fleet:
    """Return the fleet server's configuration."""
    return Fleet(database=Database(connection=database.connection), objects=Objects(directory=folder / "objects"))


def list_messages(machine: RecordingMachine, with_windows: bool = False) -> list[Message]:
    """Return the messages of a machine's uplink, with or without recorded windows."""
    return list_messages_of_store(machine.config, with_windows)


def list_messages_of_store(config: MachineConfig, with_windows: bool = False) -> list[Message]:
    """Return the messages of a machine's store."""
    settings = config.uplink
    assert settings is not None
    name = settings.get_plant_name(config.machine.name)
    with OutboxReader(config.store.directory) as reader:
        windows = {
            entry.number: (config.store.directory / WINDOWS_FOLDER / entry.row["file"]).read_bytes()
            for entry in reader.read_entries(0, 10_000 if with_windows else 0)
            if entry.with_file
        }
        entries = [
            encode_entry(entry, name, reader.store, windows.get(entry.number))
            for entry in reader.read_entries(0, 10_000)
        ]
        return [encode_machine(_describe_machine(config, settings), name, reader.store, 1_800_000_000.0), *entries]


async def collect_messages(fleet: Fleet, messages: Iterable[Message]) -> None:
    """Collect messages into the database, one per second of the server's clock."""
    await store_records(fleet, decode_messages(messages))


def decode_messages(messages: Iterable[Message]) -> list[ReceivedRecord]:
    """Return messages in the form in which a collector receives them."""
    return [
        ReceivedRecord(message.subject, STORED + timedelta(seconds=k), told)
        for k, message in enumerate(messages)
        for told in decode_message(message.subject, message.payload)
    ]


async def store_records(fleet: Fleet, received: Sequence[ReceivedRecord]) -> None:
    async with await psycopg.AsyncConnection.connect(fleet.database.connection, autocommit=True) as db:
        await schema_migrations.upgrade_schema(db)
        await db.execute(_INCOMING)
        await Collector(fleet)._store_or_set_aside(received, db)


def set_recorded_at(received: ReceivedRecord, at: datetime, stored: datetime | None = None) -> ReceivedRecord:
    """Return a received record with another time of recording, stored then or later."""
    assert isinstance(received.content, Record)
    return received._replace(stored_at=stored or at, content=received.content._replace(recorded_at=at))


def spread_over_days(machine: RecordingMachine, begin: datetime) -> list[ReceivedRecord]:
    """Return a machine's records, one round per day."""
    received, windows = [], Counter[str]()
    for each in decode_messages(list_messages(machine)):
        assert isinstance(each.content, Record)
        windows[each.content.axis] += each.content.kind == "window"
        received.append(set_recorded_at(each, begin + timedelta(days=max(windows[each.content.axis] - 1, 0))))
    return received
