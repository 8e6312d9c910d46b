"""A bus that cannot be opened, and a peer that is no hub, are told in one sentence."""

from __future__ import annotations

import socket

import pytest

from fdhil.config import CanBus
from fdhil.errors import ConnectError, ProtocolError
from tests.guard.peer import open_bus


def test_buses_that_cannot_be_opened() -> None:
    with pytest.raises(ConnectError, match="inside one process"):
        open_bus("can0", CanBus(interface="virtual"))
    with pytest.raises(ConnectError, match="cannot be opened"):
        open_bus("can0", CanBus(interface="socketcan", channel="none9"))


@pytest.mark.parametrize(
    ("greeting", "error"), [(b"< hello >", ProtocolError), (b"", ConnectError), (b"x" * 300, ConnectError)]
)
def test_a_peer_that_is_no_hub(greeting: bytes, error: type[Exception]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        import threading

        def greet() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(greeting)

        thread = threading.Thread(target=greet)
        thread.start()
        with pytest.raises(error):
            open_bus("can0", CanBus(port=server.getsockname()[1]))
        thread.join()
