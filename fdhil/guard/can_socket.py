"""Sends and receives on a descriptor opened by the starter: CAN_RAW or the socketcand text protocol.

What may leave is checked here, where the bytes leave: our heartbeat and the configured offset RPDOs, nothing else.
"""

import errno
import fcntl
import math
import socket
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Literal

Frame = tuple[int, bytes, float]
"""COB-ID, data, time stamp of the frame in seconds; the COB-ID ``ERROR`` stands for a controller state in ``data``."""

ERROR = -1
_CAN_FRAME = struct.Struct("=IB3x8s")
_CAN_FILTER = struct.Struct("=II")
_IFREQ = struct.Struct("@16sH22x")
_TIMEVAL = struct.Struct("@ll")
SO_TIMESTAMP = 29
SO_RXQ_OVFL = 40
CAN_RAW_ERR_FILTER = 2
SIOCGIFFLAGS = 0x8913
IFF_UP = 1
CAN_ERR_FLAG = 0x20000000
CAN_SFF_ONLY = 0xC00007FF
RETRY = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR)
FULL = (errno.ENOBUFS, errno.EAGAIN, errno.EWOULDBLOCK)
MAX_PENDING_BYTES = 1 << 16
MOST_FRAMES = 256  # per call: a flood must not keep the loop from sending
MOST_TURNS = 16  # more than a socket holds


class BusDown(Exception):
    """The bus is gone; ``str`` gives the reason."""


class ForbiddenFrame(Exception):
    """A frame was to be sent whose COB-ID the guard must never use."""


class CanSocket(ABC):
    """A transport: the descriptor and the filter of COB-IDs that may be sent."""

    def __init__(self, descriptor: socket.socket, allowed: Iterable[int]) -> None:
        self._socket = descriptor
        self._allowed = frozenset(allowed)
        self.lost_frames = 0
        descriptor.setblocking(False)

    def fileno(self) -> int:
        """Return the descriptor, for poll."""
        return self._socket.fileno()

    @abstractmethod
    def receive(self) -> list[Frame]:
        """Return the waiting frames, a few hundred at most, without blocking; BusDown when the bus is gone."""

    def try_restore(self) -> bool:
        """Return whether a lost bus is back, with old frames discarded; a closed hub connection never is."""
        return False

    def send(self, cob_id: int, data: bytes) -> bool:
        """Send one frame now; return False when the queue is full. BusDown, ForbiddenFrame."""
        if cob_id not in self._allowed:
            raise ForbiddenFrame(f"{cob_id:03X} is not a COB-ID that this process may send")
        try:
            return self._send(cob_id, data)
        except OSError as error:
            if error.errno in FULL:
                return False
            raise BusDown(error.strerror or str(error)) from None

    @abstractmethod
    def _send(self, cob_id: int, data: bytes) -> bool:
        """Send one frame whose COB-ID is allowed; OSError."""

    def close(self) -> None:
        """Close the descriptor."""
        self._socket.close()


class RawCan(CanSocket):
    """SocketCAN's CAN_RAW; ``lost_frames`` counts frames that the kernel dropped because they were read too late."""

    def __init__(self, descriptor: socket.socket, allowed: Iterable[int], wanted: Iterable[int]) -> None:
        super().__init__(descriptor, allowed)
        self._filters = b"".join(_CAN_FILTER.pack(cob_id, CAN_SFF_ONLY) for cob_id in wanted)
        descriptor.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, self._filters)
        descriptor.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, 0x1FFFFFFF)
        descriptor.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMP, 1)
        descriptor.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        self._overflow = 0
        self._channel = descriptor.getsockname()[0]

    def try_restore(self) -> bool:
        """Bind again, as after an adapter was plugged in again; return whether the interface is up."""
        try:
            self._socket.bind((self._channel,))
            # an interface that was removed has taken the filters with it
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, self._filters)
            query = _IFREQ.pack(self._channel.encode(), 0)
            up = _IFREQ.unpack(fcntl.ioctl(self._socket.fileno(), SIOCGIFFLAGS, query))[1] & IFF_UP
            self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)  # clears the old error
            return bool(up) and any(not self.receive() for _ in range(MOST_TURNS))
        except (OSError, BusDown):
            return False

    def receive(self) -> list[Frame]:
        """Return the waiting frames, error frames as controller states."""
        frames: list[Frame] = []
        for _ in range(MOST_FRAMES):
            try:
                data, ancillary, _, _ = self._socket.recvmsg(16, 64)
            except OSError as error:
                if error.errno in RETRY:
                    return frames
                raise BusDown(error.strerror or str(error)) from None
            can_id, length, payload = _CAN_FRAME.unpack(data)
            stamp_s = self._read_frame_stamp(ancillary)
            if can_id & CAN_ERR_FLAG:
                frames += [(ERROR, name.encode(), stamp_s) for name in decode_controller_states(can_id, payload)]
            elif can_id <= 0x7FF:
                frames.append((can_id, payload[:length], stamp_s))
        return frames

    def _read_frame_stamp(self, ancillary: list[tuple[int, int, bytes]]) -> float:
        stamp_s = 0.0
        for _, kind, data in ancillary:
            if kind == SO_TIMESTAMP:
                seconds, microseconds = _TIMEVAL.unpack(data[: _TIMEVAL.size])
                stamp_s = seconds + microseconds * 1e-6
            elif kind == SO_RXQ_OVFL:
                total = int.from_bytes(data[:4], "little")
                self.lost_frames += total - self._overflow
                self._overflow = total
        return stamp_s

    def _send(self, cob_id: int, data: bytes) -> bool:
        self._socket.send(_CAN_FRAME.pack(cob_id, len(data), data))
        return True


def decode_controller_states(can_id: int, data: bytes) -> list[str]:
    """Decode the controller state of an error frame (linux/can/error.h): off, restarted, passive, active."""
    states = []
    if can_id & 0x40:
        states.append("off")
    if can_id & 0x100:
        states.append("restarted")
    if can_id & 0x4:
        if data[1] & 0x30:
            states.append("passive")
        elif data[1] & 0x0C:
            states.append("warning")
        elif data[1] & 0x40:
            states.append("active")
    return states


class SocketcandText(CanSocket):
    """The socketcand protocol in raw mode after the greeting: ``< frame 123 23.424242 11 22 >``."""

    def __init__(self, descriptor: socket.socket, allowed: Iterable[int], wanted: Iterable[int]) -> None:
        super().__init__(descriptor, allowed)
        descriptor.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._wanted = {f"{cob_id:03X}".encode(): cob_id for cob_id in wanted}
        self._wanted |= {name.lower(): cob_id for name, cob_id in self._wanted.items()}
        self._rest = b""

    def receive(self) -> list[Frame]:
        """Return the waiting frames whose COB-ID is wanted."""
        try:
            chunk = self._socket.recv(MOST_FRAMES * 64)
        except OSError as error:
            if error.errno in RETRY:
                return []
            raise BusDown(error.strerror or str(error)) from None
        if not chunk:
            raise BusDown("the hub closed the connection")
        *pieces, self._rest = (self._rest + chunk).split(b">")
        if len(self._rest) > MAX_PENDING_BYTES:
            raise BusDown("the hub does not speak the socketcand protocol")
        return [frame for piece in pieces if (frame := self._parse_text_frame(piece)) is not None]

    def _parse_text_frame(self, piece: bytes) -> Frame | None:
        words = piece.split()
        if len(words) < 4:
            return None
        if words[1] == b"error":
            return self._parse_error_frame(words)
        cob_id = self._wanted.get(words[2])
        if cob_id is None or words[1] != b"frame":
            return None
        try:
            data, stamp_s = bytes.fromhex(b"".join(words[4:]).decode("ascii")), float(words[3])
        except ValueError:
            return None
        return (cob_id, data, stamp_s) if math.isfinite(stamp_s) else None

    @staticmethod
    def _parse_error_frame(words: list[bytes]) -> Frame | None:
        try:
            states = decode_controller_states(int(words[2], 16), bytes(8))
        except ValueError:
            return None
        return (ERROR, states[0].encode(), 0.0) if states else None

    def _send(self, cob_id: int, data: bytes) -> bool:
        text = f"< send {cob_id:03X} {len(data):X} {data.hex(' ')} >".encode("ascii")
        sent = self._socket.send(text)
        if sent != len(text):  # half a command cannot be taken back: what follows would be garbage
            raise BusDown("the hub took only a part of a frame")
        return True


def adopt_descriptor(
    transport: Literal["can_raw", "socketcand"], descriptor: int, allowed: Iterable[int], wanted: Iterable[int]
) -> CanSocket:
    """Take over an open descriptor; OSError when it is of another kind."""
    kind = RawCan if transport == "can_raw" else SocketcandText
    taken = socket.socket(fileno=descriptor)
    try:
        return kind(taken, allowed, wanted)
    except OSError:
        taken.close()
        raise
