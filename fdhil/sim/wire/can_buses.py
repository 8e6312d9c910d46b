"""Attaches the simulator to a CAN bus: its own TCP hub, the kernel's SocketCAN, python-can's ``virtual``.

All three offer the same methods to the simulator's loop; no other module of it but the fault bus imports ``can``.
"""

import errno
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Sequence

from fdhil.config import CanBus
from fdhil.errors import ConnectError
from fdhil.sim.frame_types import EXTENDED, Frame
from fdhil.sim.wire.bus_attachment import BusAttachment, Handler, Selectable, WakePipe
from fdhil.sim.wire.tcp_hub import TcpHub

_RETRY_S = 0.0005
_MAX_WAITING = 1000
_FRAMES_PER_TURN = 256
# struct can_frame of linux/can.h: identifier with its flags, length, 3 bytes of padding, data
_CAN_FRAME = struct.Struct("=IB3x8s")
_ERROR_FRAME, _REMOTE_FRAME = 1 << 29, 1 << 30


def attach_bus(name: str, bus: CanBus) -> BusAttachment:
    """Attach to the bus ``[bus.name]``; ConnectError when that fails."""
    if bus.interface == "socketcand":
        return TcpHub(bus.channel, bus.host, bus.port)
    if bus.interface == "socketcan":
        return SocketCanBus(name, bus)
    if bus.interface == "virtual":
        return VirtualBus(bus)
    text = (
        f"the simulated drives do not support the interface {bus.interface}; set interface to socketcand or socketcan"
    )
    raise ConnectError(f"bus {name}", text)


def _build_bus_error(name: str, bus: CanBus, error: OSError) -> ConnectError:
    return ConnectError(
        f"bus {name}",
        f"socketcan {bus.channel} cannot be opened ({error.strerror or error}); bring it up (ip link set {bus.channel} "
        "up), or use the socketcand interface, which needs no CAN in the kernel",
    )


class _SharedBus(BusAttachment):
    """A bus that others operate: frames are already distributed, and no client can be disconnected."""

    def relay_frame(self, frame: Frame, sender: object) -> None: ...

    def disconnect_clients(self) -> None: ...


class SocketCanBus(_SharedBus):
    """A CAN interface of the kernel by a raw socket (half the time per frame of a library's message objects)."""

    def __init__(self, name: str, bus: CanBus) -> None:
        self.settings = {"interface": "socketcan", "channel": bus.channel}
        self._out: deque[Frame] = deque()
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            raise _build_bus_error(name, bus, error) from None
        try:
            self._socket.bind((bus.channel,))
        except OSError as error:
            self._socket.close()
            raise _build_bus_error(name, bus, error) from None
        self._socket.setblocking(False)

    @property
    def is_congested(self) -> bool:
        """Whether the kernel's transmit queue is full: the bus itself then sets the pace."""
        return bool(self._out)

    def list_readers(self) -> Sequence[Selectable]:
        return [self._socket]

    def find_deadline_s(self) -> float | None:
        """Return a near deadline while frames wait: ``select`` does not show a full transmit queue."""
        return time.monotonic() + _RETRY_S if self._out else None

    def receive_frames(self, ready: Sequence[object], handler: Handler) -> None:
        """Pass every received frame to ``handler``: remote frames without data, no error frames."""
        if self._socket not in ready:
            return
        for _ in range(_FRAMES_PER_TURN):
            try:
                can_id, length, data = _CAN_FRAME.unpack(self._socket.recv(_CAN_FRAME.size))
            except OSError:  # no more frames, or the interface went down
                return
            if not can_id & _ERROR_FRAME:
                content = b"" if can_id & _REMOTE_FRAME else data[:length]
                for frame, _ in self.apply_faults((can_id & ~_REMOTE_FRAME, content), None):
                    handler(frame)

    def queue_frames(self, frames: Sequence[Frame]) -> None:
        self._out.extend(frames)
        while len(self._out) > _MAX_WAITING:  # no node acknowledges: the bus is off or has no other node
            self._out.popleft()

    def flush_frames(self, now_s: float) -> None:
        """Send the queued frames; those that a full transmit queue refuses stay queued."""
        while self._out:
            can_id, data = self._out[0]
            try:
                self._socket.send(_CAN_FRAME.pack(can_id, len(data), data))
            except OSError as error:
                if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                    return
            self._out.popleft()

    def close(self) -> None:
        self._socket.close()


class VirtualBus(_SharedBus):
    """python-can's ``virtual`` bus inside this process; a thread wakes the loop for received frames."""

    def __init__(self, bus: CanBus) -> None:
        import can

        self._message = can.Message
        self.settings = {"interface": "virtual", "channel": bus.channel}
        self._bus = can.Bus(interface="virtual", channel=bus.channel)
        self._out: list[Frame] = []
        self._in: deque[Frame] = deque()
        self._pipe = WakePipe()
        self._ending = False
        self._reader = threading.Thread(target=self._run_reader, name="sim-can-reader", daemon=True)
        self._reader.start()

    def list_readers(self) -> Sequence[Selectable]:
        return [self._pipe]

    def receive_frames(self, ready: Sequence[object], handler: Handler) -> None:
        if self._pipe in ready:
            self._pipe.clear_wakes()
        while self._in:
            for frame, _ in self.apply_faults(self._in.popleft(), None):
                handler(frame)

    def queue_frames(self, frames: Sequence[Frame]) -> None:
        self._out.extend(frames)

    def flush_frames(self, now_s: float) -> None:
        frames, self._out = self._out, []
        for can_id, data in frames:
            extended = can_id >= EXTENDED
            self._bus.send(self._message(arbitration_id=can_id & 0x1FFFFFFF, data=data, is_extended_id=extended))

    def close(self) -> None:
        self._ending = True
        self._reader.join()
        self._pipe.close()
        self._bus.shutdown()

    def _run_reader(self) -> None:
        """Receive frames from the bus, which has no descriptor, and wake the loop, until stopped."""
        while not self._ending:
            message = self._bus.recv(0.1)
            if message is not None:
                can_id = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
                self._in.append((can_id, b"" if message.is_remote_frame else bytes(message.data)))
                self._pipe.wake_reader()
