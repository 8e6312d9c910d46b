"""A CANopen slave made with the canopen library's LocalNode: a process of its own without any code of fdhil."""

from __future__ import annotations

import json
import sys
from typing import Any

import canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

TYPES = {
    "INTEGER8": datatypes.INTEGER8,
    "INTEGER16": datatypes.INTEGER16,
    "INTEGER32": datatypes.INTEGER32,
    "UNSIGNED8": datatypes.UNSIGNED8,
    "UNSIGNED16": datatypes.UNSIGNED16,
    "UNSIGNED32": datatypes.UNSIGNED32,
    "VISIBLE_STRING": datatypes.VISIBLE_STRING,
}


def add_variable(name: str, index: int, sub: int, kind: str, value: Any) -> ODVariable:
    """Return an entry of the object dictionary."""
    made = ODVariable(name, index, sub)
    made.data_type, made.access_type, made.default, made.value = TYPES[kind], "rw", value, value
    return made


def add_record(index: int, name: str, *members: tuple[str, Any]) -> ODRecord:
    """Return a record whose members are (type, value) from sub-index 1 on."""
    made = ODRecord(name, index)
    for sub, (kind, value) in enumerate([("UNSIGNED8", len(members)), *members]):
        made.add_member(add_variable(f"{name} {sub}", index, sub, kind, value))
    return made


def count_bits(kind: str) -> int:
    """Return the length of an integer type."""
    return int("".join(filter(str.isdigit, kind)))


def build_dictionary(settings: dict[str, Any]) -> Any:
    """Return the object dictionary that the settings describe."""
    made: Any = canopen.ObjectDictionary
    od = made()
    node = settings["node"]
    od.add_object(add_record(0x1018, "Identity", *(("UNSIGNED32", number) for number in settings["identity"].values())))
    od.add_object(add_variable("Name", 0x1008, 0, "VISIBLE_STRING", settings["name"]))
    od.add_object(add_variable("Heartbeat", 0x1017, 0, "UNSIGNED16", settings["heartbeat_ms"]))
    kinds = {index: kind for index, _, kind, _ in settings["objects"]}
    for index, name, kind, value in settings["objects"]:
        od.add_object(add_variable(name, index, 0, kind, value))
    for number, pdo in enumerate(settings["tpdos"]):
        parameters = [("UNSIGNED32", pdo["cobId"] + node), ("UNSIGNED8", pdo["kind"])]
        od.add_object(add_record(0x1800 + number, "TPDO", *parameters))
        mapped = [("UNSIGNED32", index << 16 | count_bits(kinds[index])) for index in pdo["objects"]]
        od.add_object(add_record(0x1A00 + number, "Mapping", *mapped))
    return od


def main() -> None:
    """Serve until standard input ends."""
    settings = json.loads(sys.argv[1])
    network: Any = canopen.Network()
    network.connect(**settings["bus"])
    node: Any = canopen.LocalNode(settings["node"], build_dictionary(settings))
    network.add_node(node)
    node.tpdo.read()

    def at_sync(*_: Any) -> None:
        if node.nmt.state == "OPERATIONAL":
            for pdo in node.tpdo.values():
                pdo.transmit()

    network.subscribe(0x80, at_sync)
    node.nmt.send_command(0)  # boot-up, then pre-operational
    print(json.dumps({"event": "ready"}), flush=True)  # noqa: T201
    sys.stdin.read()
    network.disconnect()


if __name__ == "__main__":
    main()
