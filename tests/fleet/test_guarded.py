"""A server with TLS, passwords and documented permissions: machines publish their own records and read none."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nats.errors
import pytest
from nats.aio.client import Client

from fdhil.config.fleet_config import Stream
from fdhil.config.uplink_section import NatsServer
from fdhil.fleet import transport, uplink
from fdhil.fleet.message import decode
from fdhil.fleet.transport import connected
from fdhil.fleet.uplink import Sender
from tests.fleet import servers
from tests.fleet.machine import Machine, written
from tests.fleet.servers import NatsServer as Server
from tests.shopfloor.mosquitto import certify

pytestmark = pytest.mark.debian
SECRET = "canary-51c07"


def guard(folder: Path) -> str:
    """Return the access rules of the server's configuration."""
    certify(folder)
    tls = f'tls {{ cert_file: "{folder}/broker.pem", key_file: "{folder}/broker.key" }}\n'
    rights = 'permissions: { publish: ["fdhil.v1.%s.>"], subscribe: ["_INBOX_fdhil-%s.>"] }'
    users = [f"{{ user: {name}, password: {SECRET}, {rights % (name, name)} }}" for name in ("mill-1", "mill-2")]
    return tls + f"authorization {{ users = [ {{ user: collector, password: {SECRET} }}, {', '.join(users)} ] }}\n"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    (tmp_path / "password").write_text(SECRET)
    with servers.nats(tmp_path, guard(tmp_path)) as running:
        yield running


def entering(server: Server, folder: Path, user: str) -> NatsServer:
    return NatsServer(server=server.url, user=user, password_file=folder / "password", tls_ca_file=folder / "ca.pem")


async def forge(client: Client) -> None:
    """Publish in the name of mill-1 and wait for the server's error."""
    try:
        await client.jetstream().publish("fdhil.v1.mill-1.records", b"{}", timeout=1.0)
    finally:
        await client.flush(60)


async def test_each_tells_its_own_and_only_the_collector_reads(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(uplink, "ANSWER_S", 60.0)
    keys = {"server": server.url, "user": "mill-1", "password_file": str(tmp_path / "password")}
    machine = Machine(written(tmp_path / "mill", "mill-1", tls_ca_file=str(tmp_path / "ca.pem"), **keys))
    count = machine.record(1)
    settings = machine.config.uplink
    assert settings is not None
    async with connected(entering(server, tmp_path, "collector"), "fdhil-collector", "server") as collector:
        reader = await transport.prepare_stream(collector.jetstream(timeout=60.0), Stream(max_bytes=1 << 26))
        async with connected(settings, "fdhil-mill-1", "uplink") as client:
            sender = Sender(machine.config, settings)
            stolen = await client.subscribe("fdhil.v1.>")  # it may not read the records of others
            position, entries = await sender._next(client.jetstream())
            await sender._send(client.jetstream(), position, entries, client.max_payload)
            await client.flush()
            assert stolen.pending_msgs == 0
        messages = await reader.fetch(100, timeout=60)
        assert sum(len(decode(message.subject, message.data)) for message in messages) == count + 1
        with pytest.raises(nats.errors.Error) as refused:  # in the name of another
            async with connected(entering(server, tmp_path, "mill-2"), "fdhil-mill-2", "uplink") as other:
                await forge(other)
        assert "the server refuses access" in transport.cause_of(refused.value)
    machine.close()
    assert SECRET not in "".join(capfd.readouterr())


async def unheard(error: Exception) -> None:
    """Ignore an error that the caller has already caused to end the connection."""


async def test_who_has_no_credentials_gets_nothing(server: Server, tmp_path: Path) -> None:
    tls = ssl.create_default_context(cafile=tmp_path / "ca.pem")
    known = {"user": "mill-1", "password": SECRET}
    wrong: list[dict[str, Any]] = [{}, known | {"password": "guess"}, known | {"tls": None}]
    for keys in wrong:
        given: dict[str, Any] = {"tls": tls, "allow_reconnect": False, "error_cb": unheard} | keys
        with pytest.raises((nats.errors.Error, OSError)):
            await asyncio.wait_for(Client().connect(server.url, **given), 20)
    (tmp_path / "password").write_text("guess")
    entered = connected(entering(server, tmp_path, "mill-1"), "fdhil-mill-1", "uplink")
    with pytest.raises((nats.errors.Error, OSError)) as error:
        await entered.__aenter__()
    assert "the server refuses access" in transport.cause_of(error.value)


async def test_where_a_certificate_is_wanted_who_has_none_gets_nothing(tmp_path: Path) -> None:
    certify(tmp_path)
    files = f'cert_file: "{tmp_path}/broker.pem", key_file: "{tmp_path}/broker.key", ca_file: "{tmp_path}/ca.pem"'
    with servers.nats(tmp_path, f"tls {{ {files}, verify: true }}\n") as running:
        without = NatsServer(server=running.url, tls_ca_file=tmp_path / "ca.pem")
        own = {"tls_certificate_file": tmp_path / "client.pem", "tls_key_file": tmp_path / "client.key"}
        async with connected(without.model_copy(update=own), "fdhil-mill-1", "uplink") as client:
            await client.flush()
            assert client.is_connected
        (tmp_path / "foreign").mkdir()
        certify(tmp_path / "foreign")
        foreign = {key: tmp_path / "foreign" / path.name for key, path in own.items()}
        for settings in (without, without.model_copy(update=foreign)):
            with pytest.raises(transport.ERRORS):
                await connected(settings, "fdhil-mill-1", "uplink").__aenter__()
