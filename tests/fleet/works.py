"""A database with the records of many machines, stored by the collector itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psycopg

from fdhil.config import MachineConfig
from fdhil.config.fleet_config import Database, Fleet, Objects
from fdhil.fleet import migrations
from fdhil.fleet.collector import _INCOMING, Collector, Received
from fdhil.fleet.message import Message, Record, decode, of_entry, of_machine
from fdhil.fleet.uplink import _about
from fdhil.store import WINDOWS_FOLDER
from fdhil.store.outbox import OutboxReader
from tests.fleet.machine import Machine
from tests.fleet.servers import Postgres

STORED = datetime(2027, 1, 15, 8, 0, tzinfo=UTC)


def fleet_of(database: Postgres, folder: Path) -> Fleet:
    """Return the fleet server's configuration."""
    return Fleet(database=Database(connection=database.connection), objects=Objects(directory=folder / "objects"))


def told_by(machine: Machine, with_windows: bool = False) -> list[Message]:
    """Return the messages of a machine's uplink, with or without recorded windows."""
    return told_by_store(machine.config, with_windows)


def told_by_store(config: MachineConfig, with_windows: bool = False) -> list[Message]:
    """Return the messages of a machine's store."""
    settings = config.uplink
    assert settings is not None
    name = settings.get_plant_name(config.machine.name)
    with OutboxReader(config.store.directory) as reader:
        windows = {
            entry.number: (config.store.directory / WINDOWS_FOLDER / entry.row["file"]).read_bytes()
            for entry in reader.entries(0, 10_000 if with_windows else 0)
            if entry.with_file
        }
        entries = [
            of_entry(entry, name, reader.store, windows.get(entry.number)) for entry in reader.entries(0, 10_000)
        ]
        return [of_machine(_about(config, settings), name, reader.store, 1_800_000_000.0), *entries]


async def gather(fleet: Fleet, messages: Iterable[Message]) -> None:
    """Collect messages into the database, one per second of the server's clock."""
    await keep(fleet, received_of(messages))


def received_of(messages: Iterable[Message]) -> list[Received]:
    """Return messages in the form in which a collector receives them."""
    return [
        Received(message.subject, STORED + timedelta(seconds=k), told)
        for k, message in enumerate(messages)
        for told in decode(message.subject, message.payload)
    ]


async def keep(fleet: Fleet, received: Sequence[Received]) -> None:
    async with await psycopg.AsyncConnection.connect(fleet.database.connection, autocommit=True) as db:
        await migrations.bring_up(db)
        await db.execute(_INCOMING)
        await Collector(fleet)._keep(received, db)


def told_at(received: Received, at: datetime, stored: datetime | None = None) -> Received:
    """Return a received record with another time of recording, stored then or later."""
    assert isinstance(received.content, Record)
    return received._replace(stored_at=stored or at, content=received.content._replace(recorded_at=at))


def at_days(machine: Machine, begin: datetime) -> list[Received]:
    """Return a machine's records, one round per day."""
    received, windows = [], Counter[str]()
    for each in received_of(told_by(machine)):
        assert isinstance(each.content, Record)
        windows[each.content.axis] += each.content.kind == "window"
        received.append(told_at(each, begin + timedelta(days=max(windows[each.content.axis] - 1, 0))))
    return received
