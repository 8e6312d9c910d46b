"""An MTConnect agent's documents: by HTTP as agents send it, in the NC's order, and invalid documents."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fdhil.config import MachineConfig
from fdhil.drivers.nc.http_stream import MultipartSplitter, Response
from fdhil.drivers.nc.mtconnect_source import MtConnectSource
from fdhil.drivers.nc.mtconnect_xml import read_streams
from fdhil.errors import ConnectError, DeviceError, ProtocolError
from fdhil.records import MoveKind, NcState
from tests.drivers.frame_builder import build_machine_config
from tests.drivers.nc.mtconnect_peer import BOUNDARY, MtConnectPeer


def build_config(**keys: Any) -> MachineConfig:
    return build_machine_config(g0={"source": "mtconnect"}, nc_source={"mtconnect": keys})


async def read_motions(source: MtConnectSource, count: int) -> list[NcState]:
    """Read until this many states were received."""
    states: list[NcState] = []
    async with asyncio.timeout(300):
        while len(states) < count:
            states += await source.read_states()
    return states


@pytest.mark.parametrize("chunked", [True, False])
async def test_changes_within_one_document_keep_their_order(chunked: bool) -> None:
    async with MtConnectPeer() as peer:
        peer.chunked = chunked
        peer.set_values("exec", "ACTIVE")
        peer.set_values("line", "4")
        peer.set_values("block", "G1 X0")
        async with MtConnectSource(build_config(**peer.settings)) as source:
            assert [state.motion for state in await source.read_states()] == [MoveKind.FEED]
            for line, block in ((5, "G0 X10"), (6, "X20"), (7, "G2 X1 I1"), (8, "M30")):
                peer.set_values("line", str(line), 0.02 * line)
                peer.set_values("block", block, 0.02 * line + 0.001)
            peer.set_values("exec", "PROGRAM_COMPLETED", 0.2)
            states = await read_motions(source, 5)
    kinds = list(dict.fromkeys((state.line, state.motion) for state in states if state.line != 4))
    assert kinds == [
        (5, MoveKind.RAPID), (6, MoveKind.RAPID), (7, MoveKind.ARC), (8, MoveKind.ARC), (8, MoveKind.REST),
    ]  # fmt: skip
    assert [state.stamp_ns for state in states] == sorted(state.stamp_ns for state in states)


async def test_agent_restart_ends_the_stream_and_reconnects() -> None:
    async with MtConnectPeer() as peer:
        source = MtConnectSource(build_config(**peer.settings))
        async with source:
            await source.read_states()
            peer.instance = 2
            with pytest.raises(ProtocolError, match="was restarted"):
                await read_motions(source, 10_000)
        async with source:
            await source.read_states()
    assert [request.partition("?")[0] for request in peer.requests] == ["/current", "/sample"] * 2


async def test_device_must_be_configured_when_agent_has_several() -> None:
    async with MtConnectPeer() as peer:
        peer.devices = ("Mill", "Lathe")
        with pytest.raises(ProtocolError, match="Lathe, Mill; give device"):
            await MtConnectSource(build_config(**peer.settings)).__aenter__()
        with pytest.raises(ProtocolError, match="its devices are"):
            await MtConnectSource(build_config(**peer.settings, device="Saw")).__aenter__()
        with pytest.raises(ProtocolError, match="its paths are: path"):
            await MtConnectSource(build_config(**peer.settings, device="Mill", path="second")).__aenter__()
        async with MtConnectSource(build_config(**peer.settings, device="u-Lathe", path="p1")) as source:
            assert (await source.read_states())[0].motion is MoveKind.UNKNOWN


async def test_missing_data_item_of_the_profile_is_named(tmp_path: Any) -> None:
    own = tmp_path / "own.toml"
    own.write_text(
        'title = "own"\ninterface = "mtconnect"\n[signals]\nmode = { at = "x:Motion|@motion" }\n'
        '[[motion]]\nkind = "rapid"\nwhen = { mode = ["G0"] }\n'
    )
    async with MtConnectPeer() as peer:
        with pytest.raises(ProtocolError, match="does not report x:Motion"):
            await MtConnectSource(build_config(**peer.settings, profile=str(own))).__aenter__()


async def test_empty_document_repeats_the_last_state() -> None:
    async with MtConnectPeer() as peer:
        peer.set_values("exec", "READY")
        async with MtConnectSource(build_config(**peer.settings, renewed_s=0.0)) as source:
            states = await read_motions(source, 4)
    assert {state.motion for state in states} == {MoveKind.REST}
    assert all(state.error_ns > 0 for state in states)


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\n<a>", "does not answer with an MTConnect document"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\n\r\n<a/>", "answers with a a document"),
        (b"HTTP/1.1 200 OK\r\n\r\n<!DOCTYPE a [<!ENTITY b 'c'>]><a/>", "declarations"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", "chunk"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nffffffffff\r\n", "chunk"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 40\r\n\r\n<a/>", "ended the connection"),
        (b"ftp ready\r\n\r\n", "not HTTP"),
        (b"x" * 70_000, "without an end"),
        (b"", "ended the connection"),
        (
            b"HTTP/1.1 404 Not Found\r\n\r\n<MTConnectError><Errors><Error errorCode='NO_DEVICE'>Could not find"
            b"</Error></Errors></MTConnectError>",
            "NO_DEVICE Could not find",
        ),
    ],
)
async def test_server_that_is_not_an_agent_is_reported_in_one_sentence(answer: bytes, text: str) -> None:
    async with MtConnectPeer() as peer:
        peer.nonsense = answer
        with pytest.raises((ProtocolError, ConnectError), match=text):
            await MtConnectSource(build_config(**peer.settings)).__aenter__()


async def test_refused_stream_gives_the_agents_reason() -> None:
    class Refusing(MtConnectPeer):
        async def _stream(
            self, since: int, interval_s: float, heartbeat_s: float, writer: asyncio.StreamWriter
        ) -> None:
            body = b"<MTConnectError><Errors><Error errorCode='OUT_OF_RANGE'>count</Error></Errors></MTConnectError>"
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\n\r\n" + body)

    async with Refusing() as peer:
        with pytest.raises(ProtocolError, match="OUT_OF_RANGE"):
            await MtConnectSource(build_config(**peer.settings)).__aenter__()


DOCUMENT = MtConnectPeer().document(0)


@settings(max_examples=200)
@given(st.integers(0, len(DOCUMENT)), st.integers(0, 40), st.binary(max_size=20))
@example(0, 0, b"")
def test_damaged_document_is_read_or_reported(at: int, length: int, instead: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        read_streams(DOCUMENT[:at] + instead + DOCUMENT[at + length :], "agent")


@given(st.lists(st.binary(max_size=200), max_size=6), st.data())
def test_multipart_splitting_is_independent_of_chunk_borders(bodies: list[bytes], data: st.DataObject) -> None:
    bodies = [body for body in bodies if BOUNDARY.encode() not in body]
    stream = b"".join(b"--%b\r\nContent-length: %d\r\n\r\n%b\r\n" % (BOUNDARY.encode(), len(b), b) for b in bodies)
    cuts: list[int] = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    parts = MultipartSplitter("agent", f'multipart/x-mixed-replace; boundary="{BOUNDARY}"')
    came: list[bytes] = []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        came += parts.split_parts(stream[begin:end])
    assert came == bodies


@given(st.binary(max_size=300))
def test_any_bytes_give_a_document_or_a_device_error(data: bytes) -> None:
    async def read() -> None:
        reader = asyncio.StreamReader()
        reader.feed_data(b"HTTP/1.1 200 OK\r\n" + data)
        reader.feed_eof()
        response = Response("agent", reader)
        with contextlib.suppress(DeviceError):
            await response.read_head()
            await response.read_document()

    asyncio.run(read())
