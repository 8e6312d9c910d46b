"""A small MTConnect agent: /current and the stream of /sample, as XML over HTTP."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from typing import Any, Self
from urllib.parse import parse_qs, urlsplit
from xml.sax.saxutils import escape

from fdhil.records import MoveKind

NAMESPACE = "urn:mtconnect.org:MTConnectStreams:1.8"
ITEMS = {  # dataItemId: holder, element, subType
    "exec": ("Events", "Execution", ""),
    "block": ("Events", "Block", ""),
    "line": ("Events", "LineNumber", ""),
    "program": ("Events", "Program", ""),
    "tool": ("Events", "ToolNumber", ""),
    "fact": ("Samples", "PathFeedrate", "ACTUAL"),
    "fcmd": ("Samples", "PathFeedrate", "PROGRAMMED"),
    "fovr": ("Events", "PathFeedrateOverride", "PROGRAMMED"),
    "rovr": ("Events", "PathFeedrateOverride", "RAPID"),
    "pos": ("Samples", "Position", ""),
}
OF_FIELD = {
    "line": ("line", 1.0), "program": ("program", 1.0), "tool": ("tool", 1.0), "feed_mm_min": ("fact", 1 / 60),
    "programmed_feed_mm_min": ("fcmd", 1 / 60), "feed_override": ("fovr", 100.0), "rapid_override": ("rovr", 100.0),
}  # fmt: skip
BLOCKS = {MoveKind.RAPID: "N10 G00 X10.", MoveKind.FEED: "G1 X20 F500", MoveKind.ARC: "G02 X1 Y1 I1"}
BOUNDARY = "a8e12eced4fb871ac096a99bf9728425"


class MtConnectPeer:
    """An agent with one device and one path; ``instance`` is its instanceId, ``chunked`` the form of its stream."""

    tells = frozenset(OF_FIELD)
    knows = frozenset({*BLOCKS, MoveKind.REST, MoveKind.HOLD})

    def __init__(self) -> None:
        self.instance, self.chunked = 1, True
        self.devices: tuple[str, ...] = ("Mill",)
        self.sequence = 1
        self.changes: list[tuple[int, str, str, float]] = []  # sequence, item, text, time
        self.requests: list[str] = []
        self.nonsense: bytes | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        for item in ITEMS:
            self.set_values(item, "UNAVAILABLE")

    def set_values(self, item: str, text: str, later_s: float = 0.0) -> None:
        """Set an item's text; the agent's time stamp is ``later_s`` later."""
        self.changes.append((self.sequence, item, text, time.time() + later_s))
        self.sequence += 1

    @property
    def settings(self) -> Mapping[str, Any]:
        return {"url": f"http://127.0.0.1:{self.port}", "period_s": 0.02}

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *exception: object) -> None:
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._server.wait_closed()

    def document(self, since: int) -> bytes:
        """Return the streams document of the changes since then."""
        new = [change for change in self.changes if change[0] >= since]
        streams = "".join(self._device(name, new) for name in self.devices) if new else ""
        return (
            f'<?xml version="1.0" encoding="UTF-8"?><MTConnectStreams xmlns="{NAMESPACE}">'
            f'<Header creationTime="2026-01-01T00:00:00Z" sender="peer" instanceId="{self.instance}" version="1.8"'
            f' bufferSize="131072" firstSequence="1" nextSequence="{self.sequence}"/>'
            f"<Streams>{streams}</Streams></MTConnectStreams>"
        ).encode()

    def _device(self, name: str, new: list[tuple[int, str, str, float]]) -> str:
        held: dict[str, list[str]] = {"Samples": [], "Events": []}
        for sequence, item, text, at_s in new:
            holder, element, sub_type = ITEMS[item]
            reported = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(at_s)) + f".{int(at_s % 1 * 1e6):06d}Z"
            sub = f' subType="{sub_type}"' if sub_type else ""
            begin = f'<{element} dataItemId="{item}" sequence="{sequence}" timestamp="{reported}"{sub}>'
            held[holder].append(f"{begin}{escape(text)}</{element}>")
        inside = "".join(f"<{holder}>{''.join(each)}</{holder}>" for holder, each in held.items() if each)
        return (
            f'<DeviceStream name="{name}" uuid="u-{name}">'
            f'<ComponentStream component="Path" name="path" componentId="p1">{inside}</ComponentStream></DeviceStream>'
        )

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            head = await reader.readuntil(b"\r\n\r\n")
            await self._answer(head.split(b" ")[1].decode(), writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass  # asyncio would log the end of its callback as an error
        finally:
            writer.close()

    async def _answer(self, target: str, writer: asyncio.StreamWriter) -> None:
        self.requests.append(target)
        url = urlsplit(target)
        query = {key: int(values[0]) for key, values in parse_qs(url.query).items()}
        if self.nonsense is not None:
            writer.write(self.nonsense)
            await writer.drain()
        elif url.path.endswith("/current"):
            newest = {item: sequence for sequence, item, *_ in self.changes}
            self.changes = [change for change in self.changes if newest[change[1]] == change[0]]
            document = self.document(0)
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n" % len(document))
            writer.write(document)
            await writer.drain()
        else:
            await self._stream(query["from"], query["interval"] / 1e3, query["heartbeat"] / 1e3, writer)

    async def _stream(self, since: int, interval_s: float, heartbeat_s: float, writer: asyncio.StreamWriter) -> None:
        chunked = b"Transfer-Encoding: chunked\r\n" if self.chunked else b""
        kind = f"multipart/x-mixed-replace;boundary={BOUNDARY}".encode()
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: %b\r\n%b\r\n" % (kind, chunked))
        quiet_s = heartbeat_s
        while not writer.is_closing():
            if self.sequence > since or quiet_s >= heartbeat_s:
                document, since, quiet_s = self.document(since), self.sequence, 0.0
                length = f"--{BOUNDARY}\r\nContent-type: text/xml\r\nContent-length: {len(document)}\r\n\r\n".encode()
                self._send(length + document + b"\r\n", writer)
            await writer.drain()
            await asyncio.sleep(interval_s)
            quiet_s += interval_s
            if self.nonsense is not None:
                self._send(self.nonsense, writer)
                return

    def _send(self, data: bytes, writer: asyncio.StreamWriter) -> None:
        writer.write(b"%x\r\n%b\r\n" % (len(data), data) if self.chunked else data)

    async def set_state(self, motion: MoveKind, **fields: Any) -> None:
        for name, value in fields.items():
            item, scale = OF_FIELD[name]
            self.set_values(item, value if isinstance(value, str) else repr(value if scale == 1.0 else scale * value))
        self.set_values("block", BLOCKS.get(motion, "UNAVAILABLE"))
        self.set_values("exec", {MoveKind.HOLD: "FEED_HOLD", MoveKind.REST: "READY"}.get(motion, "ACTIVE"))

    async def send_invalid_data(self) -> None:
        self.nonsense = b"SSH-2.0-OpenSSH_9.2\r\n"
