"""Data of an NC's interfaces and shop-floor hosts: LinuxCNC's bridge, MTConnect over HTTP, SHDR, Sparkplug."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from contextlib import suppress

import numpy as np

from fdhil.daemon.nc_watch import NcWatch
from fdhil.drivers.moves.nc_reported_moves import NcReportedMoves
from fdhil.drivers.nc.http_stream import MultipartSplitter, Response
from fdhil.drivers.nc.linuxcnc_source import SCHEMA, LinuxCncSource
from fdhil.drivers.nc.mtconnect_source import MtConnectSource
from fdhil.drivers.nc.mtconnect_xml import read_streams
from fdhil.errors import DeviceError
from fdhil.records import AxisSamples, TickTimes, freeze_array, freeze_integers
from fdhil.shopfloor.mtconnect_adapter import ShdrAdapter
from fdhil.shopfloor.published_items import list_published_values
from fdhil.shopfloor.sparkplug import is_rebirth_command, parse_host_state
from tests.drivers.frame_builder import build_machine_config
from tests.fuzz.input_assessment import Target

CONFIG = build_machine_config(axes="X", g0={"source": "linuxcnc"})
AGENT = build_machine_config(axes="X", g0={"source": "mtconnect"})
_LOOP = asyncio.new_event_loop()


def _build_block(first: int) -> tuple[TickTimes, AxisSamples]:
    """Forty SYNCs in which the axis moves and stops again."""
    tick = first + np.arange(40)
    way_mm, zeros = np.clip(0.1 * (tick - 20.0), 0.0, 4.0), np.zeros(40)
    samples = AxisSamples(
        "X",
        freeze_integers(tick),
        demand_mm=freeze_array(way_mm),
        position_mm=freeze_array(way_mm),
        speed_rad_s=freeze_array(zeros),
        current_a=freeze_array(zeros),
        voltage_v=freeze_array(zeros),
        offset_mm=freeze_array(zeros),
        statusword=freeze_integers(zeros),
    )
    return TickTimes(freeze_integers(tick), freeze_integers(tick * 1_000_000)), samples


HEARD, LATER = (*_build_block(0), *_build_block(40)), (*_build_block(80), *_build_block(2000))


def _build_reader(data: bytes) -> asyncio.StreamReader:
    reader = asyncio.StreamReader(loop=_LOOP)
    reader.feed_data(data)
    reader.feed_eof()
    return reader


async def _parse_linuxcnc(data: bytes) -> None:
    bridge, moves, watch = LinuxCncSource(CONFIG), NcReportedMoves("X", CONFIG), NcWatch()
    for record in HEARD:
        moves.detect_moves(record)
    bridge._reader = _build_reader(data)
    bridge._check_greeting(await bridge._next_message())
    try:
        while True:
            for state in await bridge.read_states():
                moves.detect_moves(state)
                watch.take_state(state, 1.0)
                json.dumps(watch.build_status(1.0), allow_nan=False)
                list_published_values(("X",), ("can0",), {"nc": watch.build_status(1.0)}, 1)
    finally:
        for record in LATER:
            moves.detect_moves(record)


async def _parse_http(data: bytes) -> None:
    response = Response("agent", _build_reader(data))
    await response.read_head()
    if response.headers.get("content-type", "").startswith("multipart"):
        parts = MultipartSplitter("agent", response.headers["content-type"])
        while came := await response.read_some():
            for part in parts.split_parts(came):
                read_streams(part, "agent")
    else:
        await _parse_xml(await response.read_document())


async def _parse_xml(data: bytes) -> None:
    streams, agent = read_streams(data, "agent"), MtConnectSource(AGENT)
    agent._select_signals(streams)
    for state in agent._build_states(streams):
        json.dumps(
            list_published_values(("X",), ("can0",), {"nc": {"line": state.line, "heard_s_ago": 0.0}}, 1)[-1].value
        )


class _Agent:
    """Stands in for the connection of an agent."""

    class transport:  # noqa: N801 - as asyncio names it
        @staticmethod
        def get_write_buffer_size() -> int:
            return 0

    def write(self, data: bytes) -> None:
        assert data.endswith(b"\n")

    def close(self) -> None:
        pass


async def _parse_shdr(data: bytes) -> None:
    await ShdrAdapter().serve_agent(_build_reader(data), _Agent())  # type: ignore[arg-type] # stands for it


async def _parse_sparkplug(data: bytes) -> None:
    assert type(is_rebirth_command(data)) is bool
    parse_host_state(data)


WAYS: tuple[Callable[[bytes], Awaitable[None]], ...] = (
    _parse_linuxcnc,
    _parse_http,
    _parse_xml,
    _parse_shdr,
    _parse_sparkplug,
)


def taste(data: bytes) -> None:
    """Deliver the rest of the bytes to the interface selected by the first."""
    if data:
        with suppress(DeviceError):
            _LOOP.run_until_complete(WAYS[data[0] % len(WAYS)](data[1:]))


HELLO = json.dumps({"schema": SCHEMA, "servo_period_s": 0.001})
STATE = json.dumps(
    {
        "stamp_ns": 30_000_000,
        "error_ns": 1000,
        "motion": "rapid",
        "line": 3,
        "feed_mm_min": 1.0,
        "mm": {"X": 1.5},
        "cycle": 7,
    }
)
STREAMS = (
    '<?xml version="1.0"?><MTConnectStreams xmlns="urn:mtconnect.org:MTConnectStreams:2.0"><Header instanceId="1" '
    'nextSequence="9" bufferSize="100"/><Streams><DeviceStream name="m" uuid="u"><ComponentStream component="Path" '
    'name="p" componentId="c"><Events><Line dataItemId="l" sequence="3" timestamp="2026-01-01T00:00:00Z">12</Line>'
    '<Execution dataItemId="e" sequence="4" timestamp="2026-01-01T00:00:00Z">ACTIVE</Execution>'
    '<Block dataItemId="b" sequence="5" timestamp="2026-01-01T00:00:00.5Z">G0 X1</Block>'
    '<ToolNumber dataItemId="t" sequence="6" timestamp="2026-01-01T00:00:01Z">7</ToolNumber>'
    "</Events></ComponentStream></DeviceStream></Streams></MTConnectStreams>"
)
HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=a\r\nTransfer-Encoding: chunked\r\n\r\n"


def target() -> Target:
    part = b"--a\r\nContent-length: %d\r\n\r\n%s" % (len(STREAMS), STREAMS.encode())
    seeds = [
        f"\0{HELLO}\n{STATE}\n{STATE}\n".encode(),
        b"\1" + HEAD + b"%x\r\n%s\r\n0\r\n\r\n" % (len(part), part),
        b"\1HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%s" % (len(STREAMS), STREAMS.encode()),
        b"\2" + STREAMS.encode(),
        b"\3* PING\r\n* PING\n",
        b"\4" + bytes.fromhex("12180a144e6f646520436f6e74726f6c2f5265626972746820017001"),
        b'\4{"online": true, "timestamp": 1}',
    ]
    return Target(
        "nc_lines", seeds, taste, [b"NaN", b"1e999", b"null", b"* PING", b"<", b'sequence="', b"chunked"], 2000
    )
