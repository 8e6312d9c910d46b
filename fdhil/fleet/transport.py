"""The way to JetStream: a connection that lasts until it breaks, and the stream that all machines publish into.

The stream is a queue for one reader, the collectors: what is in the database goes from it. When it is full, the server
refuses what is new, and the machines keep it.
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
from fdhil.config.credentials import password_of, secret_in, tls_of
from fdhil.config.fleet import Stream
from fdhil.config.uplink import NatsServer
from fdhil.daemon import journal
from fdhil.errors import ConnectError
from fdhil.fleet.message import SUBJECTS

CONSUMER = "collectors"
CONNECT_S, CLOSE_S = 10, 5.0
ACKNOWLEDGED_S = 60.0  # what a collector has not answered for by then is given to another
MOST_OUT = 20_000  # messages that collectors have and did not answer for yet
FIRST_RETRY_S, LAST_RETRY_S = 1.0, 60.0
_SEED = re.compile(r"^SU[A-Z2-7]{56}\s*$", re.MULTILINE)
ERRORS = (nats.errors.Error, OSError, TimeoutError)  # of a server that is not there, or does not do what it is asked


async def try_for_good(
    attempt: Callable[[], Coroutine[Any, Any, str]], done: Callable[[], int], complaint: str
) -> NoReturn:
    """Attempt until it is cancelled, later and later while nothing gets ``done``; a new cause of a failure is told.

    ``attempt`` returns the cause, ``complaint`` has a place for it.
    """
    delay_s, told = FIRST_RETRY_S, ""
    while True:
        before = done()
        try:
            cause = await run_attempt("server", attempt())
        except GivenUp as error:
            cause = str(error)
        if done() > before:
            delay_s, told = FIRST_RETRY_S, ""
        if cause != told:
            journal.write_line(complaint.format(cause=cause), "minor")
        told = cause
        await asyncio.sleep(delay_s)
        delay_s = min(LAST_RETRY_S, 2 * delay_s)


def check_credentials(settings: NatsServer, section: str) -> None:
    """Read the files of the credentials; ConnectError names the one that cannot be used."""
    tls_of(settings, "NATS server", section)
    _proof_of(settings, section)


def _proof_of(settings: NatsServer, section: str) -> dict[str, Any]:
    """Return how we prove who we are, as the client wants it; ConnectError."""
    secret = secret_in(settings.credentials_file, "NATS server", f"[{section}] credentials_file")
    if secret is None:
        return {"user": settings.user, "password": password_of(settings, "NATS server", section)}
    seeds = _SEED.findall(secret)
    try:
        nkeys.from_seed(bytearray(seeds[0].encode()))
    except (IndexError, nkeys.NkeysError, binascii.Error):
        told = f"[{section}] credentials_file {settings.credentials_file}"
        cause = f"{told} holds no user's seed; a .creds file does, or the seed alone (SU...)"
        raise ConnectError("NATS server", cause) from None
    return {"user_credentials": RawCredentials(secret)} if "-----BEGIN" in secret else {"nkeys_seed_str": secret}


@asynccontextmanager
async def connected(settings: NatsServer, name: str, section: str) -> AsyncIterator[Client]:
    """Enter the server, or one of its cluster; when the connection breaks it is closed and stays so.

    ERRORS when none can be entered; when to try again is not the client's to decide.
    """
    client = Client()
    tls = tls_of(settings, "NATS server", section)
    servers = [server.replace("nats://", "tls://") if tls else server for server in settings.servers]
    heard: list[Exception] = []

    async def hear(error: Exception) -> None:
        heard[:] = [error]

    try:
        await client.connect(
            servers,
            name=name,
            **_proof_of(settings, section),
            tls=tls,
            allow_reconnect=False,
            max_reconnect_attempts=1,  # else one that is not there is tried for two minutes before it is told
            reconnect_time_wait=0,
            connect_timeout=CONNECT_S,
            error_cb=hear,
            inbox_prefix=f"_INBOX_{name}",
            ping_interval=20,
        )
        yield client
    except nats.errors.NoServersError as error:
        raise heard[0] if heard else error from None
    except nats.errors.TimeoutError:
        if client.last_error is not None:  # the server has said why it does not answer
            raise client.last_error from None
        raise
    finally:
        await client.close()


async def prepare_stream(stream: JetStreamContext, settings: Stream) -> JetStreamContext.PullSubscription:
    """Make the stream and its reader where there are none, and return the reader; ERRORS."""
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


def cause_of(error: BaseException) -> str:
    """Return why a server cannot be used, and what to look at."""
    text = str(error) or type(error).__name__
    if isinstance(error, nats.js.errors.NoStreamResponseError):
        return "it has no stream yet; start fdhil fleet collect"
    if "uthorization" in text or "ermissions" in text:
        return f"it refuses us ({text}); check user, password_file and certificate, and what it lets them do"
    if isinstance(error, nats.js.errors.APIError) and error.description:
        return f"it refuses ({error.description})"
    if "SSL" in text or "certificate" in text:
        return f"{text}; check tls_ca_file and the name in its certificate"
    return f"{text}; check server, and whether it runs with JetStream"
