"""Many machines: what uplinks and a collector reach beside the bare engines in the same run.

Real nats-server and PostgreSQL (Debian's), on this computer, beside the clients. The bare client publishes each record
as a message of its own, many on their way at once and in no order, which is how a JetStream is measured; and the very
messages that the uplinks send. COPY takes rows that are ready, out of no stream: into the history's own table, with its
key, indexes and partitions, and into one that has none and knows nothing again. The processor's time is that of
clients and servers together; other work on the same computer counts little there, and much in records a second.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import nats.js.errors
import psycopg
from nats.aio.client import Client

from fdhil.config.fleet_config import Database, Fleet, Objects, Server, Stream
from fdhil.fleet import schema_migrations
from fdhil.fleet.collector import _AT_ONCE, _COLUMNS, Collector, _format_copy_rows
from fdhil.fleet.nats_transport import connect_to_server, prepare_record_stream
from fdhil.fleet.record_message import Message, Record, decode_message, encode_entry, join_messages
from fdhil.fleet.record_uplink import BATCH, MESSAGE_BYTES, OutboxSender
from fdhil.store.outbox import POSITION_FILE, OutboxReader
from studies import fleet_day
from studies.fleet_parts import measure_database_s, measure_processor_s
from tests.fleet.servers import NatsServer, Postgres, run_postgres
from tests.fleet.servers import run_nats as nats_server

ROUNDS = 3  # of each way in turn; the best is told, which other work on this computer disturbed the least
TOGETHER = 10_000  # rows in a transaction
IN_FLIGHT = 256  # messages that the bare client has on their way
LISTED = datetime(2027, 1, 15, 8, 0, tzinfo=UTC)


@dataclass
class Way:
    """A way to do the same: the best of its rounds, and the least processor's time, for a record."""

    name: str
    records_a_s: float = 0.0
    processor_us: float = float("inf")

    def line(self, ours: Way) -> str:
        """Return it in words, beside ours."""
        reported = f"{self.records_a_s:8.0f} records/s, {self.processor_us:5.1f} us of processor each: {self.name}"
        if self is ours:
            return reported
        used = self.processor_us / ours.processor_us
        return f"{reported}; ours beside it {ours.records_a_s / self.records_a_s:.2f} (by processor {used:.2f})"


@dataclass
class Bench:
    """What is measured with: servers, a client of each, and the works' configuration."""

    fleet: Fleet
    server: NatsServer
    database: Postgres
    client: Client
    db: psycopg.AsyncConnection

    async def measure(self, way: Way, count: int, work: Callable[[], Awaitable[None]]) -> None:
        """Do it once."""
        used_s, begin_s = self._processor_s(), time.perf_counter()
        await work()
        way.records_a_s = max(way.records_a_s, count / (time.perf_counter() - begin_s))
        way.processor_us = min(way.processor_us, 1e6 * (self._processor_s() - used_s) / count)

    def _processor_s(self) -> float:
        server = self.server._process
        assert server is not None
        return time.process_time() + measure_processor_s(server.pid) + measure_database_s(self.database)

    async def reset_stream(self) -> None:
        """Make the stream again; the old one would know the messages again."""
        with suppress(nats.js.errors.NotFoundError):
            await self.client.jetstream().delete_stream(self.fleet.stream.name)
        await prepare_record_stream(self.client.jetstream(), self.fleet.stream)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--machines", type=int, default=20)
    parser.add_argument("--records", type=int, default=1500)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place, run_postgres() as database, nats_server(Path(place)) as server:
        asyncio.run(run(Path(place), options.machines, options.records, server, database))


async def run(folder: Path, machines: int, records: int, server: NatsServer, database: Postgres) -> None:
    """Print what each way takes."""
    day = fleet_day.make_machine(folder / "day", "day", server.url)
    fleet_day.record_day(day, records)
    configs = fleet_day.copy_machines([day], folder, machines, server.url)
    senders = [OutboxSender(config, config.uplink) for config in configs if config.uplink is not None]
    print(f"{machines} machines with {records} records each; servers and clients on the same computer")
    fleet = Fleet(
        server=Server(server=server.url),
        database=Database(connection=database.connection),
        objects=Objects(directory=folder / "objects"),
        stream=Stream(max_bytes=4 << 30),
    )
    async with (
        connect_to_server(fleet.server, "bench", "server") as client,
        await psycopg.AsyncConnection.connect(database.connection, autocommit=True) as db,
    ):
        bench = Bench(fleet, server, database, client, db)
        await measure_publishing(bench, senders)
        await measure_collecting(bench, senders)


async def measure_publishing(bench: Bench, senders: Sequence[OutboxSender]) -> None:
    """Print what goes into the stream."""
    messages = [message for sender in senders for message in iterate_messages(sender)]
    together = batch_messages(senders)
    gc.freeze()
    ours, each = Way("sent by the uplinks"), Way("by a bare client, each a message of its own")
    same = Way("by a bare client that has the uplinks' messages ready")
    for _ in range(ROUNDS):
        for way, many in ((each, messages), (same, together)):
            await bench.reset_stream()
            await bench.measure(way, len(messages), lambda many=many: publish(bench.client, many))  # type: ignore[misc]
        await bench.reset_stream()
        for sender in senders:
            (sender._folder / POSITION_FILE).unlink(missing_ok=True)
        await bench.measure(ours, len(messages), lambda: send_outboxes(senders))
    print(*(way.line(ours) for way in (ours, each, same)), sep="\n")


async def measure_collecting(bench: Bench, senders: Sequence[OutboxSender]) -> None:
    """Print what goes out of the stream and into the database."""
    messages = [message for sender in senders for message in iterate_messages(sender)]
    together = batch_messages(senders)
    rows = convert_to_rows(together)
    gc.freeze()  # what a collector does not have, and would be looked through again and again
    await schema_migrations.upgrade_schema(bench.db)
    first = datetime.fromtimestamp(fleet_day.MIDNIGHT_S, UTC)
    await schema_migrations.add_month_partitions(bench.db, {(first.year, first.month)})
    await bench.db.execute("CREATE TABLE bare (LIKE fleet.records)")
    ours, same = Way("collected by one collector"), Way("by COPY of ready rows into the history's own table")
    plain = Way("by COPY of ready rows into a table without key and index")
    read = Way("out of JetStream by a bare client, each a message of its own")
    for _ in range(ROUNDS):
        await bench.reset_stream()
        await publish(bench.client, messages)
        await bench.measure(read, len(messages), lambda: take_messages(bench, len(messages)))
        await bench.reset_stream()
        await publish(bench.client, together)
        await bench.db.execute("TRUNCATE bare, fleet.records, fleet.heard")
        await bench.measure(plain, len(rows), lambda: copy_rows(bench.db, "bare", rows))
        await bench.measure(same, len(rows), lambda: copy_rows(bench.db, "fleet.records", rows))
        await bench.db.execute("TRUNCATE fleet.records")
        await bench.measure(ours, len(rows), lambda: collect_all(bench, len(rows)))
    rate_of_both = 1.0 / (1.0 / read.records_a_s + 1.0 / same.records_a_s)
    both = Way("by these two, one after the other", rate_of_both, read.processor_us + same.processor_us)
    print(*(way.line(ours) for way in (ours, read, same, both, plain)), sep="\n")


def iterate_messages(sender: OutboxSender) -> Iterator[Message]:
    """Yield all that a machine has to tell, each record for itself."""
    with OutboxReader(sender._store) as reader:
        for entry in reader.read_entries(0, 10_000_000):
            yield encode_entry(entry, sender.machine, reader.store, None)


def batch_messages(senders: Sequence[OutboxSender]) -> list[Message]:
    """Return the messages that uplinks send."""
    return [message for sender in senders for message, _ in join_messages(iterate_messages(sender), MESSAGE_BYTES)]


def convert_to_rows(messages: Sequence[Message]) -> list[str]:
    """Return what is in messages as a database takes it."""
    reported = [told for message in messages for told in decode_message(message.subject, message.payload)]
    return list(_format_copy_rows([(record, LISTED) for record in reported if isinstance(record, Record)]))


async def publish(client: Client, messages: Sequence[Message]) -> None:
    """Publish as fast as one client can, in any order."""
    stream, left = client.jetstream(), iter(messages)

    async def some() -> None:
        for message in left:
            await stream.publish(message.subject, message.payload, headers={"Nats-Msg-Id": message.identity})

    await asyncio.gather(*(some() for _ in range(IN_FLIGHT)))


async def take_messages(bench: Bench, count: int) -> None:
    """Take messages out of the stream, answer for them, and do nothing with them."""
    reader = await prepare_record_stream(bench.client.jetstream(), bench.fleet.stream)
    while count > 0:
        messages = await reader.fetch(1000, timeout=10)
        for message in messages:
            await message.ack()
        count -= len(messages)


async def send_outboxes(senders: Sequence[OutboxSender]) -> None:
    """Send all outboxes, each over its own connection."""
    async with AsyncExitStack() as stack:
        clients = [
            await stack.enter_async_context(connect_to_server(sender._settings, sender.machine, "uplink"))
            for sender in senders
        ]
        await asyncio.gather(*(send_one(*pair) for pair in zip(senders, clients, strict=True)))


async def send_one(sender: OutboxSender, client: Client) -> None:
    """Send an outbox to its end."""
    stream = client.jetstream()
    while True:
        position, entries = await sender._read_next_entries(stream)
        if entries:
            await sender._send_entries(stream, position, entries, client.max_payload)
        if len(entries) < BATCH:
            return


async def copy_rows(db: psycopg.AsyncConnection, table: str, rows: Sequence[str]) -> None:
    """Copy rows into a table, as many in a transaction as a collector has."""
    statement = f"COPY {table} ({_COLUMNS}) FROM STDIN".encode()
    for first in range(0, len(rows), TOGETHER):
        async with db.transaction(), db.cursor() as cursor, cursor.copy(statement) as into:
            for some in range(first, min(first + TOGETHER, len(rows)), _AT_ONCE):
                await into.write("".join(rows[some : min(some + _AT_ONCE, first + TOGETHER)]))


async def collect_all(bench: Bench, total: int) -> None:
    """Collect until all of it is there."""
    collector = Collector(bench.fleet)
    running = asyncio.create_task(collector.run(bench.client, bench.db))
    for _ in range(100 * 3600):
        if collector.kept >= total or running.done():
            break
        await asyncio.sleep(0.01)
    running.cancel()
    with suppress(asyncio.CancelledError):
        await running


if __name__ == "__main__":
    main()
