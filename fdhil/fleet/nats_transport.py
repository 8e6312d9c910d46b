"""Connects to JetStream: a connection that lasts until it breaks, and the stream that all machines publish to.

The stream is a queue for the collectors: records in the database are removed from it. When it is full, the server
refuses new records, and the machines keep them.
"""

import asyncio
import binascii
import re
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, NoReturn

import nats.errors
import nats.js.errors
import nkeys
from nats.aio.client import Client, RawCredentials
from nats.js import JetStreamContext
from nats.js.api import AckPolicy, ConsumerConfig, DiscardPolicy, RetentionPolicy, StorageType, StreamConfig

from fdhil.cancellation import GivenUp, run_attempt
from fdhil.config import NatsServer, Stream, create_tls_context, read_password, read_secret
from fdhil.daemon import write_line
from fdhil.errors import ConnectError
from fdhil.fleet.record_message import SUBJECTS

CONSUMER = "collectors"
CONNECT_S = 10
ACKNOWLEDGED_S = 60.0  # unacknowledged messages are then redelivered
MOST_OUT = 20_000  # limit of unacknowledged messages
FIRST_RETRY_S, LAST_RETRY_S = 1.0, 60.0
_SEED = re.compile(r"^SU[A-Z2-7]{56}\s*$", re.MULTILINE)
ERRORS = (nats.errors.Error, OSError, TimeoutError)  # of a server that is unavailable or refuses


async def retry_forever(
    attempt: Callable[[], Coroutine[Any, Any, str]], done: Callable[[], int], complaint: str
) -> NoReturn:
    """Attempt until cancelled, with growing delays while nothing gets ``done``; log each new cause of a failure.

    ``attempt`` returns the cause, ``complaint`` is the log line with a field for it.
    """
    delay_s, logged = FIRST_RETRY_S, ""
    while True:
        before = done()
        try:
            cause = await run_attempt("server", attempt())
        except GivenUp as error:
            cause = str(error)
        if done() > before:
            delay_s, logged = FIRST_RETRY_S, ""
        if cause != logged:
            write_line(complaint.format(cause=cause), "minor")
        logged = cause
        await asyncio.sleep(delay_s)
        delay_s = min(LAST_RETRY_S, 2 * delay_s)


def check_credentials(settings: NatsServer, section: str) -> None:
    """Check the credential files; ConnectError names the one that cannot be used."""
    create_tls_context(settings, "NATS server", section)
    _load_credentials(settings, section)


def _load_credentials(settings: NatsServer, section: str) -> dict[str, Any]:
    secret = read_secret(settings.credentials_file, "NATS server", f"[{section}] credentials_file")
    if secret is None:
        return {"user": settings.user, "password": read_password(settings, "NATS server", section)}
    seeds = _SEED.findall(secret)
    try:
        nkeys.from_seed(bytearray(seeds[0].encode()))
    except (IndexError, nkeys.NkeysError, binascii.Error):
        key = f"[{section}] credentials_file {settings.credentials_file}"
        cause = f"{key} contains no user seed; name a .creds file or a file with the seed (SU...)"
        raise ConnectError("NATS server", cause) from None
    return {"user_credentials": RawCredentials(secret)} if "-----BEGIN" in secret else {"nkeys_seed_str": secret}


@asynccontextmanager
async def connect_to_server(settings: NatsServer, name: str, section: str) -> AsyncIterator[Client]:
    """Connect to a server of the cluster; a broken connection is closed and not restored.

    ERRORS when no server can be reached. Retries are the caller's decision.
    """
    client = Client()
    tls = create_tls_context(settings, "NATS server", section)
    servers = [server.replace("nats://", "tls://") if tls else server for server in settings.servers]
    errors: list[Exception] = []

    async def record_error(error: Exception) -> None:
        errors[:] = [error]

    try:
        await client.connect(
            servers,
            name=name,
            **_load_credentials(settings, section),
            tls=tls,
            allow_reconnect=False,
            max_reconnect_attempts=1,  # otherwise an unavailable server is reported after two minutes only
            reconnect_time_wait=0,
            connect_timeout=CONNECT_S,
            error_cb=record_error,
            inbox_prefix=f"_INBOX_{name}",
            ping_interval=20,
        )
        yield client
    except nats.errors.NoServersError as error:
        raise errors[0] if errors else error from None
    except nats.errors.TimeoutError:
        if client.last_error is not None:  # the server has reported the cause
            raise client.last_error from None
        raise
    finally:
        await client.close()


async def prepare_record_stream(stream: JetStreamContext, settings: Stream) -> JetStreamContext.PullSubscription:
    """Create the stream and its consumer where they do not exist, and return the subscription; ERRORS."""
    wanted = StreamConfig(
        name=settings.name,
        subjects=[SUBJECTS],
        retention=RetentionPolicy.WORK_QUEUE,
        discard=DiscardPolicy.NEW,
        storage=StorageType.FILE,
        max_bytes=settings.max_bytes,
        num_replicas=settings.replicas,
        duplicate_window=settings.duplicate_window_s,
    )
    try:
        await stream.stream_info(settings.name)
        await stream.update_stream(wanted)
    except nats.js.errors.NotFoundError:
        await stream.add_stream(wanted)
    reader = ConsumerConfig(
        durable_name=CONSUMER, ack_policy=AckPolicy.EXPLICIT, ack_wait=ACKNOWLEDGED_S, max_ack_pending=MOST_OUT
    )
    await stream.add_consumer(settings.name, reader)
    return await stream.pull_subscribe_bind(CONSUMER, settings.name)


def describe_cause(error: BaseException) -> str:
    """Return why a server cannot be used, and what to check."""
    text = str(error) or type(error).__name__
    if isinstance(error, nats.js.errors.NoStreamResponseError):
        return "the server has no stream yet; start fdhil fleet collect"
    if "uthorization" in text or "ermissions" in text:
        return f"the server refuses access ({text}); check user, password_file, certificate and permissions"
    if isinstance(error, nats.js.errors.APIError) and error.description:
        return f"the server refuses the request ({error.description})"
    if "SSL" in text or "certificate" in text:
        return f"{text}; check tls_ca_file and the name in its certificate"
    return f"{text}; check server, and that it runs with JetStream"
