"""Listens to a CAN bus in three ways, each a port with ``receive`` (append what came to a ring) and ``close``.

* ``SocketCanPort``: a raw socket of the standard library, because python-can neither counts the kernel's drops
  (SO_RXQ_OVFL) nor enlarges the receive buffer, and its stamps are the wall clock's alone.
* ``SocketcandPort``: our own reader of the socketcand text protocol. python-can's client costs 28 us a frame (22 % of
  a core at 7,800 frames/s, measured), spins without end when the hub closes the connection and cannot tell it from
  silence; reading what has come in one piece and splitting it costs about 2 us a frame.
* ``VirtualPort``: python-can's in-process bus, for tests and demonstrations.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import can

from fdhil import config
from fdhil.drivers.can.frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, FrameRing
from fdhil.errors import ConnectError

RECEIVE_BUFFER_BYTES = 8 << 20
CONNECT_TIMEOUT_S = 3.0
MAX_LINE_BYTES = 200
MIN_LINE_BYTES = 18  # a frame without data: a chunk never holds more frames than the ring has room for
MAX_CHUNK_BYTES = 1 << 18
SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
CAN_RAW_ERR_FILTER = 2
CAN_FRAME = struct.Struct("=IB3x8s")


class BusEnded(Exception):
    """The bus under a port is gone; ``str`` says why. Internal to the receive thread."""


class Port(Protocol):
    """A way onto a bus, as its receive thread needs it."""

    @property
    def holds_back(self) -> bool:
        """Whether what is not read waits at the sender, so that nothing is lost by reading late."""

    @property
    def kernel_drops(self) -> int:
        """Frames the kernel dropped because they were not read in time."""

    def receive(self, ring: FrameRing, timeout_s: float) -> None:
        """Append what arrives within ``timeout_s`` to ``ring``; BusEnded when the bus is gone."""

    def close(self) -> None:
        """Release the bus."""


class WallClock:
    """The wall clock against the monotonic one; two readings are never taken at quite the same instant, so a small
    change is followed slowly, and one of more than 2 ms is a clock that was set."""

    _SET_NS = 2_000_000
    _SHARE = 64
    _SPREAD_NS = 200_000

    def __init__(self) -> None:
        self._ahead_ns: int | None = None

    def ahead_ns(self) -> int:
        """Return by how much the wall clock is ahead now."""
        spread, ahead = min(self._reading() for _ in range(3))
        if self._ahead_ns is not None and spread > self._SPREAD_NS:
            return self._ahead_ns  # we were interrupted between the clocks: the reading says nothing
        if self._ahead_ns is None or abs(ahead - self._ahead_ns) > self._SET_NS:
            self._ahead_ns = ahead
        else:
            self._ahead_ns += (ahead - self._ahead_ns) // self._SHARE
        return self._ahead_ns

    @staticmethod
    def _reading() -> tuple[int, int]:
        before = time.monotonic_ns()
        wall = time.time_ns()
        after = time.monotonic_ns()
        return after - before, wall - (before + after) // 2


def monotonic_ns(wall_ns: int, wall_ahead_ns: int) -> int:
    """Return a wall-clock stamp on the monotonic clock; now, when the wall clock was set since the stamp."""
    now_ns, stamp_ns = time.monotonic_ns(), wall_ns - wall_ahead_ns
    return stamp_ns if now_ns - 1_000_000_000 < stamp_ns <= now_ns + 5_000_000 else now_ns


class SocketCanPort:
    """A raw CAN socket on a network interface: kernel stamps, error frames, drop count."""

    holds_back = False

    def __init__(self, name: str, settings: config.CanBus) -> None:
        self._name = name
        self.kernel_drops = 0
        self._wall_clock = WallClock()
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            text = f"this kernel has no CAN ({error.strerror}); use the socketcand interface or another kernel"
            raise ConnectError(name, text) from None
        try:
            self._configure()
            self._socket.bind((settings.channel,))
        except OSError as error:
            self._socket.close()
            text = f"the CAN interface {settings.channel} cannot be opened ({error.strerror}); bring it up with ip link"
            raise ConnectError(name, text) from None

    def _configure(self) -> None:
        raw = self._socket
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        with contextlib.suppress(PermissionError):  # needs CAP_NET_ADMIN; the capped size stays in force without it
            raw.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
        raw.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        raw.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        raw.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, 0x1FFFFFFF)
        raw.setblocking(False)

    def receive(self, ring: FrameRing, timeout_s: float) -> None:
        """Read all that waits; the kernel's wall-clock stamps become monotonic ones at once."""
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return
        wall_ahead_ns = self._wall_clock.ahead_ns()
        for _ in range(4096):
            try:
                data, ancillary, _flags, _address = self._socket.recvmsg(16, 128)
            except BlockingIOError:
                return
            except OSError as error:
                raise BusEnded(f"the CAN interface is down ({error.strerror})") from None
            can_id, length, payload = CAN_FRAME.unpack(data)
            ring.append(self._stamp(ancillary, wall_ahead_ns), can_id, payload[:length])

    def _stamp(self, ancillary: list[tuple[int, int, bytes]], wall_ahead_ns: int) -> int:
        stamp_ns = None
        for _level, kind, value in ancillary:
            if kind == SO_TIMESTAMPNS:
                seconds, nanoseconds = struct.unpack("qq", value[:16])
                stamp_ns = monotonic_ns(seconds * 1_000_000_000 + nanoseconds, wall_ahead_ns)
            elif kind == SO_RXQ_OVFL:
                (self.kernel_drops,) = struct.unpack("I", value[:4])
        return time.monotonic_ns() if stamp_ns is None else stamp_ns

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class HubClock:
    """The hub's clock against ours, from the quickest reading so far: no reading comes before it was sent.

    A hub whose clock was set, or which sends no clock at all, starts anew.
    """

    _DRIFT_S = 1e-7  # per reading: two clocks drift apart, and the quickest reading may be long ago
    _JUMP_S = 1.0

    def __init__(self) -> None:
        self._ahead_s: float | None = None

    def ahead_s(self, lines: Sequence[str], now_ns: int) -> float | None:
        """Return by how many seconds the hub's stamps are ahead of the host's monotonic clock, None without stamps."""
        try:
            ahead = float(lines[-1].split(None, 4)[3]) - now_ns * 1e-9
        except (IndexError, ValueError):
            return self._ahead_s
        if self._ahead_s is None or ahead > self._ahead_s or ahead < self._ahead_s - self._JUMP_S:
            self._ahead_s = ahead
        else:
            self._ahead_s -= self._DRIFT_S
        return self._ahead_s


class SocketcandPort:
    """A TCP connection to a socketcand hub in raw mode."""

    holds_back = True
    kernel_drops = 0  # TCP loses nothing; what the hub dropped it must say itself

    def __init__(self, name: str, settings: config.CanBus) -> None:
        self._name = name
        self._rest = b""
        self._clock = HubClock()
        self.malformed = 0
        where = f"{settings.host}:{settings.port}"
        try:
            self._socket = socket.create_connection((settings.host, settings.port), CONNECT_TIMEOUT_S)
        except OSError as error:
            text = f"the CAN hub {where} cannot be reached ({error}); start it or correct host and port"
            raise ConnectError(name, text) from None
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._expect(b"< hi >", f"{where} is no socketcand hub")
            self._socket.sendall(f"< open {settings.channel} >".encode("ascii"))
            self._expect(b"< ok >", f"the hub {where} has no bus {settings.channel}")
            self._socket.sendall(b"< rawmode >")
            self._expect(b"< ok >", f"the hub {where} refuses raw mode")
        except (OSError, ConnectError) as error:
            self._socket.close()
            if isinstance(error, ConnectError):
                raise
            raise ConnectError(name, f"the CAN hub {where} ended the connection ({error})") from None

    def _expect(self, answer: bytes, otherwise: str) -> None:
        while b">" not in self._rest:
            chunk = self._socket.recv(256)
            if not chunk or len(self._rest) > MAX_LINE_BYTES:
                raise ConnectError(self._name, f"{otherwise}; check host, port and channel")
            self._rest += chunk
        said, _, self._rest = self._rest.partition(b">")
        if said.strip() + b" >" != answer and said.strip() + b">" != answer:
            raise ConnectError(self._name, f"{otherwise}; check host, port and channel")

    def receive(self, ring: FrameRing, timeout_s: float) -> None:
        """Read what has come in one piece and split it; the hub's stamps become host-monotonic ones."""
        self._socket.settimeout(timeout_s)
        try:
            chunk = self._socket.recv(min(MAX_CHUNK_BYTES, ring.room * MIN_LINE_BYTES))
        except TimeoutError:
            return
        except OSError as error:
            raise BusEnded(f"the connection to the CAN hub broke ({error.strerror})") from None
        if not chunk:
            raise BusEnded("the CAN hub ended the connection")
        self._split(chunk, ring, time.monotonic_ns())

    def _split(self, chunk: bytes, ring: FrameRing, now_ns: int) -> None:
        lines = (self._rest + chunk).decode("latin-1").split(">")
        self._rest = lines.pop().encode("latin-1")
        if len(self._rest) > MAX_LINE_BYTES:
            self.malformed += 1
            self._rest = b""
        append, ahead_s = ring.append, self._clock.ahead_s(lines, now_ns)
        for line in lines:
            words = line.split(None, 4)
            try:
                name = words[2]
                stamp_ns = min(now_ns, int((float(words[3]) - ahead_s) * 1e9)) if ahead_s else now_ns
                data = bytes.fromhex(words[4])[:8] if len(words) > 4 else b""
                if words[1] == "frame":
                    append(stamp_ns, int(name, 16) if len(name) == 3 else int(name, 16) | EXTENDED_FLAG, data)
                elif words[1] == "error":
                    append(stamp_ns, int(name, 16) & 0x1FFFFFFF | ERROR_FLAG, data)
            except (IndexError, ValueError, struct.error):
                self.malformed += 1

    def close(self) -> None:
        """End the connection."""
        self._socket.close()


class VirtualPort:
    """python-can's bus inside one process."""

    holds_back = False
    kernel_drops = 0

    def __init__(self, name: str, settings: config.CanBus) -> None:
        self._name = name
        self._wall_clock = WallClock()
        try:
            self._bus = can.Bus(interface="virtual", channel=settings.channel)
        except can.CanError as error:
            raise ConnectError(name, f"the virtual bus {settings.channel} cannot be opened ({error})") from None

    def receive(self, ring: FrameRing, timeout_s: float) -> None:
        """Append one frame, and all others that wait; the sender's wall-clock stamps become monotonic ones."""
        wait: float = timeout_s
        wall_ahead_ns = self._wall_clock.ahead_ns()
        for _ in range(4096):
            message = self._bus.recv(wait)
            if message is None:
                return
            stamp_ns = monotonic_ns(int(message.timestamp * 1e9), wall_ahead_ns)
            can_id = message.arbitration_id | (EXTENDED_FLAG if message.is_extended_id else 0)
            can_id |= (ERROR_FLAG if message.is_error_frame else 0) | (REMOTE_FLAG if message.is_remote_frame else 0)
            ring.append(stamp_ns, can_id, bytes(message.data[:8]))
            wait = 0.0

    def close(self) -> None:
        """Leave the channel."""
        self._bus.shutdown()


PORTS: Mapping[str, Callable[[str, config.CanBus], Port]] = {
    "socketcan": SocketCanPort,
    "socketcand": SocketcandPort,
    "virtual": VirtualPort,
}
