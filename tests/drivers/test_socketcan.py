"""The raw socket on a real SocketCAN interface (vcan0): order, kernel stamps, the kernel's drops counted exactly."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator

import numpy as np
import pytest

from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import CanBus as BusSettings
from fdhil.drivers.can.bus import CanBus
from fdhil.drivers.can.frames import FrameRing
from fdhil.drivers.can.socketcan import SocketCanPort

pytestmark = pytest.mark.socketcan
SETTINGS = BusSettings(interface="socketcan", channel="vcan0")


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind(("vcan0",))
        yield raw


def send(raw: socket.socket, number: int, can_id: int = 0x181) -> None:
    raw.send(struct.pack("=IB3x8s", can_id, 8, struct.pack("<Q", number)))


def test_frames_come_in_order_with_stamps_of_the_kernel(sender: socket.socket) -> None:
    with CanBus("can0", SETTINGS) as bus:
        time.sleep(0.05)
        before = time.monotonic_ns()
        for number in range(2000):
            send(sender, number)
            if number % 100 == 0:
                time.sleep(0.002)
        after = time.monotonic_ns()
        while bus.counters()["frames"] < 2000:
            time.sleep(0.01)
        frames = bus.drain()
        counters = bus.counters()
    assert frames["data"].tolist() == list(range(2000))
    assert counters["lost"] == 0
    stamps = frames["t_ns"].tolist()
    assert min(np.diff(stamps)) > -100_000  # the wall clock is followed slowly, never by a jump
    assert before - 2_000_000 < stamps[0] <= stamps[-1] < after + 2_000_000


def test_what_the_kernel_dropped_is_counted_exactly(sender: socket.socket) -> None:
    port = SocketCanPort("can0", SETTINGS)
    port._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    ring = FrameRing(1 << 14)
    for number in range(600):
        send(sender, number)
    for _ in range(5):
        port.receive(ring, 0.05)
    send(sender, 600)  # the drop count comes with the next frame
    port.receive(ring, 0.5)
    got = ring.drain().size
    assert port.kernel_drops > 0
    assert got + port.kernel_drops == 601
    port.close()


def test_what_is_sent_arrives(sender: socket.socket) -> None:
    with TransmitBus("can0", SETTINGS) as bus:
        bus.send(0x601, b"\x40\x18\x10")
        can_id, length, data = struct.unpack("=IB3x8s", sender.recv(16))
    assert (can_id, data[:length]) == (0x601, b"\x40\x18\x10")
