"""Receives through python-can: from adapters without a SocketCAN driver, and from the bus inside one process."""

import logging
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from fdhil import config
from fdhil.drivers.can.frame_ring import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, FrameRing
from fdhil.drivers.can.host_clock import RemoteClock, WallClock, convert_to_monotonic_ns
from fdhil.drivers.can.receive_port import BusEnded, Filter, Stamps
from fdhil.errors import ConnectError

if "asammdf" in sys.modules:
    import can
else:  # python-can imports it for MF4 logs, which costs half a second and 100 MB
    sys.modules["asammdf"] = None  # type: ignore[assignment] # so that its import fails
    try:
        import can
    finally:
        del sys.modules["asammdf"]

FRAMES_PER_TURN = 4096
CLOCK_WINDOW_S = 2.0
# errors of an interface without its driver, Python package, device or correct options
_CANNOT_OPEN = (can.CanError, OSError, ImportError, ValueError, TypeError, NameError, AttributeError)
_BROKEN = (can.CanError, OSError, ValueError, LookupError)
# options against acknowledging; interfaces that are not listed have none
LISTEN_ONLY: Mapping[str, Mapping[str, Any]] = {
    "slcan": {"listen_only": True},
    "pcan": {"state": can.BusState.PASSIVE},
    "kvaser": {"driver_mode": False},
    "vector": {"listen_only": True},
    "seeedstudio": {"operation_mode": "silent"},
    "cantact": {"monitor": True},
    "systec": {"state": can.BusState.PASSIVE},
}
# the library stamps their frames itself, when it reads them
_WITHOUT_CLOCK = ("slcan", "robotell", "seeedstudio")

# the library logs its search for drivers; the error of a port that cannot be opened suffices
logging.getLogger("can").addHandler(logging.NullHandler())


class PythonCanPort:
    """An adapter opened by python-can, for listening.

    The stamps are those of the adapter's clock, whose zero is unknown, converted to the host's by the quickest frames;
    or the library's own, taken when a frame was read. Frames lost by the adapter or its driver are not counted.
    """

    holds_back = False
    kernel_drops = 0

    def __init__(self, name: str, settings: config.CanBus, filters: Sequence[Filter] = ()) -> None:
        self._what = f"the {settings.interface} adapter {settings.channel}"
        self.stamps: Stamps = "host" if settings.interface in _WITHOUT_CLOCK else "adapter"
        self._clock = RemoteClock(CLOCK_WINDOW_S)
        try:
            self._bus = can.Bus(
                **build_bus_arguments(settings), can_filters=_convert_filters(filters), ignore_config=True
            )
        except _CANNOT_OPEN as error:
            advice = "plug it in, install its driver and its Python package, or use SocketCAN"
            raise ConnectError(name, f"{self._what} cannot be opened ({_shorten_error(error)}); {advice}") from None

    def receive_frames(self, ring: FrameRing, timeout_s: float) -> None:
        wait: float = timeout_s
        for _ in range(FRAMES_PER_TURN):
            try:
                message = self._bus.recv(wait)
            except _BROKEN as error:
                raise BusEnded(f"{self._what} is gone, or sent an invalid frame ({_shorten_error(error)})") from None
            if message is None:
                return
            now_ns, stamp_ns = time.monotonic_ns(), round(message.timestamp * 1e9)
            append_message(ring, message, min(now_ns, stamp_ns - self._clock.track_ahead_ns(stamp_ns, now_ns)))
            wait = 0.0

    def close(self) -> None:
        try:
            self._bus.shutdown()
        except _BROKEN:
            return


def build_bus_arguments(settings: config.CanBus) -> dict[str, Any]:
    """Return the arguments of ``can.Bus``; the configured ``options`` take precedence."""
    channel: str | int = int(settings.channel) if settings.channel.isdecimal() else settings.channel
    quiet = LISTEN_ONLY.get(settings.interface, {}) if settings.listen_only else {}
    asked = {"interface": settings.interface, "channel": channel, "bitrate": settings.bitrate}
    return asked | dict(quiet) | dict(settings.options)


def append_message(ring: FrameRing, message: can.Message, stamp_ns: int) -> None:
    can_id = message.arbitration_id | (EXTENDED_FLAG if message.is_extended_id else 0)
    can_id |= (ERROR_FLAG if message.is_error_frame else 0) | (REMOTE_FLAG if message.is_remote_frame else 0)
    data = bytes(min(message.dlc, 8)) if message.is_remote_frame else bytes(message.data[:8])  # keeps the DLC
    ring.append_frame(stamp_ns, can_id, data)


def _convert_filters(filters: Sequence[Filter]) -> list[dict[str, Any]] | None:
    plain = EXTENDED_FLAG | REMOTE_FLAG
    return [{"can_id": i & ~plain, "can_mask": m & ~plain, "extended": False} for i, m in filters] or None


def _shorten_error(error: BaseException) -> str:
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__


class VirtualPort:
    """python-can's bus inside one process; stamps are the sender's wall clock."""

    stamps: Stamps = "sender"
    holds_back = False
    kernel_drops = 0

    def __init__(self, name: str, settings: config.CanBus, _filters: Sequence[Filter] = ()) -> None:
        self._name = name
        self._wall_clock = WallClock()
        try:
            self._bus = can.Bus(interface="virtual", channel=settings.channel)
        except can.CanError as error:
            raise ConnectError(name, f"the virtual bus {settings.channel} cannot be opened ({error})") from None

    def receive_frames(self, ring: FrameRing, timeout_s: float) -> None:
        wait: float = timeout_s
        wall_ahead_ns = self._wall_clock.measure_ahead_ns()
        for _ in range(FRAMES_PER_TURN):
            message = self._bus.recv(wait)
            if message is None:
                return
            append_message(ring, message, convert_to_monotonic_ns(int(message.timestamp * 1e9), wall_ahead_ns))
            wait = 0.0

    def close(self) -> None:
        self._bus.shutdown()
