"""Fills the nodes of the companion specification: the machine's identification, and the running program.

Values unknown to fdhil have a bad quality there, and no default that could be mistaken for a fact: 0 is a mode, too.
"""

from collections.abc import AsyncIterator, Mapping
from typing import Any

from asyncua import Node, Server, ua

from fdhil.config import OpcUaServer
from fdhil.shopfloor.opcua_values import make_data_value, make_node_id, make_unknown_value
from fdhil.shopfloor.published_items import PublishedValue

DI = "http://opcfoundation.org/UA/DI/"
PRODUCTION_STATES = 24  # ProductionStateMachineType of MachineTool, whose components are the states
DOES: Mapping[str, str] = {"rapid": "Running", "feed": "Running", "arc": "Running", "hold": "Interrupted"}


class MachineToolNodes:
    """The standard nodes of one MachineTool."""

    def __init__(self, server: Server, machine: Node, machine_tool: int) -> None:
        self._server, self._machine, self._space = server, machine, machine_tool
        self._program: Node
        self._state: tuple[Node, Node, Node]  # CurrentState, its Id and its Number
        self._states: dict[str, tuple[ua.NodeId, int]] = {}

    async def build_nodes(self, settings: OpcUaServer) -> None:
        """Write the identification, and mark all activity as unknown."""
        await self._write_identification(settings)
        at = self._space
        for part in ("Monitoring", "Production"):
            async for node in _iterate_variables(await self._machine.get_child(f"{at}:{part}")):
                await self._server.write_attribute_value(
                    node.nodeid, make_unknown_value(ua.StatusCodes.BadNoDataAvailable, 0)
                )
        program = await self._machine.get_child([f"{at}:Production", f"{at}:ActiveProgram"])
        self._program = await program.get_child(f"{at}:Name")
        state = await program.get_child([f"{at}:State", "0:CurrentState"])
        self._state = state, await state.get_child("0:Id"), await state.get_child("0:Number")
        kinds = self._server.get_node(make_node_id(PRODUCTION_STATES, at))
        for name in set(DOES.values()):
            kind = await kinds.get_child(f"{at}:{name}")
            self._states[name] = kind.nodeid, await (await kind.get_child("0:StateNumber")).read_value()

    async def _write_identification(self, settings: OpcUaServer) -> None:
        di = await self._server.get_namespace_index(DI)
        place = await self._machine.get_child(f"{di}:Identification")
        values = {
            "Manufacturer": ua.Variant(ua.LocalizedText(settings.manufacturer)),
            "SerialNumber": ua.Variant(settings.serial_number, ua.VariantType.String),
            "ProductInstanceUri": ua.Variant(settings.product_instance_uri, ua.VariantType.String),
        }
        for name, variant in values.items():
            await (await place.get_child(f"{di}:{name}")).write_value(variant)

    async def show_value(self, value: PublishedValue, why: int) -> None:
        """Write a value to its node of the companion specification, if it has one; ``why`` it may be unknown."""
        if value.item.name == "nc_program":
            await self._server.write_attribute_value(self._program.nodeid, make_data_value(value, why))
        elif value.item.name == "nc_motion":
            await self._show_state(value, why)

    async def _show_state(self, value: PublishedValue, why: int) -> None:
        name = DOES.get(str(value.value))
        data_values = [make_unknown_value(why, value.stamp_ms)] * 3
        if name is not None:
            kind, number = self._states[name]
            variants: list[Any] = [
                ua.Variant(ua.LocalizedText(name, "en")),
                ua.Variant(kind, ua.VariantType.NodeId),
                ua.Variant(number, ua.VariantType.UInt32),
            ]
            stamp = data_values[0].SourceTimestamp
            data_values = [ua.DataValue(variant, SourceTimestamp=stamp) for variant in variants]
        for node, data in zip(self._state, data_values, strict=True):
            await self._server.write_attribute_value(node.nodeid, data)


async def _iterate_variables(top: Node) -> AsyncIterator[Node]:
    for child in await top.get_children():
        if await child.read_node_class() is ua.NodeClass.Variable:
            yield child
        async for below in _iterate_variables(child):
            yield below
