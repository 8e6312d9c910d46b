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
from fdhil.fleet import nats_transport, record_uplink
from fdhil.fleet.nats_transport import connect_to_server
from fdhil.fleet.record_message import decode_message
from fdhil.fleet.record_uplink import OutboxSender
from tests.fleet import servers
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import NatsServer as Server
from tests.shopfloor.mosquitto import certify

pytestmark = pytest.mark.debian
SECRET = "canary-51c07"


def secure_server(folder: Path) -> str:
    """Return the access rules of the server's configuration."""
    certify(folder)
    tls = f'tls {{ cert_file: "{folder}/broker.pem", key_file: "{folder}/broker.key" }}\n'
    rights = 'permissions: { publish: ["fdhil.v1.%s.>"], subscribe: ["_INBOX_fdhil-%s.>"] }'
    users = [f"{{ user: {name}, password: {SECRET}, {rights % (name, name)} }}" for name in ("mill-1", "mill-2")]
    return tls + f"authorization {{ users = [ {{ user: collector, password: {SECRET} }}, {', '.join(users)} ] }}\n"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    (tmp_path / "password").write_text(SECRET)
    with servers.run_nats(tmp_path, secure_server(tmp_path)) as running:
        yield running


def expect_login(server: Server, folder: Path, user: str) -> NatsServer:
    return NatsServer(server=server.url, user=user, password_file=folder / "password", tls_ca_file=folder / "ca.pem")


async def create_certificates(client: Client) -> None:
    """Publish in the name of mill-1 and wait for the server's error."""
    try:
        await client.jetstream().publish("fdhil.v1.mill-1.records", b"{}", timeout=1.0)
    finally:
        await client.flush(60)


async def test_machine_publishes_own_subject_and_only_collector_reads(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(record_uplink, "ANSWER_S", 60.0)
    keys = {"server": server.url, "user": "mill-1", "password_file": str(tmp_path / "password")}
    machine = RecordingMachine(write_history(tmp_path / "mill", "mill-1", tls_ca_file=str(tmp_path / "ca.pem"), **keys))
    count = machine.record_windows(1)
    settings = machine.config.uplink
    assert settings is not None
    async with connect_to_server(expect_login(server, tmp_path, "collector"), "fdhil-collector", "server") as collector:
        reader = await nats_transport.prepare_record_stream(
            collector.jetstream(timeout=60.0), Stream(max_bytes=1 << 26)
        )
        async with connect_to_server(settings, "fdhil-mill-1", "uplink") as client:
            sender = OutboxSender(machine.config, settings)
            stolen = await client.subscribe("fdhil.v1.>")  # it may not read the records of others
            position, entries = await sender._read_next_entries(client.jetstream())
            await sender._send_entries(client.jetstream(), position, entries, client.max_payload)
            await client.flush()
            assert stolen.pending_msgs == 0
        messages = await reader.fetch(100, timeout=60)
        assert sum(len(decode_message(message.subject, message.data)) for message in messages) == count + 1
        with pytest.raises(nats.errors.Error) as refused:  # in the name of another
            async with connect_to_server(expect_login(server, tmp_path, "mill-2"), "fdhil-mill-2", "uplink") as other:
                await create_certificates(other)
        assert "the server refuses access" in nats_transport.describe_cause(refused.value)
    machine.close_store()
    assert SECRET not in "".join(capfd.readouterr())


async def is_rejected(error: Exception) -> None:
    """Ignore an error that the caller has already caused to end the connection."""


async def test_client_without_credentials_is_refused(server: Server, tmp_path: Path) -> None:
    tls = ssl.create_default_context(cafile=tmp_path / "ca.pem")
    known = {"user": "mill-1", "password": SECRET}
    wrong: list[dict[str, Any]] = [{}, known | {"password": "guess"}, known | {"tls": None}]
    for keys in wrong:
        given: dict[str, Any] = {"tls": tls, "allow_reconnect": False, "error_cb": is_rejected} | keys
        with pytest.raises((nats.errors.Error, OSError)):
            await asyncio.wait_for(Client().connect(server.url, **given), 20)
    (tmp_path / "password").write_text("guess")
    entered = connect_to_server(expect_login(server, tmp_path, "mill-1"), "fdhil-mill-1", "uplink")
    with pytest.raises((nats.errors.Error, OSError)) as error:
        await entered.__aenter__()
    assert "the server refuses access" in nats_transport.describe_cause(error.value)


async def test_client_without_required_certificate_is_refused(tmp_path: Path) -> None:
    certify(tmp_path)
    files = f'cert_file: "{tmp_path}/broker.pem", key_file: "{tmp_path}/broker.key", ca_file: "{tmp_path}/ca.pem"'
    with servers.run_nats(tmp_path, f"tls {{ {files}, verify: true }}\n") as running:
        without = NatsServer(server=running.url, tls_ca_file=tmp_path / "ca.pem")
        own = {"tls_certificate_file": tmp_path / "client.pem", "tls_key_file": tmp_path / "client.key"}
        async with connect_to_server(without.model_copy(update=own), "fdhil-mill-1", "uplink") as client:
            await client.flush()
            assert client.is_connected
        (tmp_path / "foreign").mkdir()
        certify(tmp_path / "foreign")
        foreign = {key: tmp_path / "foreign" / path.name for key, path in own.items()}
        for settings in (without, without.model_copy(update=foreign)):
            with pytest.raises(nats_transport.ERRORS):
                await connect_to_server(settings, "fdhil-mill-1", "uplink").__aenter__()
