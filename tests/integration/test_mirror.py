"""The daemon's copy of the bus is one-way: it receives everything, and its frames reach no drive.

The commands are those of ``fdhil-mirror@.service`` (`make test-vcan`; needs Debian's can-utils).
"""

from __future__ import annotations

import shutil
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.socketcan
UNIT = Path(__file__).parents[2] / "systemd" / "fdhil-mirror@.service"
BUS = "vcan0"
DAEMON = """
import socket, struct, sys
with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
    raw.bind(("vcan0",))
    print("ready", flush=True)
    for _ in range(3):
        print(struct.unpack("=IB3x8s", raw.recv(16))[0], flush=True)
    for cob_id in (0x301, 0x000, 0x080, 0x601):
        raw.send(struct.pack("=IB3x8s", cob_id, 4, b"\\xff\\xff\\x00\\x00"))
"""


def commands(key: str) -> list[list[str]]:
    lines = [line.partition("=")[2] for line in UNIT.read_text().splitlines() if line.startswith(f"{key}=/")]
    return [[shutil.which(Path(word).name) or word if k == 0 else word.replace("%i", BUS)
             for k, word in enumerate(line.split())] for line in lines]  # fmt: skip


@pytest.fixture
def mirror() -> Iterator[None]:
    assert shutil.which("cangw"), "needs Debian's can-utils"
    for command in commands("ExecStart"):
        subprocess.run(command, check=True)
    yield
    for command in commands("ExecStop"):
        subprocess.run(command, check=True)


def test_daemon_receives_from_a_mirror_bus_and_cannot_send(mirror: None) -> None:
    command = ["ip", "netns", "exec", "fdhil", sys.executable, "-c", DAEMON]
    with (
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as daemon,
    ):
        raw.bind((BUS,))
        assert daemon.stdout is not None
        assert daemon.stdout.readline() == "ready\n"
        for cob_id in (0x181, 0x080, 0x201):
            raw.send(struct.pack("=IB3x8s", cob_id, 1, b"\x01"))
        assert [int(line) for line in daemon.stdout] == [0x181, 0x080, 0x201]
        assert daemon.wait() == 0
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as other:
            other.bind((BUS,))
            other.send(struct.pack("=IB3x8s", 0x7FF, 0, b""))  # whatever came before it would be heard before it
        assert struct.unpack("=IB3x8s", raw.recv(16))[0] == 0x7FF
