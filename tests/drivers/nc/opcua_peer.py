"""An OPC UA server with the nodes of a profile, by asyncua's own server."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from asyncua import Node, Server, ua
from asyncua.server.address_space import AttributeValue, NodeData
from asyncua.server.internal_server import InternalServer

from fdhil.drivers.nc.profile_file import read_nc_profile
from fdhil.records import MoveKind

logging.getLogger("asyncua").setLevel(logging.CRITICAL)
SHOWN = {  # of the profile siemens
    MoveKind.RAPID: (3, "G00"), MoveKind.FEED: (3, "G01"), MoveKind.ARC: (3, "G02"), MoveKind.HOLD: (2, "G00"),
    MoveKind.REST: (5, "G00"),
}  # fmt: skip
FIELDS = ("line", "feed_override", "rapid_override", "tool", "program", "feed_mm_min", "programmed_feed_mm_min")


class _QuickServer(InternalServer):
    """The nodes that every server has are made once, not for each: that takes seconds."""

    made: ClassVar[dict[ua.NodeId, NodeData]] = {}

    async def load_standard_address_space(self, shelf_file: Path | None = None) -> None:
        if not self.made:
            await super().load_standard_address_space()
            self.made.update(_copied(self.aspace._nodes))
        self.aspace._nodes = _copied(self.made)


def _copied(nodes: Mapping[ua.NodeId, NodeData]) -> dict[ua.NodeId, NodeData]:
    copies = {}
    for node_id, node in nodes.items():
        copies[node_id] = copy = NodeData(node_id)
        for key, attribute in node.attributes.items():
            copy.attributes[key] = mine = AttributeValue(attribute.value)  # type: ignore[arg-type]
            mine.value_callback, mine.value_setter = attribute.value_callback, attribute.value_setter
        copy.references, copy.call = list(node.references), node.call
    return copies


class OpcUaPeer:
    """A server of a Sinumerik's kind: the nodes are where the profile ``siemens`` says."""

    tells = frozenset(FIELDS)
    knows = frozenset(SHOWN)

    def __init__(self) -> None:
        self.nodes: dict[str, Node] = {}
        self._signals = read_nc_profile("siemens", "opcua").signals

    @property
    def settings(self) -> Mapping[str, Any]:
        return {"url": f"opc.tcp://127.0.0.1:{self.port}", "profile": "siemens", "period_s": 0.02, "timeout_s": 0.5}

    async def __aenter__(self) -> Self:
        self.server = Server(iserver=_QuickServer())
        await self.server.init()
        self.server.set_endpoint("opc.tcp://127.0.0.1:0")
        self.server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
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

    async def say(self, motion: MoveKind, **fields: Any) -> None:
        for name, value in fields.items():
            await self.nodes[name].write_value(value if isinstance(value, str) else value / self._signals[name].scale)
        status, function = SHOWN[motion]
        await self.nodes["g_group_1"].write_value(function)
        await self.nodes["status"].write_value(float(status))

    async def talk_nonsense(self) -> None:
        await self.nodes["feed_override"].write_value(1e9)
        await self.nodes["status"].write_value(3.0)
