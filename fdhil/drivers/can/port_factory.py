"""Opens the receive port that ``[bus.NAME] interface`` names."""

from collections.abc import Callable, Mapping, Sequence

from fdhil import config
from fdhil.drivers.can.python_can_port import PythonCanPort, VirtualPort
from fdhil.drivers.can.receive_port import Filter, ReceivePort
from fdhil.drivers.can.socketcan_port import SocketCanPort
from fdhil.drivers.can.socketcand_port import SocketcandPort

PORTS: Mapping[str, Callable[[str, config.CanBus, Sequence[Filter]], ReceivePort]] = {
    "socketcan": SocketCanPort,
    "socketcand": SocketcandPort,
    "virtual": VirtualPort,
}


def open_port(name: str, settings: config.CanBus, filters: Sequence[Filter] = ()) -> ReceivePort:
    """Return an open port; ConnectError with cause and next action. Interfaces without a port here use python-can."""
    return PORTS.get(settings.interface, PythonCanPort)(name, settings, filters)
