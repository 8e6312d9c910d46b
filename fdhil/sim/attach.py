"""How the twin is attached to a CAN bus: its own TCP hub, python-can's ``virtual`` in one process, or SocketCAN.

All three offer the same methods to the twin's loop; this is the only module of the twin that imports ``can``.
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Protocol

from fdhil.config import CanBus
from fdhil.errors import ConnectError
from fdhil.sim.hub import EXTENDED, Frame, Handler, Hub

_RETRY_S = 0.0005


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
    return PythonCan(name, bus)


class PythonCan:
    """A bus of python-can: ``socketcan`` by its descriptor, ``virtual`` through a thread that wakes the loop.

    ``lost`` counts frames that SocketCAN's transmit queue would not take.
    """

    def __init__(self, name: str, bus: CanBus) -> None:
        import can

        self._error = can.CanError
        self._message = can.Message
        self._name, self._settings = name, bus
        try:
            self._bus = can.Bus(interface=bus.interface, channel=bus.channel)
        except (OSError, can.CanError) as error:
            raise ConnectError(
                f"bus {name}",
                f"{bus.interface} {bus.channel} cannot be opened ({error}): bring it up "
                f"(ip link set {bus.channel} up), or use the socketcand interface, which needs no CAN in the kernel",
            ) from None
        self.lost = 0
        self._out: deque[Frame] = deque()
        self._in: deque[Frame] = deque()
        self._reader = _Reader(self._bus, self._in) if bus.interface == "virtual" else None

    @property
    def settings(self) -> dict[str, str | int | None]:
        """The arguments with which ``can.Bus`` joins."""
        return {"interface": self._settings.interface, "channel": self._settings.channel}

    @property
    def congested(self) -> bool:
        """Never: the kernel's queue is short and is emptied by the bus."""
        return False

    def readers(self) -> Sequence[Selectable]:
        """The descriptor that a received frame makes readable."""
        return [self._bus if self._reader is None else self._reader]

    def writers(self) -> Sequence[Selectable]:
        """Nothing: a socket that is full is tried again at the next flush."""
        return []

    def deadline_s(self) -> float | None:
        """Soon while frames wait for the kernel's queue."""
        return time.monotonic() + _RETRY_S if self._out else None

    def pump(self, ready: Sequence[object], handler: Handler) -> None:
        """Give every frame that has come to ``handler``."""
        if self._reader is None:
            if self._bus in ready:
                while (message := self._bus.recv(0)) is not None:
                    if not (message.is_error_frame or message.is_remote_frame):
                        handler(_frame(message.arbitration_id, message.is_extended_id, message.data))
            return
        if self._reader in ready:
            self._reader.clear()
        while self._in:
            handler(self._in.popleft())

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue frames."""
        self._out.extend(frames)

    def flush(self, now_s: float) -> None:
        """Send what is queued; what a full transmit queue refuses stays for the next time."""
        while self._out:
            can_id, data = self._out[0]
            message = self._message(
                arbitration_id=can_id & 0x1FFFFFFF, data=data, is_extended_id=can_id >= EXTENDED, check=False
            )
            try:
                self._bus.send(message)
            except self._error as error:
                if getattr(error, "error_code", None) == errno.ENOBUFS and len(self._out) < 1000:
                    return
                self.lost += 1
            self._out.popleft()

    def close(self) -> None:
        """Leave the bus."""
        if self._reader is not None:
            self._reader.stop()
        self._bus.shutdown()


class _Reader(threading.Thread):
    """Takes frames from a bus without descriptor and wakes the loop through a pipe."""

    def __init__(self, bus: object, inbox: deque[Frame]) -> None:
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
            message = self._bus.recv(0.1)  # type: ignore[attr-defined]
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
