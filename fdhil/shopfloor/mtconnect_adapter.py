"""An MTConnect adapter: agents connect over TCP and receive changes in SHDR, line by line.

It answers an agent's pings and ignores other input. An agent that does not read, or stops pinging, loses its
connection; when it connects again it receives everything.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter

from fdhil.config import MachineConfig, MtConnectAdapter
from fdhil.daemon import write_line
from fdhil.errors import ConnectError
from fdhil.shopfloor.published_items import list_published_values
from fdhil.shopfloor.publisher_process import report_ready
from fdhil.shopfloor.shdr import (
    PING,
    AdapterState,
    build_adapter_state,
    encode_devices_xml,
    format_notice,
    list_changed_lines,
)
from fdhil.shopfloor.status_poller import StatusUpdate, list_buses, poll_status

HEARTBEAT_S = 10.0  # period of an agent's pings; after two without one it is gone
MAX_AGENTS = 8
MAX_LINE = 1024
MAX_UNREAD = 256 * 1024  # unsent bytes per agent


async def publish(config: MachineConfig) -> None:
    """Serve agents until cancelled. ConnectError when it cannot listen."""
    settings = config.publish.mtconnect
    adapter = ShdrAdapter()
    server = await _open_server(adapter, settings)
    async with server:
        host, port = server.sockets[0].getsockname()[:2]
        report_ready(f"MTConnect adapter of {config.machine.name}: agents may connect to {host}:{port}")
        try:
            async for news in poll_status(config, settings.period_s):
                adapter.publish_update(news)
        finally:
            adapter.close()


def build_agent_devices(config: MachineConfig) -> str:
    """Return the Devices.xml for the agent of a machine."""
    now_ms = time.time_ns() // 1_000_000
    known = list_published_values(tuple(config.axis), list_buses(config), None, now_ms)
    return encode_devices_xml(config.machine.name, config.publish.mtconnect.device_uuid, known, now_ms)


async def _open_server(adapter: ShdrAdapter, settings: MtConnectAdapter) -> asyncio.Server:
    try:
        return await asyncio.start_server(adapter.serve_agent, settings.host, settings.port, limit=MAX_LINE)
    except OSError as error:
        where = f"{settings.host}:{settings.port}"
        text = f"cannot listen at {where}: {error.strerror or error}; set another [publish.mtconnect] host or port"
        raise ConnectError("MTConnect adapter", text) from None


class ShdrAdapter:
    """Sends the same to every agent: all known values when it connects, then changes."""

    def __init__(self) -> None:
        self._agents: dict[asyncio.StreamWriter, asyncio.Task[None] | None] = {}
        self._pinging: set[asyncio.StreamWriter] = set()
        self._picture: AdapterState | None = None
        self._notices: dict[str, str] = {}  # the newest of each axis

    def publish_update(self, news: StatusUpdate) -> None:
        """Send every agent what has changed."""
        now = build_adapter_state(news)
        new = [format_notice(event) for event in news.events]
        self._notices |= {event.axis: line for event, line in zip(news.events, new, strict=True)}
        before, self._picture = self._picture, now
        for agent in list(self._agents):
            self._write_lines(agent, [*list_changed_lines(before, now), *new])

    @property
    def agent_count(self) -> int:
        """Number of connected agents."""
        return len(self._agents)

    def close(self) -> None:
        """Close all connections; an agent then considers everything unavailable."""
        for agent, task in list(self._agents.items()):
            agent.close()
            if task is not None:
                task.cancel()

    async def serve_agent(self, reader: asyncio.StreamReader, agent: asyncio.StreamWriter) -> None:
        """Serve one agent until it disconnects."""
        if not self._make_room(agent):
            write_line(f"{MAX_AGENTS} agents are connected, another one is refused", "minor")
            agent.close()
            return
        self._agents[agent] = asyncio.current_task()
        self._greet_agent(agent)
        try:
            await self._answer_pings(reader, agent)
        except (OSError, ValueError, TimeoutError):
            pass  # it left, sent a line without an end, or stopped pinging: it may connect again
        except asyncio.CancelledError:
            pass  # the process stops; the stream's own callback must not see it
        finally:
            self._agents.pop(agent, None)
            self._pinging.discard(agent)
            agent.close()

    def _make_room(self, new: asyncio.StreamWriter) -> bool:
        """Return whether one more fits; closes one that never pinged, or one of an address with two more."""
        if len(self._agents) < MAX_AGENTS:
            return True
        count = Counter(map(_get_address, self._agents))
        silent = [agent for agent in self._agents if agent not in self._pinging]
        greedy = [agent for agent in self._agents if count[_get_address(agent)] > count[_get_address(new)] + 1]
        leaving = next(iter(silent or greedy), None)
        if leaving is None:
            return False
        self._agents.pop(leaving)
        leaving.transport.abort()
        return True

    def _greet_agent(self, agent: asyncio.StreamWriter) -> None:
        everything = list_changed_lines(None, self._picture) if self._picture else []
        self._write_lines(agent, ["* adapterVersion: fdhil", *everything, *self._notices.values()])

    async def _answer_pings(self, reader: asyncio.StreamReader, agent: asyncio.StreamWriter) -> None:
        patience_s: float | None = None  # a client that never pings, such as a terminal, may stay
        while True:
            async with asyncio.timeout(patience_s):
                line = await reader.readline()
            if not line:
                return
            if line.decode("utf-8", "replace").strip() == PING:
                patience_s = 2 * HEARTBEAT_S
                self._pinging.add(agent)
                self._write_lines(agent, [f"* PONG {round(1000 * HEARTBEAT_S)}"])

    def _write_lines(self, agent: asyncio.StreamWriter, text_lines: list[str]) -> None:
        if agent.transport.get_write_buffer_size() > MAX_UNREAD:
            agent.transport.abort()
            return
        with contextlib.suppress(OSError):
            agent.write("".join(f"{line}\n" for line in text_lines).encode())


def _get_address(agent: asyncio.StreamWriter) -> str:
    return str((agent.get_extra_info("peername") or ("",))[0])
