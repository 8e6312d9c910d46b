"""Gathers what the machines tell: from JetStream into PostgreSQL and the folder of windows.

A message is answered for when it is in the database for good, so that it is given again, to this collector or another,
where it was not. What is given twice is known by its message id. Any number of collectors work side by side.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import NoReturn

import psycopg
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.js import JetStreamContext

from fdhil.config.fleet import Fleet
from fdhil.daemon import journal
from fdhil.errors import StoreError
from fdhil.fleet import migrations, objects
from fdhil.fleet.message import Record, Unread, decode
from fdhil.fleet.transport import (
    ERRORS,
    cause_of,
    check_credentials,
    connected,
    prepare_stream,
    try_for_good,
)

BATCH = 100  # messages that are committed together
WAIT_S = 2.0  # for the first of them
_COLUMNS = "machine, message, recorded_at, store, sequence, axis, kind, stored_at, window_name, record"
_INCOMING = "CREATE TEMP TABLE IF NOT EXISTS incoming (LIKE fleet.records) ON COMMIT DELETE ROWS"
_COPY = f"COPY incoming ({_COLUMNS}) FROM STDIN"
# in one order everywhere, so that two collectors with the same records wait for each other and never in a circle
_KEEP = f"""
WITH added AS (
  INSERT INTO fleet.records ({_COLUMNS}) SELECT {_COLUMNS} FROM incoming i
  WHERE NOT EXISTS (SELECT FROM fleet.dropped d
    WHERE (d.machine, d.store) = (i.machine, i.store) AND d.sequences @> i.sequence)
  ORDER BY machine, message, recorded_at
  ON CONFLICT DO NOTHING RETURNING machine, store, sequence, stored_at)
INSERT INTO fleet.heard AS h (machine, store, records, last_sequence, first_stored_at, last_stored_at)
  SELECT machine, store, count(*) FILTER (WHERE sequence > 0), max(sequence), min(stored_at), max(stored_at)
  FROM added GROUP BY machine, store ORDER BY machine, store
ON CONFLICT (machine, store) DO UPDATE SET records = h.records + excluded.records,
  last_sequence = greatest(h.last_sequence, excluded.last_sequence),
  last_stored_at = greatest(h.last_stored_at, excluded.last_stored_at)
"""
_REFUSED = "INSERT INTO fleet.refused (subject, reason, payload) VALUES (%s, %s, %s)"
Row = tuple[str | None, ...]


@dataclass(frozen=True, slots=True)
class Received:
    """What one message held at one place: a record, or what is none."""

    subject: str
    stored_at: datetime
    told: Record | Unread


async def collect(fleet: Fleet, ready: Callable[[str], None]) -> NoReturn:
    """Collect until it is cancelled; a server or database that is not there is tried again, later and later.

    ConnectError where the files of the credentials cannot be used, StoreError where the database's schema is newer or
    the folder of windows cannot be written.
    """
    check_credentials(fleet.server, "server")
    objects.check_folder(fleet.objects.directory)
    collector = Collector(fleet)
    ready(f"what machines tell to {fleet.server.server}, into the database '{fleet.database.connection}'")

    async def attempt() -> str:
        try:
            async with (
                await psycopg.AsyncConnection.connect(fleet.database.connection, autocommit=True) as db,
                connected(fleet.server, "fdhil-collector", "server") as client,
            ):
                await collector.run(client, db)
        except psycopg.Error as error:
            return f"the database: {' '.join(str(error).split())}; check [database] connection, and whether it runs"
        except StoreError as error:
            if error.code == "SchemaVersion":
                raise
            return str(error)
        except ERRORS as error:
            return f"{fleet.server.server}: {cause_of(error)}"

    complaint = "nothing is collected: {cause}; it waits at the server, and is tried again"
    await try_for_good(attempt, lambda: collector.kept, complaint)


class Collector:
    """Goes through the stream, over one connection after another; ``kept`` counts the messages since the start."""

    def __init__(self, fleet: Fleet) -> None:
        self.kept = 0
        self._fleet = fleet
        self._months: set[tuple[int, int]] = set()

    async def run(self, client: Client, db: psycopg.AsyncConnection) -> NoReturn:
        """Collect until a connection breaks: ERRORS, psycopg.Error; StoreError where a window cannot be written."""
        await migrations.bring_up(db)
        await db.execute(_INCOMING)
        reader = await prepare_stream(client.jetstream(), self._fleet.stream)
        journal.write_line("the server and the database are there")
        coming = asyncio.ensure_future(_fetch(reader))
        try:
            while True:
                messages = await coming
                coming = asyncio.ensure_future(_fetch(reader))  # while these are written
                await self._take(messages, db)
                if client.is_closed:
                    raise ConnectionResetError("the connection has ended")
        finally:
            await _give_back(coming)

    async def _take(self, messages: Sequence[Msg], db: psycopg.AsyncConnection) -> None:
        """Keep what is in messages, and answer for them."""
        if not messages:
            return
        received = [each for message in messages for each in _received(message)]
        try:
            await self._keep(received, db)
        except (psycopg.Error, StoreError):
            for message in messages:  # another collector may have them at once
                await message.nak()
            raise
        for message in messages:
            await message.ack()
        self.kept += len(received)

    async def _keep(self, received: Sequence[Received], db: psycopg.AsyncConnection) -> None:
        """Write all; where the database does not take one, halve until that one is found, and put it aside."""
        try:
            await self._write(received, db)
        except psycopg.DataError as error:
            first, rest = received[: len(received) // 2], received[len(received) // 2 :]
            if first:
                await self._keep(first, db)
                await self._keep(rest, db)
            elif isinstance(told := rest[0].told, Record):
                aside = Unread(" ".join(str(error).split()), told.payload)
                await self._write([replace(rest[0], told=aside)], db)
            else:
                raise

    async def _write(self, received: Sequence[Received], db: psycopg.AsyncConnection) -> None:
        """Write windows, then records and what is none, in one transaction."""
        known = [(each.told, each.stored_at) for each in received if isinstance(each.told, Record)]
        for record, _ in known:
            if record.window is not None and record.window_name is not None:
                objects.keep(self._fleet.objects.directory, record.window_name, record.window)
        months = {(record.recorded_at.year, record.recorded_at.month) for record, _ in known} - self._months
        await migrations.add_months(db, months)
        self._months |= months
        async with db.transaction(), db.cursor() as cursor:
            async with cursor.copy(_COPY) as rows:
                for record, stored_at in known:
                    await rows.write_row(_row(record, stored_at))
            await cursor.execute(_KEEP)
            for each in received:
                if isinstance(each.told, Unread):
                    values = (each.subject.replace("\x00", ""), each.told.reason, each.told.payload)
                    await cursor.execute(_REFUSED, values)
                    journal.write_line(f"a part of what {each.subject} told is put aside: {each.told.reason}", "minor")


async def _fetch(reader: JetStreamContext.PullSubscription) -> list[Msg]:
    try:
        return await reader.fetch(BATCH, timeout=WAIT_S)
    except TimeoutError:  # the client's own is one, and it does not raise that one alone
        return []


async def _give_back(coming: asyncio.Future[list[Msg]]) -> None:
    """Let another collector have at once what came and is not looked at any more."""
    coming.cancel()
    with contextlib.suppress(asyncio.CancelledError, *ERRORS):
        for message in await coming:
            await message.nak()


def _received(message: Msg) -> list[Received]:
    stored_at = message.metadata.timestamp
    return [Received(message.subject, stored_at, told) for told in decode(message.subject, message.data)]


def _row(record: Record, stored_at: datetime) -> Row:
    """Return a row as texts, which are written three times as fast."""
    return (
        record.machine, record.message, record.recorded_at.isoformat(), record.store, str(record.sequence), record.axis,
        record.kind, stored_at.isoformat(), record.window_name, record.text,
    )  # fmt: skip
