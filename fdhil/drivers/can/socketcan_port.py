"""Receives from a network interface of the kernel (SocketCAN) through a raw socket of the standard library.

python-can neither counts the kernel's drops nor enlarges the receive buffer, and its stamps are wall-clock only.
"""

import contextlib
import errno
import fcntl
import select
import socket
import struct
import time
from collections.abc import Sequence

from fdhil import config
from fdhil.drivers.can.frame_ring import FrameRing
from fdhil.drivers.can.host_clock import RemoteClock, WallClock, convert_to_monotonic_ns
from fdhil.drivers.can.receive_port import BusEnded, Filter, Stamps
from fdhil.errors import ConnectError

RECEIVE_BUFFER_BYTES = 8 << 20
FRAMES_PER_TURN = 4096
CLOCK_WINDOW_S = 2.0
SO_RCVBUFFORCE = 33
SO_TIMESTAMPING = 37
SO_RXQ_OVFL = 40
SO_MEMINFO = 55
CAN_RAW_ERR_FILTER = 2
SIOCGIFFLAGS = 0x8913
IFF_UP = 1
# linux/net_tstamp.h: take stamps of the kernel and of the controller, and report both
STAMPING = 1 << 2 | 1 << 3 | 1 << 4 | 1 << 6
CAN_FRAME = struct.Struct("=IB3x8s")
_SCM_TIMESTAMPING = struct.Struct("@6l")  # three times seconds and nanoseconds: kernel, unused, controller
_CAN_FILTER = struct.Struct("=II")
_COUNT = struct.Struct("=I")
_SK_MEMINFO = struct.Struct("=9I")  # the last one: frames dropped, linux/sock_diag.h
_IFREQ = struct.Struct("@16sH22x")


class SocketCanPort:
    """A raw CAN socket: stamps of controller or kernel, error frames, exact drop count.

    ``filters`` are applied by the kernel: other frames never reach this process; error frames always do.
    """

    holds_back = False

    def __init__(self, name: str, settings: config.CanBus, filters: Sequence[Filter] = ()) -> None:
        self._name = name
        self._channel = settings.channel
        self.stamps: Stamps = "kernel"
        self.kernel_drops = 0
        self._wall_clock = WallClock()
        self._controller = RemoteClock(CLOCK_WINDOW_S)
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            text = f"this kernel has no CAN ({error.strerror}); use the socketcand interface or another kernel"
            raise ConnectError(name, text) from None
        try:
            self._configure_socket(filters)
            self._socket.bind((settings.channel,))
            if not self._is_up():
                raise OSError(errno.ENETDOWN, "it is down")
        except OSError as error:
            self._socket.close()
            advice = _advise_on_error(error, settings)
            text = f"the CAN interface {settings.channel} cannot be opened ({error.strerror}); {advice}"
            raise ConnectError(name, text) from None

    def _configure_socket(self, filters: Sequence[Filter]) -> None:
        raw = self._socket
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        with contextlib.suppress(PermissionError):  # without CAP_NET_ADMIN the capped size stays
            raw.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
        raw.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        raw.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, STAMPING)
        raw.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, 0x1FFFFFFF)
        if filters:
            packed = b"".join(_CAN_FILTER.pack(*each) for each in filters)
            raw.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
        raw.setblocking(False)

    def _is_up(self) -> bool:
        """Return whether the interface is up: a socket also binds to one that is down, and then receives nothing."""
        asked = _IFREQ.pack(self._channel.encode()[:15], 0)
        return bool(_IFREQ.unpack(fcntl.ioctl(self._socket, SIOCGIFFLAGS, asked))[1] & IFF_UP)

    def receive_frames(self, ring: FrameRing, timeout_s: float) -> None:
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return
        wall_ahead_ns = self._wall_clock.measure_ahead_ns()
        for _ in range(FRAMES_PER_TURN):
            try:
                data, ancillary, _flags, _address = self._socket.recvmsg(CAN_FRAME.size, 128)
            except BlockingIOError:
                break
            except OSError as error:
                raise BusEnded(f"the CAN interface {self._channel} is down or gone ({error.strerror})") from None
            can_id, length, payload = CAN_FRAME.unpack(data)
            ring.append_frame(self._read_stamp(ancillary, wall_ahead_ns), can_id, payload[:length])
        self._query_drops()

    def _read_stamp(self, ancillary: list[tuple[int, int, bytes]], wall_ahead_ns: int) -> int:
        stamp_ns = None
        for _level, kind, value in ancillary:
            if kind == SO_TIMESTAMPING:
                seconds, nanoseconds, _, _, hard_s, hard_ns = _SCM_TIMESTAMPING.unpack(value)
                stamp_ns = convert_to_monotonic_ns(seconds * 1_000_000_000 + nanoseconds, wall_ahead_ns)
                if hard_s or hard_ns:
                    stamp_ns = self._convert_controller_stamp(hard_s * 1_000_000_000 + hard_ns, stamp_ns)
            elif kind == SO_RXQ_OVFL:
                self._count_drops(*_COUNT.unpack(value))
        return time.monotonic_ns() if stamp_ns is None else stamp_ns

    def _convert_controller_stamp(self, hard_ns: int, kernel_ns: int) -> int:
        """Convert a stamp of the controller's clock; the kernel's stamp is never earlier."""
        self.stamps = "hardware"
        return hard_ns - self._controller.track_ahead_ns(hard_ns, kernel_ns)

    def _query_drops(self) -> None:
        """Query the drop count: the count that comes with frames only reaches up to the last frame that was stored."""
        self._count_drops(
            _SK_MEMINFO.unpack(self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _SK_MEMINFO.size))[-1]
        )

    def _count_drops(self, count: int) -> None:
        """Add the kernel's 32-bit count; an older count than the last one is ignored."""
        ahead = (count - self.kernel_drops) & 0xFFFFFFFF
        if ahead < 1 << 31:
            self.kernel_drops += ahead

    def close(self) -> None:
        self._socket.close()


def _advise_on_error(error: OSError, settings: config.CanBus) -> str:
    if error.errno == errno.ENODEV:
        return "plug the adapter in, or choose a name that ip link shows"
    return f"bring it up: ip link set {settings.channel} up type can bitrate {settings.bitrate}"
