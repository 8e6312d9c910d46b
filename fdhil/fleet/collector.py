"""Stores the records of the machines: from JetStream into PostgreSQL and the folder of windows.

A message is acknowledged once it has been committed to the database; an unacknowledged message is delivered again, to
this collector or another. Repeated records are recognised by their message id. Any number of collectors run in
parallel.

Most records are new and are copied straight into the history. If some are there already, the database reports it, the
transaction is rolled back, and all are copied again through a temporary table that leaves known ones out. While the
database writes, the next messages are fetched and decoded.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import islice
from typing import LiteralString, NamedTuple, NoReturn

import psycopg
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.js import JetStreamContext

from fdhil.config import Fleet
from fdhil.daemon import write_line
from fdhil.errors import StoreError
from fdhil.fleet import schema_migrations, window_files
from fdhil.fleet.nats_transport import (
    ERRORS,
    check_credentials,
    connect_to_server,
    describe_cause,
    prepare_record_stream,
    retry_forever,
)
from fdhil.fleet.record_message import Record, UnreadableRecord, decode_message
from fdhil.fleet.schema_migrations import NOTE_INCOMING, NOTE_SHIFTS

BATCH = 100  # messages per transaction
AHEAD = timedelta(days=1)  # tolerated lead of a machine's clock over the server's
WAIT_S = 2.0  # for the first message
_COLUMNS = "machine, message, recorded_at, store, sequence, axis, kind, stored_at, window_name, record"
_INCOMING = "CREATE TEMP TABLE IF NOT EXISTS incoming (LIKE fleet.records) ON COMMIT DELETE ROWS"
_COPY = f"COPY {{}} ({_COLUMNS}) FROM STDIN"
NULL = "\\N"  # in COPY's format
_AT_ONCE = 64  # rows per COPY chunk: the database writes them while the next are formatted
_HEARD = "INSERT INTO fleet.heard AS h (machine, store, records, last_sequence, first_stored_at, last_stored_at)"
_ADD_TO_HEARD = """
ON CONFLICT (machine, store) DO UPDATE SET records = h.records + excluded.records,
  last_sequence = greatest(h.last_sequence, excluded.last_sequence),
  last_stored_at = greatest(h.last_stored_at, excluded.last_stored_at)
"""
_COUNT = f"""
{_HEARD} SELECT * FROM unnest(%s::text[], %s::text[], %s::int8[], %s::int8[], %s::timestamptz[], %s::timestamptz[])
{_ADD_TO_HEARD}
"""
# queried after the rows are written: none can be dropped from then on
_DROPPED = """
SELECT FROM unnest(%s::text[], %s::text[], %s::int8[], %s::int8[]) AS n (machine, store, first, last)
  JOIN fleet.dropped d USING (machine, store) WHERE d.sequences && int8range(n.first, n.last, '[]') LIMIT 1
"""
# ordered, so that two collectors with the same records cannot deadlock
_KEEP = f"""
WITH added AS (
  INSERT INTO fleet.records ({_COLUMNS}) SELECT {_COLUMNS} FROM incoming i
  WHERE NOT EXISTS (SELECT FROM fleet.dropped d
    WHERE (d.machine, d.store) = (i.machine, i.store) AND d.sequences @> i.sequence)
  ORDER BY machine, message, recorded_at
  ON CONFLICT DO NOTHING RETURNING machine, store, sequence, stored_at)
{_HEARD} SELECT machine, store, count(*) FILTER (WHERE sequence > 0), max(sequence), min(stored_at), max(stored_at)
  FROM added GROUP BY machine, store ORDER BY machine, store
{_ADD_TO_HEARD}
"""
_REFUSED = "INSERT INTO fleet.refused (subject, reason, payload) VALUES (%s, %s, %s)"
Known = Sequence[tuple[Record, datetime]]
Aside = Sequence[tuple[str, UnreadableRecord]]


class ReceivedRecord(NamedTuple):
    """One part of a message: a record, or a part that is not a valid record."""

    subject: str
    stored_at: datetime
    content: Record | UnreadableRecord


@dataclass(slots=True)
class StoreCounts:
    """Summary of a machine's history within a batch: number of records, first and last number, times of arrival."""

    first_stored_at: datetime
    last_stored_at: datetime
    records: int = 0
    first: int = 0
    last: int = 0


async def collect_records(fleet: Fleet, ready: Callable[[str], None]) -> NoReturn:
    """Collect until cancelled; while the server or the database is unavailable, retry with growing delays.

    ConnectError where the credential files cannot be used, StoreError where the database's schema is newer or the
    folder of windows cannot be written.
    """
    check_credentials(fleet.server, "server")
    window_files.check_folder(fleet.objects.directory)
    collector = Collector(fleet)
    ready(f"records from {fleet.server.server} into the database '{fleet.database.connection}'")

    async def connect_and_collect() -> str:
        try:
            async with (
                await psycopg.AsyncConnection.connect(fleet.database.connection, autocommit=True) as db,
                connect_to_server(fleet.server, "fdhil-collector", "server") as client,
            ):
                await collector.run(client, db)
        except psycopg.Error as error:
            return f"database: {' '.join(str(error).split())}; check [database] connection and that it is running"
        except StoreError as error:
            if error.code == "SchemaVersion":
                raise
            return str(error)
        except ERRORS as error:
            return f"{fleet.server.server}: {describe_cause(error)}"

    complaint = "no records are collected: {cause}; records wait at the server, retrying"
    await retry_forever(connect_and_collect, lambda: collector.kept, complaint)


class Collector:
    """Reads the stream over successive connections; ``kept`` counts the messages since the start."""

    def __init__(self, fleet: Fleet) -> None:
        self.kept = 0
        self._fleet = fleet
        self._months: set[tuple[int, int]] = set()

    async def run(self, client: Client, db: psycopg.AsyncConnection) -> NoReturn:
        """Collect until a connection breaks: ERRORS, psycopg.Error; StoreError where a window cannot be written."""
        await schema_migrations.upgrade_schema(db)
        await db.execute(_INCOMING)
        reader = await prepare_record_stream(client.jetstream(), self._fleet.stream)
        write_line("connected to the server and the database")
        coming = asyncio.ensure_future(_receive_batch(reader))
        try:
            while True:
                messages, received = await coming
                coming = asyncio.ensure_future(_receive_batch(reader))  # while this batch is written
                await self._store_and_acknowledge(messages, received, db)
                if client.is_closed:
                    raise ConnectionResetError("the connection has ended")
        finally:
            await _return_pending_batch(coming)

    async def _store_and_acknowledge(
        self, messages: Sequence[Msg], received: Sequence[ReceivedRecord], db: psycopg.AsyncConnection
    ) -> None:
        if not messages:
            return
        try:
            await self._store_or_set_aside(received, db)
        except (psycopg.Error, StoreError):
            await _return_messages(messages)
            raise
        for message in messages:
            await message.ack()
        self.kept += len(received)

    async def _store_or_set_aside(self, received: Sequence[ReceivedRecord], db: psycopg.AsyncConnection) -> None:
        """Store all; if the database rejects a record, bisect to find it and store it as unreadable."""
        try:
            await self._write_transaction(received, db)
        except psycopg.DataError as error:
            first, rest = received[: len(received) // 2], received[len(received) // 2 :]
            if first:
                await self._store_or_set_aside(first, db)
                await self._store_or_set_aside(rest, db)
            elif isinstance(record := rest[0].content, Record):
                aside = UnreadableRecord(" ".join(str(error).split()), record.payload)
                await self._write_transaction([rest[0]._replace(content=aside)], db)
            else:
                raise

    async def _write_transaction(self, received: Sequence[ReceivedRecord], db: psycopg.AsyncConnection) -> None:
        known = [
            (_limit_recorded_at(each.content, each.stored_at), each.stored_at)
            for each in received
            if isinstance(each.content, Record)
        ]
        for record, _ in known:
            if record.window is not None and record.window_name is not None:
                window_files.store_window(self._fleet.objects.directory, record.window_name, record.window)
        months = {(record.recorded_at.year, record.recorded_at.month) for record, _ in known} - self._months
        await schema_migrations.add_month_partitions(db, months)
        self._months |= months
        aside = [(each.subject, each.content) for each in received if isinstance(each.content, UnreadableRecord)]
        if not await _copy_new_records(known, aside, db):
            async with db.transaction(), db.cursor() as cursor:
                await _copy_rows(cursor, "incoming", known)
                await cursor.execute(_KEEP)
                await cursor.execute(NOTE_INCOMING)
                await _insert_refused(cursor, aside)
        for subject, unread in aside:
            write_line(f"part of a message of {subject} was refused and stored apart: {unread.reason}", "minor")


def _limit_recorded_at(record: Record, stored_at: datetime) -> Record:
    """Return a record; one dated in the future gets a common date, so that no clock creates partitions at will."""
    return record if record.recorded_at <= stored_at + AHEAD else record._replace(recorded_at=schema_migrations.FUTURE)


async def _copy_new_records(known: Known, aside: Aside, db: psycopg.AsyncConnection) -> bool:
    """Copy new records in one transaction; return False, with nothing written, if any is known or was dropped."""
    counts = _count_by_store(known)
    numbered = [(*source, each.first, each.last) for source, each in counts.items() if each.records]
    with contextlib.suppress(psycopg.errors.UniqueViolation, psycopg.errors.DeadlockDetected):
        async with db.transaction(), db.cursor() as cursor:
            await _copy_rows(cursor, "fleet.records", known)
            rows = [(*source, c.records, c.last, c.first_stored_at, c.last_stored_at) for source, c in counts.items()]
            await cursor.execute(_COUNT, _transpose_rows(rows, 6))
            await cursor.execute(_DROPPED, _transpose_rows(numbered, 4))
            if cursor.rowcount:
                raise psycopg.Rollback
            await cursor.execute(NOTE_SHIFTS, _transpose_rows(_select_newest_sets(known), 3))
            await _insert_refused(cursor, aside)
            return True
    return False


def _count_by_store(known: Known) -> dict[tuple[str, str], StoreCounts]:
    """Return the counts of each history, in one order everywhere, which prevents deadlocks."""
    counts: dict[tuple[str, str], StoreCounts] = {}
    for record, stored_at in known:
        count = counts.get((record.machine, record.store))
        if count is None:
            count = counts[record.machine, record.store] = StoreCounts(stored_at, stored_at)
        count.first_stored_at = min(count.first_stored_at, stored_at)
        count.last_stored_at = max(count.last_stored_at, stored_at)
        if record.sequence > 0:
            count.first = min(count.first, record.sequence) if count.records else record.sequence
            count.last = max(count.last, record.sequence)
            count.records += 1
    return dict(sorted(counts.items()))


def _select_newest_sets(known: Known) -> list[tuple[str, str, datetime]]:
    """Return the keys of the newest set of each axis and shift, in one order everywhere."""
    newest: dict[tuple[str, str, int], tuple[datetime, int, Record]] = {}
    for record, stored_at in known:
        if record.kind == "parameters" and '"revision"' in record.text:
            at = stored_at if record.recorded_at < schema_migrations.FIRST else min(record.recorded_at, stored_at)
            key = record.machine, record.axis, int(at.timestamp() // schema_migrations.SHIFT_S)
            if key not in newest or (stored_at, record.sequence) > newest[key][:2]:
                newest[key] = stored_at, record.sequence, record
    return [(of.machine, of.message, of.recorded_at) for _, (_, _, of) in sorted(newest.items())]


def _transpose_rows(rows: Sequence[tuple[object, ...]], count: int) -> list[list[object]]:
    return [[row[k] for row in rows] for k in range(count)]


async def _copy_rows(cursor: psycopg.AsyncCursor, table: LiteralString, known: Known) -> None:
    rows = _format_copy_rows(known)
    async with cursor.copy(_COPY.format(table)) as into:
        while some := "".join(islice(rows, _AT_ONCE)):
            await into.write(some)


async def _insert_refused(cursor: psycopg.AsyncCursor, aside: Aside) -> None:
    for subject, unread in aside:
        await cursor.execute(_REFUSED, (subject.replace("\x00", ""), unread.reason, unread.payload))


async def _receive_batch(reader: JetStreamContext.PullSubscription) -> tuple[list[Msg], list[ReceivedRecord]]:
    messages, received = await _fetch_messages(reader), list[ReceivedRecord]()
    try:
        for message in messages:
            stored_at = message.metadata.timestamp
            received += [
                ReceivedRecord(message.subject, stored_at, part)
                for part in decode_message(message.subject, message.data)
            ]
            await asyncio.sleep(0)  # let the pending writes proceed
    except asyncio.CancelledError:
        await _return_messages(messages)
        raise
    return messages, received


async def _fetch_messages(reader: JetStreamContext.PullSubscription) -> list[Msg]:
    try:
        return await reader.fetch(BATCH, timeout=WAIT_S)
    except TimeoutError:  # the base class too: the client raises both
        return []


async def _return_pending_batch(coming: asyncio.Future[tuple[list[Msg], list[ReceivedRecord]]]) -> None:
    coming.cancel()
    with contextlib.suppress(asyncio.CancelledError, *ERRORS):
        messages, _ = await coming
        await _return_messages(messages)


async def _return_messages(messages: Sequence[Msg]) -> None:
    for message in messages:
        await message.nak()


def _format_copy_rows(known: Known) -> Iterator[str]:
    """Yield rows in COPY format; the fields of a record other than its text need no escaping."""
    before, stored = None, ""
    for record, stored_at in known:
        if stored_at is not before:  # the parts of a message share one time
            before, stored = stored_at, stored_at.isoformat()
        text = record.text.replace("\\", "\\\\").replace("\t", "\\t").replace("\r", "\\r")
        yield (
            f"{record.machine}\t{record.message}\t{record.recorded_at.isoformat()}\t{record.store}\t{record.sequence}\t"
            f"{record.axis}\t{record.kind}\t{stored}\t{record.window_name or NULL}\t{text}\n"
        )
