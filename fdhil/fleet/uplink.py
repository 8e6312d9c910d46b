"""Sends the outbox of one machine to JetStream: at least once, in its order, for as long as it takes.

A process of its own that reads the store and writes nothing but its position: while the server is away the daemon goes
on as if there were none. One message is on its way at a time, so that none can overtake another; what waits goes
together, many records in one.
"""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from nats.aio.client import Client
from nats.js import JetStreamContext

from fdhil.config import MachineConfig
from fdhil.config.uplink import Uplink
from fdhil.daemon import journal
from fdhil.errors import ConfigError, ConfigFault, StoreError
from fdhil.fleet.delivery import Letterbox
from fdhil.fleet.message import Message, digest_of, joined, of_entry, of_machine
from fdhil.fleet.transport import ERRORS, cause_of, check_credentials, connected, try_for_good
from fdhil.store import WINDOWS_FOLDER
from fdhil.store.atomic import make_folder
from fdhil.store.outbox import Entry, OutboxReader, Position, read_position, write_position

BATCH = 500  # entries that are read and noted as sent together
MESSAGE_BYTES = 60 << 10  # of what goes together; one record may be more, and the smallest stream has room for it
POLL_S = 1.0  # how often the outbox is looked at while it is empty
ANSWER_S = 15.0  # for the server to say that it has a message
HEAD_BYTES = 64 * 1024  # of a message, besides the window


async def send(config: MachineConfig, ready: Callable[[str], None]) -> NoReturn:
    """Send until it is cancelled; a server that is not there is tried again, later and later.

    ConfigError without [uplink], ConnectError where the files of its credentials cannot be used, StoreError where the
    position cannot be noted.
    """
    settings = config.uplink
    if settings is None:
        fault = ConfigFault("uplink", "is missing", "a table [uplink] says to which server this machine's records go")
        raise ConfigError(config.machine.name, [fault])
    check_credentials(settings, "uplink")
    sender = Sender(config, settings)
    ready(f"the records of {config.machine.name}, as {sender.machine}, for the server {settings.server}")

    async def attempt() -> str:
        try:
            async with connected(settings, f"fdhil-{sender.machine}", "uplink") as client:
                await sender.run(client)
        except StoreError as error:
            return str(error)
        except ERRORS as error:
            return f"{settings.server}: {cause_of(error)}"

    complaint = "nothing is sent: {cause}; what is recorded waits, and it is tried again"
    await try_for_good(attempt, lambda: sender.sent, complaint)


class Sender:
    """Goes through the outbox, over one connection after another; ``sent`` counts the entries since the start."""

    def __init__(self, config: MachineConfig, settings: Uplink) -> None:
        """StoreError where the folder of the position cannot be made."""
        self.machine = settings.name_of(config.machine.name)
        self.sent = 0
        self._settings = settings
        self._store = config.store.directory
        self._folder = config.uplink_directory
        self._about = _about(config, settings)
        self._letterbox = Letterbox(config)
        self._checked: set[tuple[int, int]] = set()  # files whose structure was looked at
        try:
            make_folder(self._folder)
        except OSError as error:
            raise StoreError(f"{self._folder} cannot be made: {error.strerror}; check [uplink] directory") from None

    async def run(self, client: Client) -> NoReturn:
        """Send over one connection until it breaks (ERRORS); StoreError where the history cannot be read."""
        stream = client.jetstream()
        caught_up = False
        while True:
            position, entries = await self._next(stream)
            for answer in await self._letterbox.look(stream, position.store):
                await _publish(stream, answer)
                self._letterbox.told(1)
            if entries:
                await self._send(stream, position, entries, client.max_payload)
                continue
            if not caught_up:
                journal.write_line(f"all that was recorded is sent ({self.sent} records since the start)")
                caught_up = True
            if client.is_closed:
                raise ConnectionResetError("the connection has ended")
            await asyncio.sleep(POLL_S)

    async def _next(self, stream: JetStreamContext) -> tuple[Position, list[Entry]]:
        """Return how far it is, and the entries that follow; what the machine is is told first, where that is new."""
        with OutboxReader(self._store, self._checked) as reader:
            position = reader.start(read_position(self._folder))
            entries = reader.entries(position.entry, BATCH)
        about = digest_of(self._about, reader.store)
        if position.about != about:
            await _publish(stream, of_machine(self._about, self.machine, reader.store, time.time()))
            position = replace(position, about=about)
            write_position(self._folder, position)
        return position, entries

    async def _send(self, stream: JetStreamContext, position: Position, entries: Sequence[Entry], most: int) -> None:
        """Send entries in their order, and note how far they are sent, also when one was refused."""
        messages = (self._message(entry, position.store, most) for entry in entries)
        sent = 0
        try:
            for message, count in joined(messages, MESSAGE_BYTES):
                await _publish(stream, message)
                sent += count
        finally:
            if sent:
                self.sent += sent
                last = entries[sent - 1]
                position = replace(position, entry=last.number, message=last.message)
                await asyncio.to_thread(write_position, self._folder, position)  # a disk may take its time

    def _message(self, entry: Entry, store: str, most: int) -> Message:
        window = _window_of(self._store / WINDOWS_FOLDER / Path(entry.row["file"]).name) if entry.with_file else None
        if window is not None and len(window) > most - HEAD_BYTES:
            window = None
        if entry.with_file and window is None:
            row = {**entry.row, "window_left_out": "no longer kept, or larger than the server takes in one message"}
            entry = replace(entry, row=row)
        return of_entry(entry, self.machine, store, window)


def _window_of(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:  # the oldest go first
        return None


async def _publish(stream: JetStreamContext, message: Message) -> None:
    headers = {"Nats-Msg-Id": message.identity}
    await stream.publish(message.subject, message.payload, timeout=ANSWER_S, headers=headers)


def _about(config: MachineConfig, settings: Uplink) -> dict[str, Any]:
    return {
        "name": config.machine.name,
        "axes": list(config.axis),
        "sync_period_s": config.machine.sync_period_s,
        "config_digest": config.digest,
        "maintenance": config.maintenance.model_dump(),
        "labels": dict(settings.labels),
        "axis_labels": {axis: dict(labels) for axis, labels in settings.axis_labels.items()},
    }
