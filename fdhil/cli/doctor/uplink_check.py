"""Examines the uplink to the fleet server: outbox, position file, credentials, server. Sends nothing."""

import json
import os
import socket
import time
from collections.abc import Iterator
from datetime import datetime
from urllib.parse import urlsplit

from fdhil.cli.doctor.storage import can_write
from fdhil.cli.doctor.trouble import Trouble
from fdhil.config import MachineConfig, Uplink, create_tls_context, read_password, read_secret
from fdhil.errors import ConnectError, StoreError
from fdhil.store import POSITION_FILE, OutboxPosition, OutboxReader, read_position

PLACE = "uplink"
LONGEST_WAIT_S = 3600.0  # usual at most
CALL_S = 3.0
LARGEST_GREETING = 1 << 16  # bytes


def examine_uplink(config: MachineConfig, offline: bool) -> Iterator[Trouble]:
    """Report what prevents the transfer of records to the fleet server, if there is an [uplink]."""
    if config.uplink is None:
        return
    yield from _examine_folder(config)
    yield from _examine_outbox(config)
    try:
        create_tls_context(config.uplink, "NATS server", "uplink")
        read_password(config.uplink, "NATS server", "uplink")
        read_secret(config.uplink.credentials_file, "NATS server", "[uplink] credentials_file")
    except ConnectError as error:
        yield Trouble.create_from_error("UplinkCredentials", PLACE, error, "nothing is sent")
    if not offline:
        yield from _examine_servers(config.uplink)


def _examine_folder(config: MachineConfig) -> Iterator[Trouble]:
    folder = config.uplink_directory
    base = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not base.is_dir() or (not can_write(base) and base.stat().st_uid == os.getuid()):
        mend = "give the user of fdhil uplink write permission, or correct [uplink] directory"
        yield Trouble("UplinkFolder", PLACE, f"{base} is not writable", "nothing is sent", mend)
    elif (folder / POSITION_FILE).exists() and read_position(folder) == OutboxPosition():
        what = f"{folder / POSITION_FILE} cannot be read, or is damaged"
        means = "the whole outbox is sent again; the server recognises duplicates; nothing is deleted meanwhile"
        yield Trouble("UplinkPosition", PLACE, what, means, "restart fdhil uplink, which rewrites it", False)


def _examine_outbox(config: MachineConfig) -> Iterator[Trouble]:
    try:
        with OutboxReader(config.store.directory) as reader:
            position = reader.resume_from(read_position(config.uplink_directory))
            waiting, first = reader.count_waiting(position.entry), reader.read_entries(position.entry, 1)
            dropped = reader.dropped
    except StoreError as error:
        if error.code in ("SchemaVersion", "OlderCopy"):  # a damaged one is reported for the store
            what, _, mend = str(error).partition(": ")
            yield Trouble("UplinkOutbox", PLACE, what, "nothing is sent", mend)
        return
    since_s = first[0].row.get("wall_s", 0.0) if first else time.time()
    if time.time() - since_s > LONGEST_WAIT_S:
        what = f"{waiting} records are unsent, the oldest since {datetime.fromtimestamp(since_s):%Y-%m-%d %H:%M}"
        mend = "check that fdhil uplink runs (systemctl status fdhil-uplink), and its log"
        yield Trouble("UplinkWaits", PLACE, what, "the fleet server does not have them; the machine keeps them", mend)
    if dropped:
        means = "the fleet server will never get them and counts them as missing; the machine's history has them"
        mend = "raise keep_unsent in [uplink] if the server is often unreachable for long"
        what = f"{dropped} records were deleted unsent, because the outbox exceeded keep_unsent"
        yield Trouble("UplinkDropped", PLACE, what, means, mend, False)


def _examine_servers(settings: Uplink) -> Iterator[Trouble]:
    # a NATS server speaks first, so nothing is sent
    for server in settings.servers:
        means = "nothing is sent through it" + ("; records stay in the outbox" if len(settings.servers) == 1 else "")
        try:
            greeting = _read_greeting(server)
        except (OSError, ValueError) as error:
            what = f"{server} does not answer as a NATS server: {error}"
            mend = "check server in [uplink], the network, and that the server runs"
            yield Trouble("UplinkServer", PLACE, what, means, mend)
            continue
        if not greeting.get("jetstream"):
            mend = "add jetstream {} to the server's configuration"
            yield Trouble("UplinkServer", PLACE, f"{server} runs without JetStream", means, mend)


def _read_greeting(server: str) -> dict[str, object]:
    place = urlsplit(server)
    address = (place.hostname or "", place.port or 4222)
    with socket.create_connection(address, CALL_S) as caller, caller.makefile("rb") as words:
        line = words.readline(LARGEST_GREETING)
    if not line.startswith(b"INFO "):
        raise ValueError("it does not send a NATS greeting")
    greeting = json.loads(line[5:])
    return greeting if isinstance(greeting, dict) else {}
