"""Builds the address space: a MachineTool (OPC 40501-1) with fdhil's own values in it, each with its unit.

Node IDs are derived from the published items (``s=X.R_low``, ``s=state``, ``s=can0.bus_load``) and stay the same.
"""

from pathlib import Path

from asyncua import Node, Server, ua

from fdhil.config import MachineConfig
from fdhil.shopfloor.news import News, buses
from fdhil.shopfloor.opcua_companion import Companion
from fdhil.shopfloor.opcua_shown import TYPES, ZEROS, node_id, shown, unit_of
from fdhil.shopfloor.published import Item, published

NODESETS = Path(__file__).parent / "nodesets"
MACHINERY = "http://opcfoundation.org/UA/Machinery/"
MACHINE_TOOL = "http://opcfoundation.org/UA/MachineTool/"
OWN = "urn:fdhil:machine"
MACHINES, MACHINE_TOOL_TYPE, MESSAGES_TYPE = 1001, 13, 38  # of Machinery, MachineTool, MachineTool
FOLDER, ANALOG_UNIT, BASE_VARIABLE = ua.ObjectIds.FolderType, 17497, ua.ObjectIds.BaseDataVariableType


class Nodes:
    """The machine's nodes and the values they show."""

    def __init__(self, server: Server, config: MachineConfig) -> None:
        self._server, self._config = server, config
        self._values: dict[tuple[str, str, str], Node] = {}
        self._companion: Companion
        self.machine: Node
        self.messages: Node
        self.own = 0
        self.machine_tool = 0

    async def build(self) -> None:
        """Load the companion specifications and create the machine."""
        for name in ("Di", "Machinery", "IA", "MachineTool"):
            await self._server.import_xml(str(NODESETS / f"Opc.Ua.{name}.NodeSet2.xml"))
        self.machine_tool = await self._server.get_namespace_index(MACHINE_TOOL)
        machinery = await self._server.get_namespace_index(MACHINERY)
        self.own = await self._server.register_namespace(OWN)
        own_name = ua.QualifiedName(self._config.machine.name, self.own)
        kind = node_id(MACHINE_TOOL_TYPE, self.machine_tool)
        machines = self._server.get_node(node_id(MACHINES, machinery))
        self.machine = await machines.add_object(
            node_id("machine", self.own), own_name, kind, instantiate_optional=False
        )
        await self._companions()
        await self._lay_out()

    async def _companions(self) -> None:
        at = self.machine_tool
        notification = await self.machine.get_child(f"{at}:Notification")
        self.messages = await notification.add_object(
            node_id("messages", self.own), ua.QualifiedName("Messages", at), node_id(MESSAGES_TYPE, at)
        )
        self._companion = Companion(self._server, self.machine, at)
        await self._companion.build(self._config.publish.opcua)

    async def _lay_out(self) -> None:
        top = await self._folder(self.machine, "fdhil", "fdhil")
        places: dict[str, Node] = {"": top}
        for name in (*self._config.axis, *buses(self._config)):
            places[name] = await self._folder(top, name, name)
        for value in published(tuple(self._config.axis), buses(self._config), None, 0):
            where = value.axis or value.bus
            self._values[value.key] = await self._variable(places[where], value.item, where)

    async def _folder(self, parent: Node, identifier: str, name: str) -> Node:
        return await parent.add_object(node_id(identifier, self.own), ua.QualifiedName(name, self.own), node_id(FOLDER))

    async def _variable(self, parent: Node, item: Item, where: str) -> Node:
        identifier = ".".join(filter(None, [where, item.name]))
        kind = TYPES[item.kind]
        name = ua.QualifiedName(item.name, self.own)
        node = await parent.add_variable(node_id(identifier, self.own), name, ZEROS[kind], kind)
        text = ua.LocalizedText(item.description + (f": {', '.join(item.choices)}" if item.choices else ""))
        await node.write_attribute(ua.AttributeIds.Description, ua.DataValue(ua.Variant(text)))
        if item.unit:
            await node.delete_reference(node_id(BASE_VARIABLE), ua.ObjectIds.HasTypeDefinition)
            await node.add_reference(node_id(ANALOG_UNIT), ua.ObjectIds.HasTypeDefinition)
            await node.add_property(
                node_id(f"{identifier}.unit", self.own), ua.QualifiedName("EngineeringUnits", 0), unit_of(item.unit)
            )
        return node

    async def show(self, news: News) -> None:
        """Write every value with its time; an unknown one has a bad quality with the reason."""
        why = ua.StatusCodes.BadNoCommunication if news.silent else ua.StatusCodes.BadNoDataAvailable
        for value in news.values:
            await self._server.write_attribute_value(self._values[value.key].nodeid, shown(value, why))
            await self._companion.show(value, why)
