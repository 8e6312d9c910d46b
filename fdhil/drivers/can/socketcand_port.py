"""Receives the socketcand text protocol of a CAN hub.

python-can's client costs 28 us a frame (22 % of a core at 7,800 frames/s, measured), spins for ever when the hub closes
the connection and cannot distinguish that from silence; reading in large pieces and splitting costs about 2 us a frame.
"""

import socket
import struct
import time
from collections.abc import Sequence

from fdhil import config
from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, FrameRing
from fdhil.drivers.can.host_clock import RemoteClock
from fdhil.drivers.can.receive_port import BusEnded, Filter, Stamps
from fdhil.errors import ConnectError

CONNECT_TIMEOUT_S = 3.0
MAX_LINE_BYTES = 200
MIN_LINE_BYTES = 18  # a frame without data: a chunk never holds more frames than the ring has room for
MAX_CHUNK_BYTES = 1 << 18


class HubClock:
    """The hub's clock against ours; some hubs send no time stamps."""

    _WINDOW_S = 10.0

    def __init__(self) -> None:
        self._clock = RemoteClock(self._WINDOW_S)
        self._ahead_s: float | None = None

    def track_ahead_s(self, lines: Sequence[str], now_ns: int) -> float | None:
        """Return by how many seconds the hub's stamps are ahead of the host's monotonic clock, None without stamps."""
        try:
            stamp_ns = int(float(lines[-1].split(None, 4)[3]) * 1e9)
        except (IndexError, ValueError, OverflowError):
            return self._ahead_s
        self._ahead_s = self._clock.track_ahead_ns(stamp_ns, now_ns) * 1e-9
        return self._ahead_s


class SocketcandPort:
    """A TCP connection to a socketcand hub in raw mode."""

    stamps: Stamps = "hub"
    holds_back = True
    kernel_drops = 0  # TCP loses nothing; the hub's own losses are unknown

    def __init__(self, name: str, settings: config.CanBus, _filters: Sequence[Filter] = ()) -> None:
        self._name = name
        self._rest = b""
        self._clock = HubClock()
        self.malformed = 0
        where = f"{settings.host}:{settings.port}"
        try:
            self._socket = socket.create_connection((settings.host, settings.port), CONNECT_TIMEOUT_S)
        except OSError as error:
            start = "start it" if not settings.offset_lead_cycles else "start LinuxCNC with fdhil's HAL file"
            text = f"the CAN hub {where} cannot be reached ({error}); {start} or correct host and port"
            raise ConnectError(name, text) from None
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._expect_answer(b"< hi >", f"{where} is not a socketcand hub")
            self._socket.sendall(f"< open {settings.channel} >".encode("ascii"))
            self._expect_answer(b"< ok >", f"the hub {where} has no bus {settings.channel}")
            self._socket.sendall(b"< rawmode >")
            self._expect_answer(b"< ok >", f"the hub {where} refuses raw mode")
        except (OSError, ConnectError) as error:
            self._socket.close()
            if isinstance(error, ConnectError):
                raise
            raise ConnectError(name, f"the CAN hub {where} ended the connection ({error})") from None

    def _expect_answer(self, answer: bytes, otherwise: str) -> None:
        while b">" not in self._rest:
            chunk = self._socket.recv(256)
            if not chunk or len(self._rest) > MAX_LINE_BYTES:
                raise ConnectError(self._name, f"{otherwise}; check host, port and channel")
            self._rest += chunk
        reply, _, self._rest = self._rest.partition(b">")
        if reply.strip() + b" >" != answer and reply.strip() + b">" != answer:
            raise ConnectError(self._name, f"{otherwise}; check host, port and channel")

    def receive_frames(self, ring: FrameRing, timeout_s: float) -> None:
        self._socket.settimeout(timeout_s)
        try:
            chunk = self._socket.recv(min(MAX_CHUNK_BYTES, ring.free_slots * MIN_LINE_BYTES))
        except TimeoutError:
            return
        except OSError as error:
            raise BusEnded(f"the connection to the CAN hub failed ({error.strerror})") from None
        if not chunk:
            raise BusEnded("the CAN hub ended the connection")
        self._parse_chunk(chunk, ring, time.monotonic_ns())

    def _parse_chunk(self, chunk: bytes, ring: FrameRing, now_ns: int) -> None:
        lines = (self._rest + chunk).decode("latin-1").split(">")
        self._rest = lines.pop().encode("latin-1")
        if len(self._rest) > MAX_LINE_BYTES:
            self.malformed += 1
            self._rest = b""
        append, ahead_s = ring.append_frame, self._clock.track_ahead_s(lines, now_ns)
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
            except (IndexError, ValueError, OverflowError, struct.error):
                self.malformed += 1

    def close(self) -> None:
        self._socket.close()
