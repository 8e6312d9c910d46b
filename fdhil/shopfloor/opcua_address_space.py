"""Builds the address space: a MachineTool (OPC 40501-1) with fdhil's own values in it, each with its unit.

Node IDs are derived from the published items (``s=X.R_low``, ``s=state``, ``s=can0.bus_load``) and stay the same.
"""

from pathlib import Path

from asyncua import Node, Server, ua

from fdhil.config import MachineConfig
from fdhil.shopfloor.opcua_companion import MachineToolNodes
from fdhil.shopfloor.opcua_values import TYPES, ZEROS, make_data_value, make_node_id, make_unit
from fdhil.shopfloor.published_items import PublishedItem, list_published_values
from fdhil.shopfloor.status_poller import StatusUpdate, list_buses

NODESETS = Path(__file__).parent / "nodesets"
MACHINERY = "http://opcfoundation.org/UA/Machinery/"
MACHINE_TOOL = "http://opcfoundation.org/UA/MachineTool/"
OWN = "urn:fdhil:machine"
MACHINES, MACHINE_TOOL_TYPE, MESSAGES_TYPE = 1001, 13, 38  # of Machinery, MachineTool, MachineTool
FOLDER, ANALOG_UNIT, BASE_VARIABLE = ua.ObjectIds.FolderType, 17497, ua.ObjectIds.BaseDataVariableType


class AddressSpace:
    """The machine's nodes and the values they show."""

    def __init__(self, server: Server, config: MachineConfig) -> None:
        self._server, self._config = server, config
        self._values: dict[tuple[str, str, str], Node] = {}
        self._companion: MachineToolNodes
        self.machine: Node
        self.messages: Node
        self.own = 0
        self.machine_tool = 0

    async def build_nodes(self) -> None:
        """Load the companion specifications and create the machine."""
        for name in ("Di", "Machinery", "IA", "MachineTool"):
            await self._server.import_xml(str(NODESETS / f"Opc.Ua.{name}.NodeSet2.xml"))
        self.machine_tool = await self._server.get_namespace_index(MACHINE_TOOL)
        machinery = await self._server.get_namespace_index(MACHINERY)
        self.own = await self._server.register_namespace(OWN)
        own_name = ua.QualifiedName(self._config.machine.name, self.own)
        kind = make_node_id(MACHINE_TOOL_TYPE, self.machine_tool)
        machines = self._server.get_node(make_node_id(MACHINES, machinery))
        self.machine = await machines.add_object(
            make_node_id("machine", self.own), own_name, kind, instantiate_optional=False
        )
        await self._add_machine_tool()
        await self._add_values()

    async def _add_machine_tool(self) -> None:
        at = self.machine_tool
        notification = await self.machine.get_child(f"{at}:Notification")
        self.messages = await notification.add_object(
            make_node_id("messages", self.own), ua.QualifiedName("Messages", at), make_node_id(MESSAGES_TYPE, at)
        )
        self._companion = MachineToolNodes(self._server, self.machine, at)
        await self._companion.build_nodes(self._config.publish.opcua)

    async def _add_values(self) -> None:
        top = await self._add_folder(self.machine, "fdhil", "fdhil")
        places: dict[str, Node] = {"": top}
        for name in (*self._config.axis, *list_buses(self._config)):
            places[name] = await self._add_folder(top, name, name)
        for value in list_published_values(tuple(self._config.axis), list_buses(self._config), None, 0):
            where = value.axis or value.bus
            self._values[value.key] = await self._add_variable(places[where], value.item, where)

    async def _add_folder(self, parent: Node, identifier: str, name: str) -> Node:
        return await parent.add_object(
            make_node_id(identifier, self.own), ua.QualifiedName(name, self.own), make_node_id(FOLDER)
        )

    async def _add_variable(self, parent: Node, item: PublishedItem, where: str) -> Node:
        identifier = ".".join(filter(None, [where, item.name]))
        kind = TYPES[item.kind]
        name = ua.QualifiedName(item.name, self.own)
        node = await parent.add_variable(make_node_id(identifier, self.own), name, ZEROS[kind], kind)
        text = ua.LocalizedText(item.description + (f": {', '.join(item.choices)}" if item.choices else ""))
        await node.write_attribute(ua.AttributeIds.Description, ua.DataValue(ua.Variant(text)))
        if item.unit:
            await node.delete_reference(make_node_id(BASE_VARIABLE), ua.ObjectIds.HasTypeDefinition)
            await node.add_reference(make_node_id(ANALOG_UNIT), ua.ObjectIds.HasTypeDefinition)
            await node.add_property(
                make_node_id(f"{identifier}.unit", self.own),
                ua.QualifiedName("EngineeringUnits", 0),
                make_unit(item.unit),
            )
        return node

    async def show_values(self, news: StatusUpdate) -> None:
        """Write every value with its time; an unknown one has a bad quality with the reason."""
        why = ua.StatusCodes.BadNoCommunication if news.silent else ua.StatusCodes.BadNoDataAvailable
        for value in news.values:
            await self._server.write_attribute_value(self._values[value.key].nodeid, make_data_value(value, why))
            await self._companion.show_value(value, why)
