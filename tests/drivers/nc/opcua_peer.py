"""An OPC UA server with the nodes of a profile, served by asyncua."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from asyncua import Node, Server, ua
from asyncua.server.address_space import AttributeValue, NodeData
from asyncua.server.internal_server import InternalServer

from fdhil.drivers.nc.nc_profile_file import read_nc_profile
from fdhil.records import MoveKind

logging.getLogger("asyncua").setLevel(logging.CRITICAL)
SHOWN = {  # of the profile siemens
    MoveKind.RAPID: (3, "G00"), MoveKind.FEED: (3, "G01"), MoveKind.ARC: (3, "G02"), MoveKind.HOLD: (2, "G00"),
    MoveKind.REST: (5, "G00"),
}  # fmt: skip
FIELDS = ("line", "feed_override", "rapid_override", "tool", "program", "feed_mm_min", "programmed_feed_mm_min")


class _Nodes(dict[ua.NodeId, NodeData]):
    """Nodes that are copied from those of ``made`` on first access."""

    made: ClassVar[dict[ua.NodeId, NodeData]] = {}

    def __contains__(self, key: object) -> bool:
        return super().__contains__(key) or key in self.made

    def __missing__(self, key: ua.NodeId) -> NodeData:
        node = self.made[key]
        self[key] = copy = NodeData(key)
        for name, attribute in node.attributes.items():
            copy.attributes[name] = mine = AttributeValue(attribute.value)  # type: ignore[arg-type]
            mine.value_callback, mine.value_setter = attribute.value_callback, attribute.value_setter
        copy.references, copy.call = list(node.references), node.call
        return copy

    def get(self, key: ua.NodeId, default: Any = None) -> Any:
        return self[key] if key in self else default  # noqa: SIM401 (it is this that get is made of)


async def load_once(server: InternalServer, shelf_file: Path | None = None) -> None:
    """Give a server the standard nodes, which are created once for all servers: it takes seconds."""
    if not _Nodes.made:
        await InternalServer.load_standard_address_space(server)
        _Nodes.made.update(server.aspace._nodes)
    server.aspace._nodes = _Nodes()


class _QuickServer(InternalServer):
    load_standard_address_space = load_once


class OpcUaPeer:
    """A server like a Sinumerik's: the nodes are those of the profile ``siemens``."""

    tells = frozenset(FIELDS)
    knows = frozenset(SHOWN)

    def __init__(self, secure: tuple[Path, Path] | None = None, users: Any = None) -> None:
        self._secure, self._users = secure, users  # certificate and key
        self.nodes: dict[str, Node] = {}
        self._signals = read_nc_profile("siemens", "opcua").signals

    @property
    def settings(self) -> Mapping[str, Any]:
        return {"url": f"opc.tcp://127.0.0.1:{self.port}", "profile": "siemens", "period_s": 0.02, "timeout_s": 60.0}

    async def __aenter__(self) -> Self:
        self.server = Server(iserver=_QuickServer(self._users))
        await self.server.init()
        self.server.set_endpoint("opc.tcp://127.0.0.1:0")
        self.server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        if self._secure is not None:
            self.server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
            await self.server.load_certificate(self._secure[0])
            await self.server.load_private_key(self._secure[1])
        await self.server.register_namespace("SinumerikVarProvider")
        first = {"program": "", "g_group_1": "G00"}
        for name, signal in self._signals.items():
            node_id = ua.NodeId.from_string(signal.at)
            browse = ua.QualifiedName(name, 2)
            value = first.get(name, 0.0)
            self.nodes[name] = await self.server.nodes.objects.add_variable(node_id, browse, value)
        await self.server.start()
        assert self.server.bserver is not None
        assert isinstance(self.server.bserver._server, asyncio.Server)
        self.port = self.server.bserver._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *exception: object) -> None:
        await self.server.stop()

    async def set_state(self, motion: MoveKind, **fields: Any) -> None:
        for name, value in fields.items():
            await self.nodes[name].write_value(value if isinstance(value, str) else value / self._signals[name].scale)
        status, function = SHOWN[motion]
        await self.nodes["g_group_1"].write_value(function)
        await self.nodes["status"].write_value(float(status))

    async def send_invalid_data(self) -> None:
        await self.nodes["feed_override"].write_value(1e9)
        await self.nodes["status"].write_value(3.0)
