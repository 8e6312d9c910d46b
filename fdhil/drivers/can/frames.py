"""Holds CAN frames in bulk: in a preallocated ring between receive thread and decoder; tells error frames as notices.

A frame is 24 bytes: ``t_ns`` host-monotonic receive stamp, ``id`` with the flags of SocketCAN (0x20000000 error,
0x40000000 remote, 0x80000000 extended), ``dlc`` and ``data`` as a little-endian 64 bit word, so that a block is
decoded with shifts and masks instead of a loop.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from fdhil.records import Notice

FRAME = np.dtype([("t_ns", "<i8"), ("id", "<u4"), ("dlc", "u1"), ("pad", "u1", (3,)), ("data", "<u8")])
Frames = npt.NDArray[np.void]
_PACK = struct.Struct("<qIB3x8s")

ERROR_FLAG = 0x20000000
REMOTE_FLAG = 0x40000000
EXTENDED_FLAG = 0x80000000
# classes of an error frame's id, linux/can/error.h
ERROR_CONTROLLER = 0x004
ERROR_BUS_OFF = 0x040
ERROR_RESTARTED = 0x100
# data[1] of a controller error
CONTROLLER_WARNING = 0x04 | 0x08
CONTROLLER_PASSIVE = 0x10 | 0x20

DEFAULT_RING_FRAMES = 1 << 16


def frames_of(rows: Iterable[tuple[int, int, bytes]]) -> Frames:
    """Return frames from (t_ns, id, data) rows; data longer than 8 bytes is cut."""
    raw = b"".join(_PACK.pack(t_ns, can_id, min(len(data), 8), data) for t_ns, can_id, data in rows)
    return np.frombuffer(raw, FRAME)


class FrameRing:
    """A ring of frames between one writer (the receive thread) and one reader.

    Slots are reused, nothing is allocated while it runs. When the reader is late the newest frames are refused and
    counted in ``overflowed``: a hole with a known size, never a torn frame.
    """

    def __init__(self, capacity: int = DEFAULT_RING_FRAMES) -> None:
        self._buffer = bytearray(capacity * FRAME.itemsize)
        self._frames = np.frombuffer(self._buffer, FRAME)
        self._capacity = capacity
        self._written = 0
        self._read = 0
        self.overflowed = 0

    @property
    def received(self) -> int:
        """Frames that came in since the start, those that found no room included."""
        return self._written + self.overflowed

    @property
    def room(self) -> int:
        """Frames that still find room."""
        return self._capacity - (self._written - self._read)

    def append(self, t_ns: int, can_id: int, data: bytes) -> None:
        """Store one frame (writer's side only); ``data`` has at most 8 bytes."""
        written = self._written
        if written - self._read >= self._capacity:
            self.overflowed += 1
            return
        place = written % self._capacity * FRAME.itemsize
        _PACK.pack_into(self._buffer, place, t_ns, can_id, len(data), data)
        self._written = written + 1  # last: the reader sees a slot only when it is whole

    def drain(self) -> Frames:
        """Return a copy of all frames that wait, oldest first (reader's side only)."""
        start, stop = self._read, self._written
        first, last = start % self._capacity, stop % self._capacity
        if start == stop:
            return np.empty(0, FRAME)
        if first < last:
            block = self._frames[first:last].copy()
        else:
            block = np.concatenate([self._frames[first:], self._frames[:last]])
        self._read = stop
        return block


def error_notices(frames: Frames) -> list[Notice]:
    """Translate error frames into notices: BusOff, ErrorPassive, BusRestarted, each at most once per block.

    >>> [n.code for n in error_notices(frames_of([(0, ERROR_FLAG | ERROR_BUS_OFF, bytes(8))]))]
    ['BusOff']
    """
    errors = frames[frames["id"] & ERROR_FLAG != 0]
    if errors.size == 0:
        return []
    classes = int(np.bitwise_or.reduce(errors["id"] & 0x1FFFFFFF))
    controller = errors[errors["id"] & ERROR_CONTROLLER != 0]
    detail = int(np.bitwise_or.reduce(controller["data"] >> np.uint64(8) & np.uint64(0xFF))) if controller.size else 0
    notices = []
    if classes & ERROR_BUS_OFF:
        text = "The CAN controller went bus-off, an offset in a drive cannot be changed; check the wiring and bit rate."
        notices.append(Notice("BusOff", "MAJOR", text))
    if classes & ERROR_RESTARTED:
        text = "The CAN controller was restarted; what the drives hold must be read before anything is written."
        notices.append(Notice("BusRestarted", "MAJOR", text))
    if detail & CONTROLLER_PASSIVE:
        text = "The CAN controller is error-passive, frames may be lost; check termination, shield and bit rate."
        notices.append(Notice("ErrorPassive", "MAJOR", text))
    elif detail & CONTROLLER_WARNING:
        text = "The CAN controller counts errors (warning level); check termination and shield."
        notices.append(Notice("ErrorPassive", "minor", text))
    return notices
