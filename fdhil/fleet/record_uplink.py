"""Sends the outbox of one machine to JetStream: at least once, in order, for as long as it takes.

A separate process that reads the store and writes only its position: the daemon runs independently of the server. One
message is in flight at a time, so that none overtakes another; waiting records are joined into one message.
"""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from nats.aio.client import Client
from nats.js import JetStreamContext

from fdhil.config import MachineConfig, Uplink
from fdhil.daemon import write_line
from fdhil.errors import ConfigError, ConfigFault, StoreError
from fdhil.fleet.nats_transport import ERRORS, check_credentials, connect_to_server, describe_cause, retry_forever
from fdhil.fleet.offer_delivery import OfferFetcher
from fdhil.fleet.record_message import Message, compute_digest, encode_entry, encode_machine, join_messages
from fdhil.store import (
    WINDOWS_FOLDER,
    OutboxEntry,
    OutboxPosition,
    OutboxReader,
    make_folder,
    read_position,
    write_position,
)

BATCH = 500  # entries per read and per stored position
MESSAGE_BYTES = 60 << 10  # of a joined message; a single larger record still fits the smallest stream
POLL_S = 1.0  # polling interval of an empty outbox
ANSWER_S = 15.0  # for the server's acknowledgement
HEAD_BYTES = 64 * 1024  # of a message without its window


async def send_records(config: MachineConfig, ready: Callable[[str], None]) -> NoReturn:
    """Send until cancelled; while the server is unavailable, retry with growing delays.

    ConfigError without [uplink], ConnectError where its credential files cannot be used, StoreError where the position
    cannot be stored.
    """
    settings = config.uplink
    if settings is None:
        fault = ConfigFault("uplink", "is missing", "add a table [uplink] that names the server")
        raise ConfigError(config.machine.name, [fault])
    check_credentials(settings, "uplink")
    sender = OutboxSender(config, settings)
    ready(f"records of {config.machine.name}, as {sender.machine}, to the server {settings.server}")

    async def connect_and_send() -> str:
        try:
            async with connect_to_server(settings, f"fdhil-{sender.machine}", "uplink") as client:
                await sender.run(client)
        except StoreError as error:
            return str(error)
        except ERRORS as error:
            return f"{settings.server}: {describe_cause(error)}"

    complaint = "no records are sent: {cause}; records wait in the outbox, retrying"
    await retry_forever(connect_and_send, lambda: sender.sent, complaint)


class OutboxSender:
    """Sends the outbox over successive connections; ``sent`` counts the entries since the start."""

    def __init__(self, config: MachineConfig, settings: Uplink) -> None:
        """StoreError where the folder of the position cannot be made."""
        self.machine = settings.get_plant_name(config.machine.name)
        self.sent = 0
        self._settings = settings
        self._store = config.store.directory
        self._folder = config.uplink_directory
        self._about = _describe_machine(config, settings)
        self._letterbox = OfferFetcher(config)
        self._checked: set[tuple[int, int]] = set()  # files whose structure was checked
        try:
            make_folder(self._folder)
        except OSError as error:
            raise StoreError(f"{self._folder} cannot be created: {error.strerror}; check [uplink] directory") from None

    async def run(self, client: Client) -> NoReturn:
        """Send over one connection until it breaks (ERRORS); StoreError where the history cannot be read."""
        stream = client.jetstream()
        caught_up = False
        while True:
            position, entries = await self._read_next_entries(stream)
            for answer in await self._letterbox.fetch_offers(stream, position.store):
                await _publish_message(stream, answer)
                self._letterbox.count_reported_answers(1)
            if entries:
                await self._send_entries(stream, position, entries, client.max_payload)
                continue
            if not caught_up:
                write_line(f"all records are sent ({self.sent} since the start)")
                caught_up = True
            if client.is_closed:
                raise ConnectionResetError("the connection has ended")
            await asyncio.sleep(POLL_S)

    async def _read_next_entries(self, stream: JetStreamContext) -> tuple[OutboxPosition, list[OutboxEntry]]:
        """Return the position and the entries after it; a new description of the machine is sent first."""
        with OutboxReader(self._store, self._checked) as reader:
            position = reader.resume_from(read_position(self._folder))
            entries = reader.read_entries(position.entry, BATCH)
        about = compute_digest(self._about, reader.store)
        if position.about != about:
            await _publish_message(stream, encode_machine(self._about, self.machine, reader.store, time.time()))
            position = replace(position, about=about)
            write_position(self._folder, position)
        return position, entries

    async def _send_entries(
        self, stream: JetStreamContext, position: OutboxPosition, entries: Sequence[OutboxEntry], most: int
    ) -> None:
        """Send entries in order and store the position reached, also when one was refused."""
        messages = (self._build_message(entry, position.store, most) for entry in entries)
        sent = 0
        try:
            for message, count in join_messages(messages, MESSAGE_BYTES):
                await _publish_message(stream, message)
                sent += count
        finally:
            if sent:
                self.sent += sent
                last = entries[sent - 1]
                position = replace(position, entry=last.number, message=last.message)
                await asyncio.to_thread(write_position, self._folder, position)  # a disk may be slow

    def _build_message(self, entry: OutboxEntry, store: str, most: int) -> Message:
        window = _read_window(self._store / WINDOWS_FOLDER / Path(entry.row["file"]).name) if entry.with_file else None
        if window is not None and len(window) > most - HEAD_BYTES:
            window = None
        if entry.with_file and window is None:
            row = {**entry.row, "window_left_out": "no longer kept, or larger than the server's message limit"}
            entry = replace(entry, row=row)
        return encode_entry(entry, self.machine, store, window)


def _read_window(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:  # deleted: the oldest windows go first
        return None


async def _publish_message(stream: JetStreamContext, message: Message) -> None:
    headers = {"Nats-Msg-Id": message.identity}
    await stream.publish(message.subject, message.payload, timeout=ANSWER_S, headers=headers)


def _describe_machine(config: MachineConfig, settings: Uplink) -> dict[str, Any]:
    return {
        "name": config.machine.name,
        "axes": list(config.axis),
        "sync_period_s": config.machine.sync_period_s,
        "config_digest": config.digest,
        "maintenance": config.maintenance.model_dump(),
        "labels": dict(settings.labels),
        "axis_labels": {axis: dict(labels) for axis, labels in settings.axis_labels.items()},
    }
