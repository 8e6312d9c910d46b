"""Receives from one CAN bus: a thread only appends to a ring, and the reader drains that in blocks.

Nothing here sends: ``fdhil.commissioning.transmit`` does, which no other package may import.
"""

import threading
import time
from collections.abc import Sequence
from typing import Protocol, Self

from fdhil import config
from fdhil.drivers.can.filters import filter_frames
from fdhil.drivers.can.frame_ring import DEFAULT_RING_FRAMES, FrameRing, Frames
from fdhil.drivers.can.port_factory import open_port
from fdhil.drivers.can.receive_port import BusEnded, Filter, ReceivePort, Stamps

POLL_S = 0.05
# frames are read every 10 ms: a thread that wakes for each one costs more than all the decoding, the
# stamps come from the kernel or the hub, and even the smallest receive buffer holds three times as many
BATCH_S = 0.010
HOLD_BACK_S = 0.001


class FrameReader(Protocol):
    """A bus as its reader sees it: frames in blocks."""

    last_frame_ns: int

    @property
    def end_reason(self) -> str | None:
        """Why no more frames come; None while the bus is alive."""

    @property
    def stamps(self) -> Stamps:
        """Source of the newest frames' time stamps."""

    def drain_frames(self) -> Frames:
        """Return all frames received since the last call that pass the filters, in order of arrival."""

    def read_counters(self) -> dict[str, int]:
        """Return frames received, and lost in the ring and in the kernel."""

    def close(self) -> None:
        """Release the bus."""


class BusOpener(Protocol):
    """Opens a bus for listening; ConnectError with cause and next action."""

    def __call__(self, name: str, settings: config.CanBus, *, filters: Sequence[Filter] = ()) -> FrameReader:
        """Return the open, receiving bus."""


class ListeningBus:
    """A bus that is received from; a context manager.

    ``end_reason`` is the reason why the receive thread stopped (None while it runs).
    """

    batch_s = BATCH_S

    def __init__(
        self, name: str, settings: config.CanBus, ring_frames: int = DEFAULT_RING_FRAMES, filters: Sequence[Filter] = ()
    ) -> None:
        self.name = name
        self.end_reason: str | None = None
        self._filters = filters
        self._port = self._open_port(settings, filters)
        self._ring_frames = ring_frames
        self._ring = self._make_ring(ring_frames)
        self._stopping = threading.Event()
        self.last_frame_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._receive_frames, name=f"fdhil-{name}", daemon=True)
        self._thread.start()

    def _open_port(self, settings: config.CanBus, filters: Sequence[Filter]) -> ReceivePort:
        return open_port(self.name, settings, filters)

    def _make_ring(self, frames: int) -> FrameRing:
        return FrameRing(frames)

    @property
    def stamps(self) -> Stamps:
        return self._port.stamps

    def _receive_frames(self) -> None:
        try:
            while not self._stopping.is_set():
                if self._port.holds_back and 2 * self._ring.free_slots < self._ring_frames:
                    time.sleep(HOLD_BACK_S)  # unread frames wait in the hub
                    continue
                self._port.receive_frames(self._ring, POLL_S)
                time.sleep(self.batch_s)
        except BusEnded as end:
            self.end_reason = str(end)

    def drain_frames(self) -> Frames:
        frames = filter_frames(self._ring.drain_frames(), self._filters)  # some bus interfaces have no filters
        if frames.size:
            self.last_frame_ns = int(frames["t_ns"][-1])
        return frames

    def read_counters(self) -> dict[str, int]:
        lost = self._ring.overflow_count + self._port.kernel_drops
        return {
            "frames": self._ring.received_count,
            "ring_overflow": self._ring.overflow_count,
            "kernel_drops": self._port.kernel_drops,
            "lost": lost,
        }

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(timeout=20 * POLL_S)
        self._port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
