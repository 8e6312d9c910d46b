"""Serves the daemon's status over OPC UA, read-only."""

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from asyncua import Server
from asyncua.common.connection import TransportLimits

from fdhil.config import MachineConfig
from fdhil.errors import ConnectError
from fdhil.shopfloor.news import News, listen
from fdhil.shopfloor.opcua_events import Messages
from fdhil.shopfloor.opcua_nodes import Nodes
from fdhil.shopfloor.opcua_security import NAME, ReadServer, secure
from fdhil.shopfloor.process import say_ready

MOST_BYTES, MOST_CHUNKS = 1 << 20, 32  # per request
logging.getLogger("asyncua").setLevel(logging.CRITICAL)


class Served:
    """A running server and its nodes."""

    def __init__(self, server: Server, nodes: Nodes, messages: Messages) -> None:
        self._server, self._nodes, self._messages = server, nodes, messages

    @property
    def port(self) -> int:
        """The TCP port on which it listens."""
        return int(self._server.bserver._server.sockets[0].getsockname()[1])  # type: ignore[union-attr]

    async def tell(self, news: News) -> None:
        """Show the newest values and publish what began and ended."""
        await self._nodes.show(news)
        await self._messages.tell(news)


@asynccontextmanager
async def serving(config: MachineConfig) -> AsyncIterator[Served]:
    """Serve until the block ends; ConnectError where it cannot listen or a file cannot be used."""
    settings = config.publish.opcua
    server = Server(iserver=ReadServer(settings))
    server.limits = TransportLimits(65535, 65535, MOST_CHUNKS, MOST_BYTES)
    server.set_server_name(f"fdhil: {config.machine.name}")
    server.product_uri, server.manufacturer_name = "urn:fdhil", "fdhil"
    await server.init()
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    server.set_endpoint(f"opc.tcp://{host}:{settings.port}")
    await secure(server, settings, f"urn:fdhil:{config.machine.name.replace(' ', '-')}")
    nodes = Nodes(server, config)
    await nodes.build()
    messages = Messages(server, nodes)
    await messages.build()
    try:
        await server.start()
    except OSError as error:
        text = f"cannot listen at {settings.host}:{settings.port}: {error.strerror or error}"
        raise ConnectError(NAME, f"{text}; set another [publish.opcua] host or port") from None
    try:
        yield Served(server, nodes, messages)
    finally:
        await server.stop()


async def publish(config: MachineConfig) -> None:
    """Serve until it is cancelled."""
    async with serving(config) as served:
        say_ready(f"OPC UA server at opc.tcp://{config.publish.opcua.host}:{served.port}")
        async for news in listen(config, config.publish.opcua.period_s):
            await served.tell(news)
