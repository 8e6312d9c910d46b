"""Open a bus for sending: the only module besides the guard's that does, and only commissioning may import it.

No library's periodic sending is used anywhere: a kernel that keeps sending for a hung process would make a dead program
look alive.
"""

import errno
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import can

from fdhil import config
from fdhil.commissioning.bus_watch import BusWatch, WatchedRing
from fdhil.drivers import (
    CAN_FRAME,
    CONNECT_TIMEOUT_S,
    Filter,
    FrameRing,
    ListeningBus,
    ReceivePort,
    SocketcandPort,
    SocketCanPort,
    VirtualPort,
)
from fdhil.errors import ConnectError, DeviceError

LOOK_S = 0.25  # listening time before the first frame is sent: any NC's SYNC arrives meanwhile


class SendingPort(ReceivePort, Protocol):
    """A port that also sends."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame now or raise DeviceError; nothing is queued."""


class SocketCanSender(SocketCanPort):
    """A raw CAN socket; a full transmit queue (ENOBUFS) is an immediate error, never a wait."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame."""
        try:
            self._socket.send(CAN_FRAME.pack(can_id, len(data), data))
        except OSError as error:
            full = "the transmit queue is full: no other node acknowledges frames, check supply, wiring and bit rate"
            why = full if error.errno in (errno.ENOBUFS, errno.EAGAIN) else error.strerror
            raise DeviceError(self._name, f"the frame {can_id:03X} was not sent ({why})") from None


class SocketcandSender(SocketcandPort):
    """A connection to a socketcand hub."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame to the hub."""
        words = " ".join(f"{byte:x}" for byte in data)
        try:
            self._socket.settimeout(CONNECT_TIMEOUT_S)
            self._socket.sendall(f"< send {can_id:03X} {len(data):X} {words} >".encode("ascii"))
        except OSError as error:
            raise DeviceError(self._name, f"the frame {can_id:03X} was not sent ({error})") from None


class VirtualSender(VirtualPort):
    """python-can's bus inside one process."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame to the other buses of the channel."""
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except can.CanError as error:
            raise DeviceError(self._name, f"the frame {can_id:03X} was not sent ({error})") from None


SENDERS: Mapping[str, Callable[[str, config.CanBus], SendingPort]] = {
    "socketcan": SocketCanSender,
    "socketcand": SocketcandSender,
    "virtual": VirtualSender,
}


class TransmitBus(ListeningBus):
    """A bus that is listened to and sent on; it is read frame by frame, since answers are waited for.

    ``watch`` inspects all frames; without one the identifiers of the machine's own drives are unknown.
    """

    batch_s = 0.0

    def __init__(self, name: str, settings: config.CanBus, watch: BusWatch | None = None) -> None:
        self.watch = watch or BusWatch(name)
        super().__init__(name, settings)
        self._free_from_s = time.monotonic() + LOOK_S

    def _make_ring(self, frames: int) -> FrameRing:
        return WatchedRing(frames, self.watch)

    def _open_port(self, settings: config.CanBus, filters: Sequence[Filter]) -> ReceivePort:
        if not settings.may_send:
            text = f"fdhil does not send on {settings.interface} adapters, which this command requires; use SocketCAN"
            raise ConnectError(self.name, text)
        self._send_lock = threading.Lock()
        self._sender = SENDERS[settings.interface](self.name, settings)
        return self._sender

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame; DeviceError if the bus does not accept it, ForeignMaster if another master runs it."""
        time.sleep(max(0.0, self._free_from_s - time.monotonic()))
        with self._send_lock:
            self.watch.require_send_allowed(can_id, data)
            self._sender.send(can_id, data)
