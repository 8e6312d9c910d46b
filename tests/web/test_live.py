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
from fdhil.web.app import make_app
from fdhil.web.live_feed import MAX_BROWSERS, LiveFeed, Viewer
from fdhil.web.pages import live as page
from tests.daemon.simulated_machine import config_of
from tests.daemon.test_live_stream import block
from tests.web.test_live_ring import decoded

BLOCK = 50
WAIT_S = 60.0
PASSWORD = "a password of tests"


@asynccontextmanager
async def daemon(config: MachineConfig) -> AsyncIterator[LiveStream]:
    stream = LiveStream(config)

    async def handle(_request: Any, _peer: Any) -> Any:
        return stream.open_stream()

    config.run_directory.mkdir(parents=True, exist_ok=True)
    control = ControlServer(handle, lambda: None, lambda: None, Access(), stream.serve_viewer)
    async with control.serve_socket(config.run_directory / SOCKET_NAME):
        yield stream


class Server(uvicorn.Server):
    def __init__(self, settings: uvicorn.Config) -> None:
        super().__init__(settings)
        self.listens = asyncio.Event()

    async def startup(self, sockets: Any = None) -> None:
        await super().startup(sockets)
        self.listens.set()


@asynccontextmanager
async def pages(config: MachineConfig) -> AsyncIterator[str]:
    settings = uvicorn.Config(
        make_app(config), port=0, log_config=None, ws="websockets-sansio", lifespan="on", timeout_graceful_shutdown=1
    )
    server = Server(settings)
    task = asyncio.create_task(server.serve())
    await server.listens.wait()
    try:
        yield f"127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        await task


def stream_of(place: str, query: str = "seconds=1&columns=100", **more: Any) -> connect:
    given = {"subprotocols": ["fdhil"], "open_timeout": WAIT_S, **more}
    return connect(f"ws://{place}/api/live/stream?{query}", **given)


class Browser:
    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.header: dict[str, Any] = {}
        self.parts: list[tuple[dict[str, Any], Any]] = []

    async def until(self, ready: Callable[[], bool], draw: bool = True) -> None:
        while not ready():
            message = await asyncio.wait_for(self.socket.recv(), WAIT_S)
            assert isinstance(message, bytes)
            self.header, low = decoded(message)
            self.parts += zip(self.header["parts"], low, strict=True)
            if draw or not self.header["parts"]:  # a word of life has nothing to draw
                await self.draw()

    async def draw(self) -> None:
        await self.socket.send(json.dumps({"drawn": self.header["number"]}))

    @property
    def told(self) -> int:
        return sum(part["columns"] * part["per_column"] for part, _ in self.parts)


async def heard_out(socket: ClientConnection, told: list[object] | None = None) -> None:
    told = [] if told is None else told
    while True:
        told.append(await asyncio.wait_for(socket.recv(), WAIT_S))


async def begun(socket: ClientConnection) -> tuple[dict[str, Any], Browser]:
    begin = json.loads(await asyncio.wait_for(socket.recv(), WAIT_S))
    browser = Browser(socket)
    await browser.until(lambda: browser.header.get("trouble") == "")
    return begin, browser


def feed(stream: LiveStream, first: int, blocks: int) -> None:
    for k in range(blocks):
        stream.publish_record(block(np.arange(first + k * BLOCK, first + (k + 1) * BLOCK)))


@pytest.mark.usefixtures("real_time")
async def test_what_passes_is_told_as_columns_and_kept_as_samples_over_a_daemon_that_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.live_feed.RETRY_S", 0.05)
    config = config_of(tmp_path)
    async with pages(config) as place, AsyncExitStack() as machine:
        async with stream_of(place) as socket:
            begin = json.loads(await socket.recv())
            browser = Browser(socket)
            await browser.until(lambda: "not running" in browser.header.get("trouble", ""))
            stream = await machine.enter_async_context(daemon(config))
            await browser.until(lambda: browser.header["trouble"] == "")
            assert begin["ticks_per_column"] == 10
            assert begin["signals"][1] == {"name": "current_a", "unit": "A"}
            feed(stream, 0, 8)
            await browser.until(lambda: browser.told >= 390)
            current = np.concatenate([low[1] for _, low in browser.parts])
            assert np.diff(current[1:]).tolist() == [20.0] * (current.size - 2)  # 2 A a tick, 10 ticks a column
            end = browser.parts[-1][0]["first_tick"] + 10 * browser.parts[-1][0]["columns"]
            await machine.aclose()
            await browser.until(lambda: browser.header["trouble"] != "")
            stream = await machine.enter_async_context(daemon(config))
            await browser.until(lambda: browser.header["trouble"] == "")
            feed(stream, 0, 8)
            await browser.until(lambda: browser.told >= 770)
            assert browser.parts[-1][0]["first_tick"] > end
        async with httpx.AsyncClient(timeout=WAIT_S) as client:
            query = {"first_tick": end - 20, "end_tick": end, "columns": 100}
            told = (await client.get(f"http://{place}/api/live/samples", params=query)).json()
    signal = told["axes"]["X"]["current_a"]
    assert (told["ticks_per_column"], signal["unit"], len(signal["low"])) == (1, "A", 20)
    assert signal["low"] == signal["high"]
    assert np.diff(signal["low"]).tolist() == [2.0] * 19
    assert told["axes"]["X"]["temperature_c"]["low"] == [None] * 20


@pytest.mark.usefixtures("real_time")
async def test_a_browser_that_does_not_draw_is_waited_for_and_then_told_in_wider_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of(tmp_path)
    async with daemon(config) as stream, pages(config) as place, stream_of(place, "seconds=5&columns=500") as socket:
        _, browser = await begun(socket)
        monkeypatch.setattr(page, "ALIVE_S", math.inf)  # a word of life would be one of the two that are not drawn
        feed(stream, 0, 2)
        await browser.until(lambda: browser.told >= 90, draw=False)
        feed(stream, 100, 2)
        await browser.until(lambda: browser.told >= 190, draw=False)
        feed(stream, 200, 40)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1.0):  # nothing comes, however long one waits
                await socket.recv()
        await browser.draw()
        await browser.until(lambda: browser.told >= 2000)
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
async def test_what_is_no_wish_of_a_browser_ends_its_socket(
    query: str, says: str | bytes | None, code: int, tmp_path: Path
) -> None:
    async with pages(config_of(tmp_path)) as place:
        with pytest.raises((ConnectionClosed, InvalidStatus)) as error:
            await _said(place, query, says)
    told = error.value
    if isinstance(told, ConnectionClosed):
        assert told.rcvd is not None
        assert told.rcvd.code == code
    else:
        assert isinstance(told, InvalidStatus)
        assert told.response.status_code == code


async def _said(place: str, query: str, says: str | bytes | None) -> None:
    async with stream_of(place, query) as socket:
        if says is not None:
            await socket.send(says)
        await heard_out(socket)


async def test_so_many_may_look_on_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.web.live_feed.MAX_BROWSERS", 2)
    async with pages(config_of(tmp_path)) as place, stream_of(place) as first, stream_of(place) as second:
        for socket in (first, second):
            await socket.recv()
        async with stream_of(place) as third:
            with pytest.raises(ConnectionClosed, match="1013"):
                await asyncio.wait_for(third.recv(), WAIT_S)
        await first.close()
        while True:  # its place is free when the server has seen it leave
            async with stream_of(place) as fourth:
                try:
                    await asyncio.wait_for(fourth.recv(), WAIT_S)
                    break
                except ConnectionClosed:
                    continue


async def test_browsers_that_never_draw_make_room_for_one_that_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.web.live_feed.MAX_BROWSERS", 2)
    monkeypatch.setattr("fdhil.web.live_feed.UNDRAWN_S", -1.0)
    async with pages(config_of(tmp_path)) as place, stream_of(place) as first, stream_of(place) as second:
        for socket in (first, second):
            await socket.recv()
        async with stream_of(place) as third:
            assert json.loads(await third.recv())["axes"] == ["X"]
            with pytest.raises(ConnectionClosed, match="another browser took this place"):
                await heard_out(first)


def test_an_owner_of_all_places_makes_room_for_another_owner(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    feed = LiveFeed(tmp_path / "none", {"X": None}, 1e-3)
    feed.viewers = [Viewer("anna", time.monotonic()) for _ in range(MAX_BROWSERS)]
    assert not feed.make_room("anna")
    assert feed.make_room("otto")
    assert (len(feed.viewers), feed.viewers[0].replaced) == (MAX_BROWSERS - 1, False)
    feed.viewers += [Viewer("otto", time.monotonic())]
    feed.viewers = [Viewer(f"user {k // 2}", time.monotonic()) for k in range(MAX_BROWSERS)]
    assert not feed.make_room("user 0")  # as many as others


@pytest.mark.usefixtures("long_computation")
async def test_a_stranger_is_told_nothing_and_a_login_that_ends_ends_the_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_users(tmp_path / "users.json", {"ann": hash_password(PASSWORD, "watch")})
    config = config_of(tmp_path, web={"users_file": "users.json"})
    async with (
        pages(config) as place,
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
                async with stream_of(more.pop("place", place), **more):
                    pass
        query = {"first_tick": 0, "end_tick": 10}
        assert (await client.get("/api/live/samples", params=query)).status_code == 401
        async with stream_of(place, subprotocols=mine) as socket:
            assert socket.subprotocol == "fdhil"  # the token is not said back
            await asyncio.wait_for(socket.recv(), WAIT_S)
            await client.delete("/api/session", headers={"Authorization": f"Bearer {token}"})
            with pytest.raises(ConnectionClosed, match="the login has expired"):
                await heard_out(socket)
        token = (await client.post("/api/session", json={"name": "ann", "password": PASSWORD})).json()["token"]
        async with stream_of(place, subprotocols=["fdhil", f"bearer.{token}"]) as socket:
            await socket.recv()
            write_users(tmp_path / "users.json", {})
            told: list[object] = []
            with pytest.raises(ConnectionClosed, match="the login has expired"):
                await heard_out(socket, told)
            assert len(told) <= 1  # which was on its way
