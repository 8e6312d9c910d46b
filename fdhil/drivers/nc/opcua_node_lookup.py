"""Finds the nodes of a server by the places in a profile."""

from collections.abc import Iterable, Mapping

from asyncua import Client, ua
from asyncua.ua.uaerrors import UaError

from fdhil.errors import ConfigError, ConfigFault

MOST_BROWSED = 500  # nodes that are looked into before a path is given up
NAMED = "nsu="
PATH = "Objects/"


class _Browser:
    def __init__(self, client: Client) -> None:
        self._client = client
        self._below: dict[ua.NodeId, list[tuple[str, ua.NodeId]]] = {}

    async def find_path(self, node: ua.NodeId, names: list[str]) -> ua.NodeId | None:
        """Return the first node to which these browse names lead (``*`` is any), None where there is none."""
        if not names:
            return node
        for name, below in await self._read_children(node):
            if names[0] in ("*", name) and (found := await self.find_path(below, names[1:])) is not None:
                return found
        return None

    async def _read_children(self, node: ua.NodeId) -> list[tuple[str, ua.NodeId]]:
        if node not in self._below:
            if len(self._below) >= MOST_BROWSED:
                return []
            references = await self._client.get_node(node).get_references(
                ua.ObjectIds.HierarchicalReferences, ua.BrowseDirection.Forward
            )
            self._below[node] = list(_name_references(references))
        return self._below[node]


def _name_references(references: Iterable[ua.ReferenceDescription]) -> Iterable[tuple[str, ua.NodeId]]:
    for reference in references:
        if reference.BrowseName is not None and reference.BrowseName.Name is not None:
            yield reference.BrowseName.Name, reference.NodeId


def check_places(places: Mapping[str, str], source: str) -> None:
    """Raise ConfigError with every place that is neither a node id nor a path."""
    faults = []
    for name, at in places.items():
        try:
            if not at.startswith(PATH):
                ua.NodeId.from_string(at.partition(";")[2] if at.startswith(NAMED) else at)
        except (UaError, ValueError):
            advice = "'ns=2;s=NAME', 'nsu=URI;s=NAME' or 'Objects/NAME/NAME'"
            faults.append(ConfigFault(f"signals.{name}.at", f"{at[:60]!r} is not an OPC UA node or path", advice))
    if faults:
        raise ConfigError(f"NC profile {source}", faults)


async def find_nodes(client: Client, places: Mapping[str, str]) -> dict[str, ua.NodeId]:
    """Return the node of each existing place: a node id, one with ``nsu=URI;`` in front, or a path of browse names from
    ``Objects/`` on."""
    browser, found = _Browser(client), {}
    spaces = await client.get_namespace_array() if any(at.startswith(NAMED) for at in places.values()) else []
    for name, at in places.items():
        if at.startswith(PATH):
            objects = client.nodes.objects.nodeid
            node = await browser.find_path(objects, at.removeprefix(PATH).split("/"))
        else:
            node = _parse_node_id(at, spaces)
        if node is not None:
            found[name] = node
    return found


def _parse_node_id(at: str, spaces: list[str]) -> ua.NodeId | None:
    if at.startswith(NAMED):
        uri, _, rest = at.removeprefix(NAMED).partition(";")
        if uri not in spaces:
            return None
        at = f"ns={spaces.index(uri)};{rest}"
    return ua.NodeId.from_string(at)
