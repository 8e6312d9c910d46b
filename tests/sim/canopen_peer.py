"""The `canopen` library as the drive's peer: in one thread for speed, or over python-can's virtual bus."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can
import canopen

from fdhil.sim.drive.eds_writer import format_eds
from fdhil.sim.drive.servo_drive import SimulatedDrive
from fdhil.sim.frame_types import Frame


class LoopbackBus(can.BusABC):
    """A python-can bus without a wire: frames are answered before `send` returns."""

    def __init__(self, drive: SimulatedDrive) -> None:
        super().__init__("direct")
        self._is_shutdown = True  # nothing to shut down: no warning
        self.drive = drive
        self.network: canopen.Network | None = None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.deliver_frames(self.drive.receive_frame(msg.arbitration_id, bytes(msg.data)))

    def deliver_frames(self, frames: list[Frame]) -> None:
        assert self.network is not None
        for can_id, data in frames:
            self.network.notify(can_id, bytearray(data), 0.0)


def load_dictionary(drive: SimulatedDrive) -> canopen.ObjectDictionary:
    """Return `canopen`'s object dictionary of the drive's own EDS."""
    source = io.StringIO(format_eds(drive))
    source.name = "drive.eds"
    return canopen.import_od(source, drive.node_id)


def connect_directly(drive: SimulatedDrive) -> tuple[Any, LoopbackBus]:
    """Return a remote node (half of its methods are untyped) connected to a drive in the same thread."""
    bus = LoopbackBus(drive)
    network = canopen.Network(bus=bus)
    bus.network = network
    return network.add_node(drive.node_id, load_dictionary(drive)), bus


@contextmanager
def connect_over_virtual_bus(drive: SimulatedDrive) -> Iterator[Any]:
    """Return a remote node on a virtual CAN bus; a thread runs the drive's side."""
    channel = f"drive-{id(drive)}"
    wire = can.Bus(interface="virtual", channel=channel)
    running = threading.Event()
    running.set()

    def serve_drive() -> None:
        while running.is_set():
            message = wire.recv(timeout=0.05)
            if message is None:
                continue
            for can_id, data in drive.receive_frame(message.arbitration_id, bytes(message.data)):
                wire.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    thread = threading.Thread(target=serve_drive, name="drive")
    thread.start()
    network = canopen.Network()
    network.connect(interface="virtual", channel=channel)
    node = network.add_node(drive.node_id, load_dictionary(drive))
    node.sdo.RESPONSE_TIMEOUT = 60.0  # of a computer that is busy
    try:
        yield node
    finally:
        network.disconnect()
        running.clear()
        thread.join()
        wire.shutdown()
