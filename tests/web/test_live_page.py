"""The live page over real sockets: the daemon's stream, the browser's messages, and their access rights."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import uvicorn
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from fdhil.config import Access, MachineConfig
from fdhil.config.user_file import hash_password, write_users
from fdhil.daemon.daemon_socket import SOCKET_NAME, ControlServer
from fdhil.daemon.live_stream import LiveStream
from fdhil.web.application import make_app
from fdhil.web.live_feed import MAX_BROWSERS, LiveFeed, LiveViewer
from fdhil.web.pages import live_page as page
from tests.daemon.simulated_machine import config_of
from tests.daemon.test_live_stream import block
from tests.web.test_live_ring import decode_message

BLOCK = 50
WAIT_S = 60.0
PASSWORD = "a password of tests"


@asynccontextmanager
async def serve_live_daemon(config: MachineConfig) -> AsyncIterator[LiveStream]:
    stream = LiveStream(config)

    async def answer_request(_request: Any, _peer: Any) -> Any:
        return stream.open_stream()

    config.run_directory.mkdir(parents=True, exist_ok=True)
    control = ControlServer(answer_request, lambda: None, lambda: None, Access(), stream.serve_viewer)
    async with control.serve_socket(config.run_directory / SOCKET_NAME):
        yield stream


class RunningServer(uvicorn.Server):
    def __init__(self, settings: uvicorn.Config) -> None:
        super().__init__(settings)
        self.listens = asyncio.Event()

    async def startup(self, sockets: Any = None) -> None:
        await super().startup(sockets)
        self.listens.set()


@asynccontextmanager
async def serve_pages(config: MachineConfig) -> AsyncIterator[str]:
    settings = uvicorn.Config(
        make_app(config), port=0, log_config=None, ws="websockets-sansio", lifespan="on", timeout_graceful_shutdown=1
    )
    server = RunningServer(settings)
    task = asyncio.create_task(server.serve())
    await server.listens.wait()
    try:
        yield f"127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        await task


def open_stream(place: str, query: str = "seconds=1&columns=100", **more: Any) -> connect:
    given = {"subprotocols": ["fdhil"], "open_timeout": WAIT_S, **more}
    return connect(f"ws://{place}/api/live/stream?{query}", **given)


class StreamBrowser:
    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.header: dict[str, Any] = {}
        self.parts: list[tuple[dict[str, Any], Any]] = []

    async def read_until(self, ready: Callable[[], bool], draw: bool = True) -> None:
        while not ready():
            message = await asyncio.wait_for(self.socket.recv(), WAIT_S)
            assert isinstance(message, bytes)
            self.header, low = decode_message(message)
            self.parts += zip(self.header["parts"], low, strict=True)
            if draw or not self.header["parts"]:  # a word of life has nothing to draw
                await self.acknowledge_drawn()

    async def acknowledge_drawn(self) -> None:
        await self.socket.send(json.dumps({"drawn": self.header["number"]}))

    @property
    def last_header(self) -> int:
        return sum(part["columns"] * part["per_column"] for part, _ in self.parts)


async def read_until_closed(socket: ClientConnection, told: list[object] | None = None) -> None:
    told = [] if told is None else told
    while True:
        told.append(await asyncio.wait_for(socket.recv(), WAIT_S))


async def start_stream(socket: ClientConnection) -> tuple[dict[str, Any], StreamBrowser]:
    begin = json.loads(await asyncio.wait_for(socket.recv(), WAIT_S))
    browser = StreamBrowser(socket)
    await browser.read_until(lambda: browser.header.get("trouble") == "")
    return begin, browser


def send_samples(stream: LiveStream, first: int, blocks: int) -> None:
    for k in range(blocks):
        stream.publish_record(block(np.arange(first + k * BLOCK, first + (k + 1) * BLOCK)))


@pytest.mark.usefixtures("real_time")
async def test_samples_are_streamed_and_kept_over_daemon_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.live_feed.RETRY_S", 0.05)
    config = config_of(tmp_path)
    async with serve_pages(config) as place, AsyncExitStack() as machine:
        async with open_stream(place) as socket:
            begin = json.loads(await socket.recv())
            browser = StreamBrowser(socket)
            await browser.read_until(lambda: "not running" in browser.header.get("trouble", ""))
            stream = await machine.enter_async_context(serve_live_daemon(config))
            await browser.read_until(lambda: browser.header["trouble"] == "")
            assert begin["ticks_per_column"] == 10
            assert begin["signals"][1] == {"name": "current_a", "unit": "A"}
            send_samples(stream, 0, 8)
            await browser.read_until(lambda: browser.last_header >= 390)
            current = np.concatenate([low[1] for _, low in browser.parts])
            assert np.diff(current[1:]).tolist() == [20.0] * (current.size - 2)  # 2 A a tick, 10 ticks a column
            end = browser.parts[-1][0]["first_tick"] + 10 * browser.parts[-1][0]["columns"]
            await machine.aclose()
            await browser.read_until(lambda: browser.header["trouble"] != "")
            stream = await machine.enter_async_context(serve_live_daemon(config))
            await browser.read_until(lambda: browser.header["trouble"] == "")
            send_samples(stream, 0, 8)
            await browser.read_until(lambda: browser.last_header >= 770)
            assert browser.parts[-1][0]["first_tick"] > end
        async with httpx.AsyncClient(timeout=WAIT_S) as client:
            query = {"first_tick": end - 20, "end_tick": end, "columns": 100}
            reported = (await client.get(f"http://{place}/api/live/samples", params=query)).json()
    signal = reported["axes"]["X"]["current_a"]
    assert (reported["ticks_per_column"], signal["unit"], len(signal["low"])) == (1, "A", 20)
    assert signal["low"] == signal["high"]
    assert np.diff(signal["low"]).tolist() == [2.0] * 19
    assert reported["axes"]["X"]["temperature_c"]["low"] == [None] * 20


@pytest.mark.usefixtures("real_time")
async def test_slow_browser_gets_wider_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_of(tmp_path)
    async with (
        serve_live_daemon(config) as stream,
        serve_pages(config) as place,
        open_stream(place, "seconds=5&columns=500") as socket,
    ):
        _, browser = await start_stream(socket)
        monkeypatch.setattr(page, "ALIVE_S", math.inf)  # a word of life would be one of the two that are not drawn
        send_samples(stream, 0, 2)
        await browser.read_until(lambda: browser.last_header >= 90, draw=False)
        send_samples(stream, 100, 2)
        await browser.read_until(lambda: browser.last_header >= 190, draw=False)
        send_samples(stream, 200, 40)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1.0):  # nothing comes, however long one waits
                await socket.recv()
        await browser.acknowledge_drawn()
        await browser.read_until(lambda: browser.last_header >= 2000)
    assert {part["per_column"] for part, _ in browser.parts} > {10}
    assert all(part["skipped_ticks"] == 0 for part, _ in browser.parts)
    ends = [part["first_tick"] + part["columns"] * part["per_column"] for part, _ in browser.parts]
    assert ends == sorted(ends)
    assert all(part["first_tick"] <= end for (part, _), end in zip(browser.parts[1:], ends, strict=False))  # no hole


@pytest.mark.parametrize(
    ("query", "says", "code"),
    [
        ("axes=Q", None, 1008),
        ("", "no json", 1008),
        ("", b"\x00", 1008),
        ("", '{"drawn": "all"}', 1008),
        ("", "[" * 3000, 1008),
        ("columns=5", None, 403),
        ("seconds=nan", None, 403),
        ("seconds=1e9", None, 403),
    ],
)
async def test_invalid_browser_message_ends_its_socket(
    query: str, says: str | bytes | None, code: int, tmp_path: Path
) -> None:
    async with serve_pages(config_of(tmp_path)) as place:
        with pytest.raises((ConnectionClosed, InvalidStatus)) as error:
            await _read_close_reason(place, query, says)
    reported = error.value
    if isinstance(reported, ConnectionClosed):
        assert reported.rcvd is not None
        assert reported.rcvd.code == code
    else:
        assert isinstance(reported, InvalidStatus)
        assert reported.response.status_code == code


async def _read_close_reason(place: str, query: str, says: str | bytes | None) -> None:
    async with open_stream(place, query) as socket:
        if says is not None:
            await socket.send(says)
        await read_until_closed(socket)


async def test_number_of_watching_browsers_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.web.live_feed.MAX_BROWSERS", 2)
    async with serve_pages(config_of(tmp_path)) as place, open_stream(place) as first, open_stream(place) as second:
        for socket in (first, second):
            await socket.recv()
        async with open_stream(place) as third:
            with pytest.raises(ConnectionClosed, match="1013"):
                await asyncio.wait_for(third.recv(), WAIT_S)
        await first.close()
        while True:  # its place is free when the server has seen it leave
            async with open_stream(place) as fourth:
                try:
                    await asyncio.wait_for(fourth.recv(), WAIT_S)
                    break
                except ConnectionClosed:
                    continue


async def test_idle_browser_makes_room_for_active_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.web.live_feed.MAX_BROWSERS", 2)
    monkeypatch.setattr("fdhil.web.live_feed.UNDRAWN_S", -1.0)
    async with serve_pages(config_of(tmp_path)) as place, open_stream(place) as first, open_stream(place) as second:
        for socket in (first, second):
            await socket.recv()
        async with open_stream(place) as third:
            assert json.loads(await third.recv())["axes"] == ["X"]
            with pytest.raises(ConnectionClosed, match="another browser took this place"):
                await read_until_closed(first)


def test_owner_of_all_places_makes_room_for_another(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    feed = LiveFeed(tmp_path / "none", {"X": None}, 1e-3)
    feed.viewers = [LiveViewer("anna", time.monotonic()) for _ in range(MAX_BROWSERS)]
    assert not feed.make_room("anna")
    assert feed.make_room("otto")
    assert (len(feed.viewers), feed.viewers[0].replaced) == (MAX_BROWSERS - 1, False)
    feed.viewers += [LiveViewer("otto", time.monotonic())]
    feed.viewers = [LiveViewer(f"user {k // 2}", time.monotonic()) for k in range(MAX_BROWSERS)]
    assert not feed.make_room("user 0")  # as many as others


@pytest.mark.usefixtures("long_computation")
async def test_stream_needs_login_and_ends_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_users(tmp_path / "users.json", {"ann": hash_password(PASSWORD, "watch")})
    config = config_of(tmp_path, web={"users_file": "users.json"})
    async with (
        serve_pages(config) as place,
        httpx.AsyncClient(base_url=f"http://{place}", headers={"X-Fdhil": "1"}, timeout=WAIT_S) as client,
    ):
        token = (await client.post("/api/session", json={"name": "ann", "password": PASSWORD})).json()["token"]
        mine: list[Any] = ["fdhil", f"bearer.{token}"]
        strangers: tuple[dict[str, Any], ...] = (
            {"subprotocols": ["fdhil"]},
            {"subprotocols": ["fdhil", "bearer.wrong"]},
            {"subprotocols": mine, "origin": "http://evil.example"},
            {"subprotocols": mine, "place": "evil.example", "host": "127.0.0.1", "port": int(place.split(":")[1])},
        )
        for more in strangers:
            with pytest.raises(InvalidStatus, match="403"):
                async with open_stream(more.pop("place", place), **more):
                    pass
        query = {"first_tick": 0, "end_tick": 10}
        assert (await client.get("/api/live/samples", params=query)).status_code == 401
        async with open_stream(place, subprotocols=mine) as socket:
            assert socket.subprotocol == "fdhil"  # the token is not said back
            await asyncio.wait_for(socket.recv(), WAIT_S)
            await client.delete("/api/session", headers={"Authorization": f"Bearer {token}"})
            with pytest.raises(ConnectionClosed, match="the login has expired"):
                await read_until_closed(socket)
        token = (await client.post("/api/session", json={"name": "ann", "password": PASSWORD})).json()["token"]
        async with open_stream(place, subprotocols=["fdhil", f"bearer.{token}"]) as socket:
            await socket.recv()
            write_users(tmp_path / "users.json", {})
            reported: list[object] = []
            with pytest.raises(ConnectionClosed, match="the login has expired"):
                await read_until_closed(socket, reported)
            assert len(reported) <= 1  # which was on its way
