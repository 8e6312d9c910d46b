"""An MTConnect agent for tests: it reads a Devices.xml, connects, pings, and parses SHDR."""

from __future__ import annotations

import asyncio
import contextlib
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

SPACE = "{urn:mtconnect.org:MTConnectDevices:2.0}"
LEVELS = {"NORMAL", "WARNING", "FAULT", "UNAVAILABLE"}


def data_items(devices_xml: str) -> dict[str, dict[str, str]]:
    root = ElementTree.fromstring(devices_xml)
    return {item.attrib["id"]: dict(item.attrib) for item in root.iter(f"{SPACE}DataItem")}


class Agent:
    """An agent's view: values by data item, and the active alarms of each condition by their code."""

    def __init__(self, devices_xml: str) -> None:
        self.items = data_items(devices_xml)
        self.values: dict[str, str] = {}
        self.conditions: dict[str, dict[str, tuple[str, str]] | None] = {}
        self.messages: list[tuple[str, str, str]] = []
        self.pongs: list[str] = []
        self.lines = 0

    def take(self, line: str) -> None:
        self.lines += 1
        if line.startswith("*"):
            self.pongs += re.findall(r"^\* PONG (\d+)$", line)
            return
        stamp, key, *fields = line.split("|")
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", stamp), line
        item = self.items[key]  # the agent would not know any other
        if item["category"] == "CONDITION":
            self._condition(key, fields)
        elif item["type"] == "MESSAGE":
            code, text = fields
            self.messages.append((key, code, text))
        else:
            [self.values[key]] = fields
            if item["category"] == "SAMPLE" and fields[0] != "UNAVAILABLE":
                float(fields[0])

    def _condition(self, key: str, fields: list[str]) -> None:
        level, code, _, _, text = fields
        assert level in LEVELS
        if level == "UNAVAILABLE":
            self.conditions[key] = None
        elif not code:
            assert level == "NORMAL"
            self.conditions[key] = {}
        else:
            active = dict(self.conditions.get(key) or {})
            active.pop(code, None)
            if level != "NORMAL":
                active[code] = (level, text)
            self.conditions[key] = active


class Connected:
    def __init__(self, agent: Agent, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.agent, self._reader, self._writer = agent, reader, writer

    async def until(self, so: Callable[[Agent], Any]) -> None:
        async with asyncio.timeout(60):
            while not so(self.agent):
                line = await self._reader.readline()
                if not line:
                    raise EOFError
                self.agent.take(line.decode().removesuffix("\n"))

    async def until_let_go(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            await self.until(lambda _: False)

    def send(self, line: bytes) -> None:
        self._writer.write(line)

    def pause(self) -> None:
        transport = self._writer.transport
        assert isinstance(transport, asyncio.ReadTransport)
        transport.pause_reading()

    async def leave(self) -> None:
        self._writer.close()
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()


@asynccontextmanager
async def connected(devices_xml: str, port: int, address: str = "127.0.0.1") -> AsyncIterator[Connected]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(address, 0))
    agent = Connected(Agent(devices_xml), reader, writer)
    try:
        yield agent
    finally:
        await agent.leave()
