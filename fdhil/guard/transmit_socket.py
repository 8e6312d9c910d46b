"""Opens the descriptor on which the guard sends: CAN_RAW, or a hub that speaks socketcand."""

import socket
import time
from typing import Protocol

from fdhil.errors import ConnectError, ProtocolError

CONNECT_S = 5.0


class BusAddress(Protocol):
    """Address of a bus: the network interface ``channel``, or the channel of a hub."""

    @property
    def interface(self) -> str:
        """``socketcan`` or ``socketcand``; on other interfaces nothing can be sent."""

    @property
    def channel(self) -> str:
        """The network interface, or the bus behind the hub."""

    @property
    def host(self) -> str:
        """The hub's address."""

    @property
    def port(self) -> int:
        """The hub's TCP port."""


def open_transmit_socket(name: str, bus: BusAddress) -> socket.socket:
    """Open the transmit descriptor; a hub needs ``greet_hub`` after it. ConnectError when the bus is unavailable."""
    if bus.interface == "socketcan":
        return _open_can_raw(name, bus.channel)
    if bus.interface == "socketcand":
        try:
            return socket.create_connection((bus.host, bus.port), timeout=CONNECT_S)
        except OSError as error:
            text = f"no hub answers at {bus.host} port {bus.port} ({error.strerror or error}); start the hub first"
            raise ConnectError(f"bus {name}", text) from None
    why = "exists inside one process only" if bus.interface == "virtual" else "is for listening only"
    text = f"the interface {bus.interface!r} {why}; set socketcan or socketcand"
    raise ConnectError(f"bus {name}", text)


def _open_can_raw(name: str, channel: str) -> socket.socket:
    raw = None
    try:
        raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        raw.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # earlier frames are outdated
        raw.bind((channel,))
    except OSError as error:
        if raw is not None:
            raw.close()
        text = f"the CAN interface {channel} cannot be opened ({error.strerror}); bring it up with ip link"
        raise ConnectError(f"bus {name}", text) from None
    return raw


def greet_hub(name: str, bus: BusAddress, hub: socket.socket) -> None:
    """Perform the greeting of a hub, byte by byte, so that no frame is lost."""
    if bus.interface != "socketcand":
        return
    deadline_s = time.monotonic() + CONNECT_S
    hub.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    try:
        _expect_word(hub, "hi", deadline_s)
        for command in (f"open {bus.channel}", "rawmode"):
            hub.sendall(f"< {command} >".encode("ascii"))
            _expect_word(hub, "ok", deadline_s)
    except OSError as error:
        hub.close()
        text = f"the hub at {bus.host} port {bus.port} ended the greeting ({error}); check that it is a socketcand"
        raise ConnectError(f"bus {name}", text) from None


def _expect_word(hub: socket.socket, word: str, deadline_s: float) -> None:
    answer = b""
    while not answer.endswith(b">"):
        hub.settimeout(max(0.001, deadline_s - time.monotonic()))
        byte = hub.recv(1)
        if not byte or len(answer) > 200:
            raise ConnectionError("connection closed")
        answer += byte
    if answer.split() != [b"<", word.encode(), b">"]:
        hub.close()
        shown = answer.decode("ascii", "replace")
        raise ProtocolError("hub", f"answered {shown!r} where '< {word} >' belongs; check [bus] channel and port")
