"""One CAN bus: a receive thread that only appends to a ring, and a reader that drains it in blocks.

Receive-only by policy: ``CanBus`` sends nothing unless it was opened with ``transmit=True``, which commissioning and
scanning alone do. No periodic sending of any library is used anywhere: a kernel that goes on sending for a process
that hangs would make a dead program look alive.
"""

from __future__ import annotations

import threading
import time
from types import TracebackType

from fdhil import config
from fdhil.drivers.can.frames import DEFAULT_RING_FRAMES, FrameRing, Frames, Latch
from fdhil.drivers.can.ports import BusEnded, Port, SocketcandPort, SocketCanPort, VirtualPort
from fdhil.errors import DeviceError

POLL_S = 0.05
# frames are read ten milliseconds at a time: a thread that wakes for every one costs more than all the decoding, the
# stamps come from the kernel or the hub, and even a receive buffer that may not be enlarged holds three times as many
BATCH_S = 0.010
HOLD_BACK_S = 0.001


def open_port(name: str, settings: config.CanBus) -> Port:
    """Open the port that ``[bus.NAME]`` asks for; ConnectError with cause and next action."""
    if settings.interface == "socketcan":
        return SocketCanPort(name, settings.channel)
    if settings.interface == "socketcand":
        return SocketcandPort(name, settings.host, settings.port, settings.channel)
    return VirtualPort(name, settings.channel)


class CanBus:
    """A bus that is being listened to; a context manager.

    ``ended`` tells why the receive thread stopped (None while it runs).
    """

    def __init__(
        self, name: str, settings: config.CanBus, transmit: bool = False, ring_frames: int = DEFAULT_RING_FRAMES
    ) -> None:
        self.name = name
        self._port = open_port(name, settings)
        self._ring_frames = ring_frames
        self._ring = FrameRing(ring_frames)
        self._transmit = transmit
        self._stopping = threading.Event()
        self._end = Latch()
        self._ended: str | None = None
        self._send_lock = threading.Lock()
        self.last_frame_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._receive, name=f"fdhil-{name}", daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        """The receive thread: nothing but appending; its end is reported, never swallowed."""
        try:
            while not self._stopping.is_set():
                if self._port.holds_back and 2 * self._ring.room < self._ring_frames:
                    time.sleep(HOLD_BACK_S)  # what is not read waits in the hub
                    continue
                self._port.receive(self._ring, POLL_S)
                if not self._transmit:
                    time.sleep(BATCH_S)
        except BusEnded as end:
            self._end.set(str(end))

    @property
    def ended(self) -> str | None:
        """Why nothing is received any more, or None."""
        self._ended = self._end.take() or self._ended
        return self._ended

    def drain(self) -> Frames:
        """Return all frames received since the last call, in order of arrival."""
        frames = self._ring.drain()
        if frames.size:
            self.last_frame_ns = int(frames["t_ns"][-1])
        return frames

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; DeviceError when the bus was opened to listen only, or does not take it."""
        if not self._transmit:
            raise DeviceError(self.name, "this bus was opened to listen only; commissioning opens it for sending")
        with self._send_lock:
            self._port.send(can_id, data)

    def counters(self) -> dict[str, int]:
        """Frames received, and lost in the ring and in the kernel."""
        lost = self._ring.overflowed + self._port.kernel_drops
        return {
            "frames": self._ring.received,
            "ring_overflow": self._ring.overflowed,
            "kernel_drops": self._port.kernel_drops,
            "lost": lost,
        }

    def close(self) -> None:
        """Stop the receive thread and release the bus."""
        self._stopping.set()
        self._thread.join(timeout=20 * POLL_S)
        self._port.close()

    def __enter__(self) -> CanBus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
