"""How the twin is attached to a CAN bus: its own TCP hub, the kernel's SocketCAN, python-can's ``virtual``.

All three offer the same methods to the twin's loop; this is the only module of the twin that imports ``can``.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from fdhil.config import CanBus
from fdhil.errors import ConnectError
from fdhil.sim.wire.hub import EXTENDED, Frame, Handler, Hub

if TYPE_CHECKING:
    import can

_RETRY_S = 0.0005
_MAX_WAITING = 1000
_FRAMES_PER_TURN = 256
# struct can_frame of linux/can.h: identifier with its flags, length, 3 bytes of padding, data
_CAN_FRAME = struct.Struct("=IB3x8s")
_ERROR_FRAME, _REMOTE_FRAME = 1 << 29, 1 << 30


class Selectable(Protocol):
    """What ``select`` takes."""

    def fileno(self) -> int:
        """The file descriptor."""
        ...


class Attachment(Protocol):
    """A bus as the twin's loop sees it."""

    @property
    def settings(self) -> dict[str, str | int | None]:
        """The arguments with which ``can.Bus`` joins."""
        ...

    @property
    def congested(self) -> bool:
        """Whether the bus takes no more for the moment."""
        ...

    @property
    def senders_left(self) -> int:
        """How many parties left the bus after they had sent frames, as far as the bus can tell."""
        ...

    def readers(self) -> Sequence[Selectable]:
        """What to select for reading."""
        ...

    def writers(self) -> Sequence[Selectable]:
        """What to select for writing."""
        ...

    def deadline_s(self) -> float | None:
        """Monotonic time at which ``flush`` is due although nothing is ready."""
        ...

    def pump(self, ready: Sequence[object], handler: Handler) -> None:
        """Give every frame that the other parties sent to ``handler``."""
        ...

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue frames."""
        ...

    def flush(self, now_s: float) -> None:
        """Send what is queued."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...


def attach(name: str, bus: CanBus) -> Attachment:
    """Attach to the bus ``[bus.name]``; ConnectError when it cannot be had."""
    if bus.interface == "socketcand":
        return Hub(bus.channel, bus.host, bus.port)
    return SocketCan(name, bus) if bus.interface == "socketcan" else Virtual(name, bus)


def _no_bus(name: str, bus: CanBus, error: OSError) -> ConnectError:
    return ConnectError(
        f"bus {name}",
        f"socketcan {bus.channel} cannot be opened ({error.strerror or error}): bring it up (ip link set {bus.channel} "
        "up), or use the socketcand interface, which needs no CAN in the kernel",
    )


class SocketCan:
    """A CAN interface of the kernel by a raw socket (half the time per frame of a library's message objects).

    ``lost`` counts frames that were given up because the transmit queue stayed full.
    """

    senders_left = 0

    def __init__(self, name: str, bus: CanBus) -> None:
        self._channel = bus.channel
        self.lost = 0
        self._out: deque[Frame] = deque()
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            raise _no_bus(name, bus, error) from None
        try:
            self._socket.bind((bus.channel,))
        except OSError as error:
            self._socket.close()
            raise _no_bus(name, bus, error) from None
        self._socket.setblocking(False)

    @property
    def settings(self) -> dict[str, str | int | None]:
        """The arguments with which ``can.Bus`` joins."""
        return {"interface": "socketcan", "channel": self._channel}

    @property
    def congested(self) -> bool:
        """Whether the kernel's transmit queue is full: the bus itself sets the pace then."""
        return bool(self._out)

    def readers(self) -> Sequence[Selectable]:
        """The socket."""
        return [self._socket]

    def writers(self) -> Sequence[Selectable]:
        """Nothing: a full transmit queue does not show in ``select``."""
        return []

    def deadline_s(self) -> float | None:
        """Soon while frames wait for the transmit queue."""
        return time.monotonic() + _RETRY_S if self._out else None

    def pump(self, ready: Sequence[object], handler: Handler) -> None:
        """Give every frame that has come to ``handler``; error and remote frames are no business of the twin."""
        if self._socket not in ready:
            return
        for _ in range(_FRAMES_PER_TURN):
            try:
                can_id, length, data = _CAN_FRAME.unpack(self._socket.recv(_CAN_FRAME.size))
            except OSError:  # nothing more, or the interface went down
                return
            if not can_id & (_ERROR_FRAME | _REMOTE_FRAME):
                handler((can_id, data[:length]))

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue frames."""
        self._out.extend(frames)
        while len(self._out) > _MAX_WAITING:  # nobody acknowledges: the bus is off or alone
            self._out.popleft()
            self.lost += 1

    def flush(self, now_s: float) -> None:
        """Send what is queued; what a full transmit queue refuses stays for the next time."""
        while self._out:
            can_id, data = self._out[0]
            try:
                self._socket.send(_CAN_FRAME.pack(can_id, len(data), data))
            except OSError as error:
                if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                    return
                self.lost += 1
            self._out.popleft()

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()


class Virtual:
    """python-can's ``virtual`` bus inside this process; a thread wakes the loop for what comes."""

    senders_left = 0

    def __init__(self, name: str, bus: CanBus) -> None:
        import can

        self._message = can.Message
        self._channel = bus.channel
        self._bus = can.Bus(interface="virtual", channel=bus.channel)
        self._out: list[Frame] = []
        self._in: deque[Frame] = deque()
        self._reader = _Reader(self._bus, self._in)

    @property
    def settings(self) -> dict[str, str | int | None]:
        """The arguments with which ``can.Bus`` joins."""
        return {"interface": "virtual", "channel": self._channel}

    @property
    def congested(self) -> bool:
        """Never: the peers' queues have no bound."""
        return False

    def readers(self) -> Sequence[Selectable]:
        """The pipe through which the thread wakes the loop."""
        return [self._reader]

    def writers(self) -> Sequence[Selectable]:
        """Nothing."""
        return []

    def deadline_s(self) -> float | None:
        """Never."""
        return None

    def pump(self, ready: Sequence[object], handler: Handler) -> None:
        """Give every frame that has come to ``handler``."""
        if self._reader in ready:
            self._reader.clear()
        while self._in:
            handler(self._in.popleft())

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue frames."""
        self._out.extend(frames)

    def flush(self, now_s: float) -> None:
        """Send what is queued."""
        frames, self._out = self._out, []
        for can_id, data in frames:
            extended = can_id >= EXTENDED
            self._bus.send(self._message(arbitration_id=can_id & 0x1FFFFFFF, data=data, is_extended_id=extended))

    def close(self) -> None:
        """Leave the bus."""
        self._reader.stop()
        self._bus.shutdown()


class _Reader(threading.Thread):
    """Takes frames from a bus without descriptor and wakes the loop through a pipe."""

    def __init__(self, bus: can.BusABC, inbox: deque[Frame]) -> None:
        super().__init__(name="sim-can-reader", daemon=True)
        self._bus, self._inbox = bus, inbox
        self._ending = False
        self._read_end, self._write_end = os.pipe()
        os.set_blocking(self._read_end, False)
        os.set_blocking(self._write_end, False)
        self.start()

    def fileno(self) -> int:
        """The end of the pipe that becomes readable."""
        return self._read_end

    def clear(self) -> None:
        """Take the wake-up calls out of the pipe."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._read_end, 4096)

    def run(self) -> None:
        """Receive until told to stop."""
        while not self._ending:
            message = self._bus.recv(0.1)
            if message is not None:
                self._inbox.append(_frame(message.arbitration_id, message.is_extended_id, message.data))
                with contextlib.suppress(BlockingIOError):  # the loop has not read the calls before: it is awake
                    os.write(self._write_end, b"\0")

    def stop(self) -> None:
        """End the thread."""
        self._ending = True
        self.join()
        os.close(self._read_end)
        os.close(self._write_end)


def _frame(can_id: int, extended: bool, data: bytearray | bytes) -> Frame:
    return (can_id | EXTENDED if extended else can_id), bytes(data)
