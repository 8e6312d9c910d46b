"""Clients that exhaust connections cannot block other users, least of all disarming."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from fdhil import connections
from fdhil.web import request_gate, serving
from fdhil.web.application import make_app
from tests.web.http_clients import write_machine

WAIT_S = 60.0
HEAD = b"Host: localhost\r\nX-Fdhil: 1\r\nContent-Type: application/json\r\n"
Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@asynccontextmanager
async def serve_pages(folder: Path, users: bool = True) -> AsyncIterator[int]:
    began = asyncio.Event()
    server = serving.make_server(make_app(write_machine(folder, users)), None, began.set)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        task = asyncio.create_task(server.serve([listener]))
        await began.wait()
        try:
            yield listener.getsockname()[1]
        finally:
            server.should_exit = True
            await task


@asynccontextmanager
async def hold_connection(port: int, number: int, sent: bytes = b"") -> AsyncIterator[list[Stream]]:
    streams = [await asyncio.open_connection("127.0.0.1", port) for _ in range(number)]
    try:
        for _, writer in streams:
            writer.write(sent)
        yield streams
    finally:
        for _, writer in streams:
            writer.close()


async def read_status_line(port: int) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(b"GET /api/session HTTP/1.1\r\nHost: localhost\r\n\r\n")
    line = await asyncio.wait_for(reader.readline(), WAIT_S)
    writer.close()
    return line


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize(
    "sent", [b"", b"GET / HTT", b"POST /api/session HTTP/1.1\r\nContent-Length: 90\r\n" + HEAD + b"\r\n{"]
)
async def test_exhausted_connections_do_not_block_others(sent: bytes, tmp_path: Path) -> None:
    async with serve_pages(tmp_path) as port, hold_connection(port, connections.MOST_CONNECTIONS + 8, sent):
        for _ in range(3):
            assert await read_status_line(port) == b"HTTP/1.1 200 OK\r\n"


async def test_endless_sockets_do_not_block_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.web.live_feed.MAX_BROWSERS", 0)
    async with serve_pages(tmp_path, users=False) as port:
        socket_head = b"Connection: upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        socket_head += b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nHost: localhost\r\n\r\n"
        async with hold_connection(
            port, connections.MOST_CONNECTIONS, b"GET /api/live/stream HTTP/1.1\r\n" + socket_head
        ) as streams:
            for reader, _ in streams[8:]:
                assert (await asyncio.wait_for(reader.readline(), WAIT_S)).startswith(b"HTTP/1.1 101 ")
            for _ in range(3):
                assert await read_status_line(port) == b"HTTP/1.1 200 OK\r\n"


async def is_closed(reader: asyncio.StreamReader) -> bytes:
    with contextlib.suppress(ConnectionError):
        return await asyncio.wait_for(reader.read(), WAIT_S)
    return b""


@pytest.mark.parametrize("sent", [b"", b"GET / HTT"])
async def test_missing_request_times_out(sent: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "QUIET_S", 0.05)
    async with serve_pages(tmp_path) as port, hold_connection(port, 1, sent) as streams:
        assert await is_closed(streams[0][0]) == b""


async def test_endless_body_times_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request_gate, "BODY_S", 0.05)
    sent = b"POST /api/session HTTP/1.1\r\nContent-Length: 90\r\n" + HEAD + b"\r\n{"
    async with serve_pages(tmp_path) as port, hold_connection(port, 1, sent) as streams:
        assert (await asyncio.wait_for(streams[0][0].readline(), WAIT_S)).startswith(b"HTTP/1.1 408 ")


async def test_invalid_request_is_answered_and_not_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    upgrade = b"GET / HTTP/1.1\r\nConnection: upgrade\r\nUpgrade: h2c\r\n" + HEAD + b"\r\n"
    async with serve_pages(tmp_path) as port:
        for sent, answer in ((b"\x16\x03\x01\r\n\r\n", b"HTTP/1.1 400 "), (upgrade, b"HTTP/1.1 200 ")):
            async with hold_connection(port, 1, sent) as streams:
                assert (await asyncio.wait_for(streams[0][0].readline(), WAIT_S)).startswith(answer)
    assert caplog.records == []
