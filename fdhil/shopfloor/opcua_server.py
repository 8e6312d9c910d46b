"""Serves the daemon's status over OPC UA, read-only."""

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from asyncua import Server
from asyncua.common.connection import TransportLimits

from fdhil.config import MachineConfig
from fdhil.errors import ConnectError
from fdhil.shopfloor.opcua_access import NAME, ReadOnlyServer, apply_security
from fdhil.shopfloor.opcua_address_space import AddressSpace
from fdhil.shopfloor.opcua_events import OpcUaMessages
from fdhil.shopfloor.publisher_process import report_ready
from fdhil.shopfloor.status_poller import StatusUpdate, poll_status

MOST_BYTES, MOST_CHUNKS = 1 << 20, 32  # per request
logging.getLogger("asyncua").setLevel(logging.CRITICAL)


class OpcUaPublisher:
    """A running server and its nodes."""

    def __init__(self, server: Server, nodes: AddressSpace, messages: OpcUaMessages) -> None:
        self._server, self._nodes, self._messages = server, nodes, messages

    @property
    def port(self) -> int:
        """The TCP port on which it listens."""
        return int(self._server.bserver._server.sockets[0].getsockname()[1])  # type: ignore[union-attr]

    async def publish_status(self, news: StatusUpdate) -> None:
        """Show the newest values and publish what began and ended."""
        await self._nodes.show_values(news)
        await self._messages.publish_events(news)


@asynccontextmanager
async def serve_opcua(config: MachineConfig) -> AsyncIterator[OpcUaPublisher]:
    """Serve until the block ends; ConnectError where it cannot listen or a file cannot be used."""
    settings = config.publish.opcua
    server = Server(iserver=ReadOnlyServer(settings))
    server.limits = TransportLimits(65535, 65535, MOST_CHUNKS, MOST_BYTES)
    server.set_server_name(f"fdhil: {config.machine.name}")
    server.product_uri, server.manufacturer_name = "urn:fdhil", "fdhil"
    await server.init()
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    server.set_endpoint(f"opc.tcp://{host}:{settings.port}")
    await apply_security(server, settings, f"urn:fdhil:{config.machine.name.replace(' ', '-')}")
    nodes = AddressSpace(server, config)
    await nodes.build_nodes()
    messages = OpcUaMessages(server, nodes)
    await messages.build_event_types()
    try:
        await server.start()
    except OSError as error:
        text = f"cannot listen at {settings.host}:{settings.port}: {error.strerror or error}"
        raise ConnectError(NAME, f"{text}; set another [publish.opcua] host or port") from None
    try:
        yield OpcUaPublisher(server, nodes, messages)
    finally:
        await server.stop()


async def publish(config: MachineConfig) -> None:
    """Serve until it is cancelled."""
    async with serve_opcua(config) as served:
        report_ready(f"OPC UA server at opc.tcp://{config.publish.opcua.host}:{served.port}")
        async for news in poll_status(config, config.publish.opcua.period_s):
            await served.publish_status(news)
