"""A hub in a thread, as in the simulator's loop, and the stock client that joins it."""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can

from fdhil.sim.frame_types import Frame
from fdhil.sim.wire.tcp_hub import TcpHub


class HubThread(threading.Thread):
    """Serves a hub until stopped; ``twin`` is called in the hub's thread with every received frame."""

    def __init__(self, hub: TcpHub, twin: Callable[[TcpHub, Frame], None] = lambda hub, frame: None) -> None:
        super().__init__(name="hub")
        self.hub = hub
        self.each_turn: Callable[[TcpHub], None] = lambda hub: None
        self._twin = twin
        self._ending = False

    def run(self) -> None:
        while not self._ending:
            ready, _, _ = select.select(self.hub.list_readers(), self.hub.list_writers(), (), 0.002)
            self.hub.receive_frames(ready, lambda frame: self._twin(self.hub, frame))
            self.each_turn(self.hub)
            self.hub.flush_frames(time.monotonic())

    def stop(self) -> None:
        self._ending = True
        self.join()
        self.hub.close()


@contextmanager
def run_hub(hub: TcpHub, twin: Callable[[TcpHub, Frame], None] = lambda hub, frame: None) -> Iterator[HubThread]:
    thread = HubThread(hub, twin)
    thread.start()
    try:
        yield thread
    finally:
        thread.stop()


@contextmanager
def join_clients(hub: TcpHub, count: int = 1) -> Iterator[list[can.BusABC]]:
    buses: list[can.BusABC] = []
    try:
        for _ in range(count):
            buses.append(can.Bus(interface="socketcand", channel="can0", host=hub.host, port=hub.port))
        yield buses
    finally:
        for bus in buses:
            bus.shutdown()


def receive_frames(bus: can.BusABC, count: int, timeout_s: float = 100.0) -> list[Frame]:
    """Receive ``count`` frames, fewer on a time-out."""
    frames: list[Frame] = []
    deadline = time.monotonic() + timeout_s
    while len(frames) < count and time.monotonic() < deadline:
        message = bus.recv(0.2)
        if message is not None:
            frames.append((message.arbitration_id, bytes(message.data)))
    return frames
