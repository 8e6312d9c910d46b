"""Users with a key: an nkey's seed alone, and a .creds file with a token signed by an operator's account."""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
from pathlib import Path
from typing import Any, cast

import nats.errors
import nkeys
import pytest

from fdhil.config.uplink_section import NatsServer
from fdhil.errors import ConnectError
from fdhil.fleet import nats_transport
from tests.fleet import servers
from tests.fleet.servers import NatsServer as Server


def create_key(prefix: int) -> tuple[str, nkeys.KeyPair]:
    """Return a new seed and its key pair."""
    seed = nkeys.encode_seed(secrets.token_bytes(32), prefix)
    return seed.decode(), nkeys.from_seed(bytearray(seed))


def read_public_key(pair: nkeys.KeyPair) -> str:
    return bytes(pair.public_key).decode()


def create_token(subject: nkeys.KeyPair, issuer: nkeys.KeyPair, name: str, claims: dict[str, Any]) -> str:
    """Return the claims of ``issuer`` about ``subject``, signed in the form of NATS."""
    reported: dict[str, Any] = {
        "iat": 1_800_000_000,
        "iss": read_public_key(issuer),
        "name": name,
        "sub": read_public_key(subject),
    }
    reported["nats"] = claims | {"version": 2}
    reported["jti"] = base64.b32encode(hashlib.sha256(json.dumps(reported).encode()).digest()).decode().rstrip("=")
    parts = [_encode_plain({"typ": "JWT", "alg": "ed25519-nkey"}), _encode_plain(reported)]
    signed = base64.urlsafe_b64encode(issuer.sign(".".join(parts).encode())).decode().rstrip("=")
    return ".".join([*parts, signed])


def _encode_plain(document: dict[str, Any]) -> str:
    return base64.urlsafe_b64encode(json.dumps(document).encode()).decode().rstrip("=")


def configure_operator(folder: Path) -> tuple[str, str]:
    """Return the server configuration of an operator with one account, and the .creds file of its user mill-1."""
    (_, operator), (_, account) = create_key(nkeys.PREFIX_BYTE_OPERATOR), create_key(nkeys.PREFIX_BYTE_ACCOUNT)
    _, system = create_key(nkeys.PREFIX_BYTE_ACCOUNT)
    seed, user = create_key(nkeys.PREFIX_BYTE_USER)
    (folder / "operator.jwt").write_text(create_token(operator, operator, "works", {"type": "operator"}))
    limits = dict.fromkeys(("subs", "conn", "leaf", "imports", "exports", "data", "payload"), -1)
    of_account = create_token(
        account, operator, "machines", {"type": "account", "limits": limits | {"wildcards": True}}
    )
    rights = {"pub": {"allow": ["fdhil.v1.mill-1.>"]}, "sub": {"allow": ["_INBOX_fdhil-mill-1.>"]}}
    of_user = create_token(user, account, "mill-1", {"type": "user", "subs": -1, "data": -1, "payload": -1, **rights})
    creds = (
        f"-----BEGIN NATS USER JWT-----\n{of_user}\n------END NATS USER JWT------\n\n"
        f"-----BEGIN USER NKEY SEED-----\n{seed}\n------END USER NKEY SEED------\n"
    )
    resolver = f"operator: '{folder}/operator.jwt'\nresolver: MEMORY\n"
    of_system = create_token(system, operator, "system", {"type": "account", "limits": limits})
    tokens = f"{{ {read_public_key(account)}: '{of_account}', {read_public_key(system)}: '{of_system}' }}"
    return f"{resolver}resolver_preload: {tokens}\nsystem_account: {read_public_key(system)}\n", creds


def expect_login(server: Server, file: Path, secret: str) -> NatsServer:
    file.write_text(secret)
    return NatsServer(server=server.url, credentials_file=file)


async def publish_and_expect_refusal(server: Server, known: NatsServer, foreign: NatsServer) -> None:
    """Check that known users publish under their own name and others are refused."""
    async with nats_transport.connect_to_server(known, "fdhil-mill-1", "uplink") as client:
        await client.publish("fdhil.v1.mill-1.records", b"")
        await client.flush()
        assert client.last_error is None
        with pytest.raises(nats.errors.Error):
            await client.request("fdhil.v1.mill-2.records", b"", timeout=1.0)
        await client.flush(60)  # what the server said against it has come by then
        assert "the server refuses access" in nats_transport.describe_cause(
            cast(BaseException, client.last_error)
        )  # a timeout alone would not be it
    for other in (foreign, NatsServer(server=server.url)):
        with pytest.raises(nats_transport.ERRORS) as error:
            await nats_transport.connect_to_server(other, "fdhil-mill-1", "uplink").__aenter__()
        assert "the server refuses access" in nats_transport.describe_cause(error.value)


@pytest.mark.debian
async def test_user_logs_in_with_nkey(tmp_path: Path) -> None:
    seed, pair = create_key(nkeys.PREFIX_BYTE_USER)
    rights = '{ publish: ["fdhil.v1.mill-1.>"], subscribe: ["_INBOX_fdhil-mill-1.>"] }'
    guard = f"authorization {{ users = [ {{ nkey: {read_public_key(pair)}, permissions: {rights} }} ] }}\n"
    with servers.run_nats(tmp_path, guard) as server:
        known = expect_login(server, tmp_path / "seed", seed)
        foreign = expect_login(server, tmp_path / "other", create_key(nkeys.PREFIX_BYTE_USER)[0])
        await publish_and_expect_refusal(server, known, foreign)


@pytest.mark.debian
async def test_user_logs_in_with_signed_token(tmp_path: Path) -> None:
    guard, creds = configure_operator(tmp_path)
    (tmp_path / "another").mkdir()
    _, of_another = configure_operator(tmp_path / "another")
    with servers.run_nats(tmp_path, guard) as server:
        known = expect_login(server, tmp_path / "mill-1.creds", creds)
        await publish_and_expect_refusal(server, known, expect_login(server, tmp_path / "other.creds", of_another))


@pytest.mark.parametrize("content", ["", "SUAA", "-----BEGIN NATS USER JWT-----\nx\n"])
def test_credentials_without_seed_are_reported_before_connecting(content: str, tmp_path: Path) -> None:
    (tmp_path / "creds").write_text(content)
    with pytest.raises(ConnectError, match="contains no user seed"):
        nats_transport.check_credentials(NatsServer(credentials_file=tmp_path / "creds"), "uplink")
    with pytest.raises(ConnectError, match="cannot be used"):
        nats_transport.check_credentials(NatsServer(credentials_file=tmp_path / "none"), "uplink")
