"""A default installation on an active bus: the daemon's real process, observed on the bus and by the kernel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.processes import ChildProcess
from fdhil.daemon.daemon_socket import SOCKET_NAME, ask_daemon
from fdhil.errors import DeviceError
from tests.guard.drive_peer import Peer, hold_demand, write_config
from tests.listening_ports import list_tcp_ports

pytestmark = pytest.mark.usefixtures("processes")

CYCLES = 500


@pytest.fixture
def peer() -> Iterator[Peer]:
    with hold_demand() as made:
        yield made


@pytest.mark.goal("R15")
def test_default_daemon_sends_no_frame_and_opens_no_port(
    peer: Peer, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    config = write_config(tmp_path, peer.port, corrected=False)
    socket = machine_config.load_config(config).run_directory / SOCKET_NAME

    def listening() -> bool:
        try:
            return bool(ask_daemon(socket, {"request": "status"})["source"]["state"] == "listening")
        except DeviceError:
            return False

    daemon = ChildProcess("daemon", ["fdhil", "run", str(config)], tmp_path / "daemon.log")
    try:
        peer.wait(listening, "the daemon")
        first = peer.tick
        peer.wait(lambda: peer.tick > first + CYCLES, "the cycles")
        assert ask_daemon(socket, {"request": "arm", "token": "any"})["ok"] is False
        ports = list_tcp_ports(daemon.pid)
    finally:
        daemon.stop()
    assert (peer.sent, ports) == ([], set())
    record_property("goal", f"{len(peer.sent)} frames sent, {len(ports)} TCP ports listened at, in {peer.tick:,} SYNC")
