"""An unusable bus and a peer that is not a hub are reported in one sentence."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.config import CanBus
from fdhil.errors import ConnectError, ProtocolError
from fdhil.guard import __main__ as guard_main
from fdhil.guard.guard_settings import encode_settings
from tests.guard.drive_peer import open_bus
from tests.guard.simulated_bus import commissioned
from tests.guard.simulated_bus import settings as guard_settings


def test_unusable_bus_is_reported() -> None:
    with pytest.raises(ConnectError, match="inside one process"):
        open_bus("can0", CanBus(interface="virtual"))
    with pytest.raises(ConnectError, match="cannot be opened"):
        open_bus("can0", CanBus(interface="socketcan", channel="none9"))


@pytest.mark.parametrize(
    ("greeting", "error"), [(b"< hello >", ProtocolError), (b"", ConnectError), (b"x" * 300, ConnectError)]
)
def test_peer_that_is_not_a_hub_is_reported(greeting: bytes, error: type[Exception]) -> None:
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


def test_absent_hub_is_reported() -> None:
    with socket.socket() as nobody:  # has the port and does not listen there
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
        with pytest.raises(ConnectError, match=f"no hub answers at 127.0.0.1 port {port} .*start the hub first"):
            open_bus("can0", CanBus(port=port))


class RawSocket:
    """Replaces CAN_RAW where the kernel has none; tests/socketcan uses the real one."""

    def __init__(self, *family: int, up: bool) -> None:
        self.calls: list[Any] = [family]
        self.up = up

    def setsockopt(self, level: int, name: int, value: bytes) -> None:
        self.calls.append((level, name, value))

    def bind(self, address: tuple[str]) -> None:
        if not self.up:
            raise OSError(19, "No such device")
        self.calls.append(address)

    def close(self) -> None:
        self.calls.append("closed")


@pytest.mark.parametrize("up", [True, False])
def test_raw_socket_receives_nothing_before_the_guard_and_is_closed_on_error(
    up: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[RawSocket] = []

    def make(*family: int) -> RawSocket:
        made.append(RawSocket(*family, up=up))
        return made[0]

    monkeypatch.setattr(socket, "socket", make)
    if up:
        open_bus("can0", CanBus(interface="socketcan", channel="can7"))
    else:
        with pytest.raises(ConnectError, match=r"can7 cannot be opened \(No such device\); bring it up"):
            open_bus("can0", CanBus(interface="socketcan", channel="can7"))
    family = (socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    deaf = (socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
    assert made[0].calls == [family, deaf, ("can7",) if up else "closed"]


def run_main(monkeypatch: pytest.MonkeyPatch, settings: Path, descriptor: int) -> int:
    monkeypatch.setattr("sys.argv", ["fdhil.guard", "--settings", str(settings), "--descriptor", str(descriptor)])
    return guard_main.main()


@pytest.mark.usefixtures("handlers")
def test_unreadable_settings_are_reported_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "guard.json").write_text("{")
    near, far = socket.socketpair()
    with near, far:
        assert run_main(monkeypatch, tmp_path / "guard.json", near.fileno()) == 2
    assert capsys.readouterr().err.startswith("fdhil-guard: ")


@pytest.mark.usefixtures("handlers")
def test_invalid_descriptor_is_reported_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = commissioned(guard_settings())
    (tmp_path / "guard.json").write_text(encode_settings(replace(settings, run_directory=str(tmp_path))))
    with (tmp_path / "a file").open("wb") as file:
        assert run_main(monkeypatch, tmp_path / "guard.json", file.fileno()) == 3
    output = capsys.readouterr().err
    assert "cannot be used" in output
    assert "nothing was sent; start the guard with fdhil-guard" in output
