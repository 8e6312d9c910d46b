"""An OPC UA server of an NC: nodes by id and by name, users and certificates, and missing nodes."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua
from asyncua.crypto import cert_gen
from asyncua.crypto.permission_rules import User, UserRole
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.nc import load_nc_source
from fdhil.drivers.nc.opcua_source import OpcUaSource
from fdhil.errors import ConfigError, ConnectError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import MoveKind, NcState
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.nc.opcua_peer import OpcUaPeer

OWN_URI = "urn:fdhil:test"


def build_config(**keys: Any) -> MachineConfig:
    return build_machine_config(
        g0={"source": "opcua"}, nc_source={"opcua": {"timeout_s": 60.0, "period_s": 0.02, **keys}}
    )


async def read_once(config: MachineConfig) -> NcState:
    async with OpcUaSource(config) as source:
        return (await source.read_states())[-1]


@pytest.mark.usefixtures("long_computation")
async def test_bad_value_is_none_and_decides_nothing() -> None:
    async with OpcUaPeer() as peer:
        await peer.set_state(MoveKind.RAPID, line=12)
        async with OpcUaSource(build_config(**peer.settings)) as source:
            assert (await source.read_states())[0].motion is MoveKind.RAPID
            bad = ua.DataValue(StatusCode=ua.StatusCode(ua.UInt32(ua.StatusCodes.BadWaitingForInitialData)))
            await peer.nodes["g_group_1"].write_attribute(ua.AttributeIds.Value, bad)
            assert (await source.read_states())[0].motion is MoveKind.UNKNOWN
            for node in peer.nodes.values():
                await node.write_attribute(ua.AttributeIds.Value, bad)
            with pytest.raises(ProtocolError, match="has no value"):
                await source.read_states()


class _CancelledWithAnswer(asyncio.CancelledError):
    """Behaves as asyncua's wait that is cancelled at the moment of the answer."""


@pytest.mark.usefixtures("real_time")
async def test_time_out_and_cancellation_coinciding_with_an_answer_are_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def answer_when_cancelled(*_: object) -> None:
        waiting.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            raise _CancelledWithAnswer from None

    async with OpcUaPeer() as peer, OpcUaSource(build_config(**peer.settings)) as source:
        waiting = asyncio.Event()
        assert source._client is not None
        monkeypatch.setattr(source._client.uaclient, "read_attributes", answer_when_cancelled)
        asking = asyncio.create_task(source._read_values())
        await waiting.wait()
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        source._settings.__dict__["timeout_s"] = 0.05
        with pytest.raises(DeviceTimeout, match="did not answer"):
            await source._read_values()


@pytest.mark.usefixtures("real_time")
async def test_missing_node_is_named_unless_it_is_optional(tmp_path: Path) -> None:
    async with OpcUaPeer() as peer:
        await peer.server.delete_nodes([peer.nodes["tool"]])
        state = await read_once(build_config(**peer.settings))
        assert (state.motion, state.tool) == (MoveKind.UNKNOWN, None)
        await peer.server.delete_nodes([peer.nodes["g_group_1"]])
        with pytest.raises(ProtocolError, match=r"ncFktAct\[u1,1\]; compare the profile"):
            await read_once(build_config(**peer.settings))


@pytest.mark.usefixtures("long_computation")
async def test_nodes_are_found_by_name_in_any_namespace() -> None:
    """The companion specification's profile, with its channel after two others that lack the required nodes."""
    async with OpcUaPeer() as peer:
        space = await peer.server.register_namespace("http://opcfoundation.org/UA/CNC/")
        interface = await peer.server.nodes.objects.add_object(space, "CncInterface")
        channels = await interface.add_object(space, "CncChannelList")
        await channels.add_object(space, "NodeVersion")
        channel = await channels.add_object(space, "Channel_1")
        for name, value in (("ActProgramStatus", 1), ("ActOverride", 80.0), ("ActProgramLine", "N40")):
            await channel.add_variable(space, name, value)
        await channel.add_variable(space, "ActGFunctions", [54, 0, 90], ua.VariantType.UInt32)
        state = await read_once(build_config(url=peer.settings["url"], profile="opc40502"))
        assert (state.motion, state.line, state.program) == (MoveKind.RAPID, 40, None)
        assert state.feed_override == pytest.approx(0.8)
        with pytest.raises(ProtocolError, match="has no Objects/Machines"):
            await read_once(build_config(url=peer.settings["url"], profile="heidenhain"))


async def test_namespace_can_be_given_by_uri(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text(
        'title = "own"\ninterface = "opcua"\n'
        '[signals]\nstatus = { at = "nsu=SinumerikVarProvider;s=/Channel/State/progStatus[u1]" }\n'
        '[[motion]]\nkind = "rapid"\nwhen = { status = { at_least = 3, at_most = 3 } }\n'
    )
    async with OpcUaPeer() as peer:
        await peer.set_state(MoveKind.RAPID)
        assert (await read_once(build_config(**{**peer.settings, "profile": str(own)}))).motion is MoveKind.RAPID
        own.write_text(own.read_text().replace("nsu=SinumerikVarProvider", "nsu=nobody"))
        with pytest.raises(ProtocolError, match="has no nsu=nobody"):
            await read_once(build_config(**{**peer.settings, "profile": str(own)}))
    own.write_text(own.read_text().replace("nsu=nobody;s=", ""))
    with pytest.raises(ConfigError, match=r"signals\.status\.at: '/Channel.*' is not an OPC UA node or path"):
        OpcUaSource(build_config(profile=str(own)))


class _Users:
    def get_user(
        self, iserver: Any, username: Any = None, password: Any = None, certificate: Any = None
    ) -> User | None:
        return User(role=UserRole.User) if (username, password) == ("fdhil", "right") else None


async def write_certificates(folder: Path, name: str, uri: str) -> tuple[Path, Path]:
    """Create a key and a certificate for this URI."""
    key, certificate = folder / f"{name}.pem", folder / f"{name}.der"
    await cert_gen.setup_self_signed_certificate(key, certificate, uri, "localhost", [], {"commonName": name})
    return certificate, key


def convert_to_pem(certificate: Path) -> Path:
    """Write a certificate as PEM under a name without the suffix .pem."""
    text = certificate.with_suffix(".crt")
    text.write_text(ssl.DER_cert_to_PEM_cert(certificate.read_bytes()))
    return text


async def test_user_certificate_and_encryption_are_applied(tmp_path: Path) -> None:
    ours = await write_certificates(tmp_path, "fdhil", OWN_URI)
    theirs = await write_certificates(tmp_path, "nc", "urn:nc")
    password = tmp_path / "password"
    async with OpcUaPeer(secure=theirs, users=_Users()) as peer:
        keys = {**peer.settings, "user": "fdhil", "password_file": str(password)}
        keys |= {"certificate": str(convert_to_pem(ours[0])), "private_key": str(ours[1])}
        with pytest.raises(ConnectError, match=r"password_file.*cannot be read"):
            await read_once(build_config(**keys))
        password.write_text("wrong\n")
        with pytest.raises(ConnectError, match="cannot be connected"):
            await read_once(build_config(**keys))
        password.write_text("right\n")
        await peer.set_state(MoveKind.ARC)
        assert (await read_once(build_config(**keys, server_certificate=str(theirs[0])))).motion is MoveKind.ARC
        (tmp_path / "fdhil.pem").write_text("no key")
        with pytest.raises(ConnectError, match="cannot be used with its key"):
            await read_once(build_config(**keys))


@asynccontextmanager
async def run_raw_server(answer: bytes | None) -> AsyncIterator[str]:
    """Serve these bytes as the answer, or nothing, and yield the address."""
    ended: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        ended.append(writer)
        with contextlib.suppress(OSError):
            await reader.read(100)
            writer.write(answer or b"")
            if answer is not None:
                writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield f"opc.tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for writer in ended:
            writer.close()
        await server.wait_closed()


@pytest.mark.parametrize(
    "answer",
    [
        None, b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"ACKF\x1c\x00\x00\x00" + bytes(20),
        b"ERRF\x14\x00\x00\x00\x00\x00\x7d\x80\x00\x00\x00\x00", b"ACKF\xff\xff\xff\x7f", b"MSGF\x08\x00\x00\x00",
    ],
)  # fmt: skip
async def test_server_that_is_not_opc_ua_is_reported_in_one_sentence(answer: bytes | None) -> None:
    async with run_raw_server(answer) as url:
        with pytest.raises(DeviceError) as caught:
            await read_once(build_config(url=url, timeout_s=0.1))
    assert "compare url" in str(caught.value)
    assert "\n" not in str(caught.value)


ACKNOWLEDGE = b"ACKF\x1c\x00\x00\x00" + struct.pack("<5I", 0, 65536, 65536, 0, 0)


@settings(max_examples=25)
@given(st.binary(max_size=60), st.sampled_from([b"", b"OPNF", b"MSGF", b"ERRF", b"CLOF"]), st.booleans())
def test_any_invalid_answer_is_a_device_error(body: bytes, kind: bytes, sized: bool) -> None:
    head = kind + struct.pack("<I", len(body) + 8) if sized else kind

    async def ask() -> None:
        async with run_raw_server(ACKNOWLEDGE + head + body) as url:
            with pytest.raises(DeviceError):
                await read_once(build_config(url=url, timeout_s=0.05))

    asyncio.run(ask())


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"url": "http://localhost"}, "url"),
        ({"profile": "siemenz"}, "did you mean 'siemens'"),
        ({"user": "me"}, "password_file"),
        ({"certificate": "a.der"}, "private_key"),
        ({"server_certificate": "a.der"}, "certificate"),
    ],
)
def test_invalid_settings_are_refused(keys: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        build_config(**keys)


def test_missing_library_names_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "NC_SOURCES", {"opcua": "no_such_library.anywhere:Source"})
    with pytest.raises(ConfigError, match=r"no_such_library.*pip install 'fdhil\[opcua\]'"):
        load_nc_source("opcua")
