"""The page *live*: the signals of every axis as they arrive, and single samples of the recent past."""

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, FastAPI, Query, WebSocket
from pydantic import BaseModel, Field
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocketDisconnect

from fdhil.daemon import SOCKET_NAME
from fdhil.web.fault_responses import RequestRefused
from fdhil.web.live_feed import KEPT_S, MAX_BROWSERS, LiveFeed, LiveViewer
from fdhil.web.live_ring import DRAWN, UNITS
from fdhil.web.live_view import LiveView, round_finite
from fdhil.web.login import find_client_network
from fdhil.web.request_gate import find_token
from fdhil.web.route_context import MachineDependency, PrincipalDependency

SEND_S = 0.1
ALIVE_S = 1.0
LEAST_S, MOST_S = 0.5, 60.0
POLICY, TRY_LATER = 1008, 1013  # RFC 6455, 7.4.1 and the registry of close codes

Axes = Annotated[str, Query(description="names of axes, separated by commas; default: all", max_length=200)]
Columns = Annotated[int, Query(ge=10, le=4000)]


def _find_feed(app: FastAPI) -> LiveFeed:
    if not hasattr(app.state, "live"):
        config = app.state.context.config
        app.state.live = LiveFeed(config.run_directory / SOCKET_NAME, config.axis, config.machine.sync_period_s)
    feed = app.state.live
    assert isinstance(feed, LiveFeed)
    return feed


async def _get_feed(connection: HTTPConnection) -> LiveFeed:
    return _find_feed(connection.app)


Feed = Annotated[LiveFeed, Depends(_get_feed)]


@asynccontextmanager
async def _run_feed(app: FastAPI) -> AsyncIterator[None]:
    task = asyncio.create_task(_find_feed(app).run(), name="live feed")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait([task])


router = APIRouter(prefix="/api/live", tags=["live"], lifespan=_run_feed)


class Signal(BaseModel):
    """One signal of one axis in columns: minimum and maximum, null without samples."""

    unit: str
    low: list[float | None]
    high: list[float | None]


class Samples(BaseModel):
    """A section of the stored samples; with ``ticks_per_column`` 1 the samples themselves."""

    ok: Literal[True] = True
    sync_period_s: float
    first_tick: int = Field(description="in the stream's own count, which the stream reports")
    ticks_per_column: int
    axes: dict[str, dict[str, Signal]]


@router.get("/samples")
async def samples(  # a coroutine: in the loop, which also writes the rings
    context: MachineDependency,
    feed: Feed,
    first_tick: Annotated[int, Query(ge=0, le=2**53)],
    end_tick: Annotated[int, Query(ge=0, le=2**53)],
    columns: Columns = 1000,
    axes: Axes = "",
) -> Samples:
    """Return the samples from one tick to before another, combined if there are more than ``columns``.

    Missing samples are null: the last five minutes are stored, and only while a browser watches.
    """
    named = _parse_axes(context, axes)
    end = max(first_tick + 1, end_tick)
    first = max(first_tick, end - feed.rings[named[0]].capacity)
    per_column = max(1, -(-(end - first) // columns))
    drawn = {axis: feed.rings[axis].compute_envelope(first, end, per_column) for axis in named}
    return Samples(
        sync_period_s=feed.period_s,
        first_tick=next(iter(drawn.values())).first_tick,
        ticks_per_column=per_column,
        axes={
            axis: {
                name: Signal(unit=UNITS[name], low=round_finite(part.low[k]), high=round_finite(part.high[k]))
                for k, name in enumerate(DRAWN)
            }
            for axis, part in drawn.items()
        },
    )


def _parse_axes(context: MachineDependency, axes: str) -> list[str]:
    named = list(dict.fromkeys(axes.split(","))) if axes else list(context.config.axis)
    if unknown := [axis for axis in named if axis not in context.config.axis]:
        text = f"there is no axis {unknown[0]!r}"
        raise RequestRefused(404, "NoSuchAxis", text, f"use {', '.join(context.config.axis)}")
    return named


@router.websocket("/stream")
async def stream(
    socket: WebSocket,
    context: MachineDependency,
    principal: PrincipalDependency,
    feed: Feed,
    seconds: Annotated[float, Query(ge=LEAST_S, le=MOST_S)] = 20.0,
    columns: Columns = 800,
    axes: Axes = "",
) -> None:
    """Send the newest samples as columns, as fast as the browser draws them, until it leaves or its login ends."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept("fdhil" if "fdhil" in offered else None)
    try:
        named = _parse_axes(context, axes)
    except RequestRefused as refused:
        await socket.close(POLICY, refused.document["text"])
        return
    owner = principal.name or find_client_network(socket.client.host if socket.client else "")
    if not feed.make_room(owner):
        await socket.close(TRY_LATER, f"{MAX_BROWSERS} browsers are watching already; close one of them")
        return
    view = LiveView(named, seconds, columns, feed.period_s)
    travel = {axis: context.config.axis[axis].screw_pitch_mm / math.tau for axis in named}
    signals = [{"name": name, "unit": UNITS[name]} for name in DRAWN]
    begin = {"sync_period_s": feed.period_s, "axes": named, "signals": signals, "ticks_per_column": view.per_column}
    viewer = LiveViewer(owner, time.monotonic())
    async with feed.register_viewer(viewer):
        with suppress(WebSocketDisconnect):  # the browser left
            await socket.send_json({**begin, "kept_s": KEPT_S, "mm_per_rad": travel})
            await socket.close(POLICY, await _serve_viewer(socket, view, viewer, feed, context))


async def _serve_viewer(
    socket: WebSocket, view: LiveView, viewer: LiveViewer, feed: LiveFeed, context: MachineDependency
) -> str:
    """Send samples and receive acknowledgements; return why it ended. WebSocketDisconnect if the browser left."""
    tasks = [
        asyncio.create_task(_receive_drawn(socket, view, viewer)),
        asyncio.create_task(_send_samples(socket, view, viewer, feed, context)),
    ]
    try:
        over, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return next(iter(over)).result()


async def _receive_drawn(socket: WebSocket, view: LiveView, viewer: LiveViewer) -> str:
    while True:
        try:
            message: Any = json.loads(await socket.receive_text())
        except (ValueError, RecursionError, KeyError):
            message = None
        if not isinstance(message, dict) or type(message.get("drawn")) is not int:
            return 'invalid message; send {"drawn": number of the newest drawn message}'
        if view.acknowledge_drawn(message["drawn"]):
            viewer.drawn_s = time.monotonic()


async def _send_samples(
    socket: WebSocket, view: LiveView, viewer: LiveViewer, feed: LiveFeed, context: MachineDependency
) -> str:
    """Send new columns about ten times a second, as fast as the browser draws; a sign of life without any.

    The login is checked each time: a removed user receives no further sample.
    """
    sent_s, token = 0.0, find_token(socket.headers)
    while True:
        await asyncio.sleep(SEND_S)
        if context.access.find_principal(token) is None:
            return "the login has expired; log in again"
        if viewer.replaced:
            return (
                "another browser took this place: this one drew nothing, or its user has more open; close one of them"
            )
        now_s = time.monotonic()
        if view.may_send() and (view.has_new_columns(feed.rings) or now_s - sent_s > ALIVE_S):
            sent_s = now_s
            about = {"trouble": feed.fault_text, "skipped_lines": feed.skipped_lines}
            await socket.send_bytes(view.make_message(feed.rings, about))
