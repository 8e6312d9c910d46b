"""Holds CAN frames in bulk, in a preallocated ring between receive thread and decoder.

A frame is 24 bytes: ``t_ns`` host-monotonic receive stamp, ``id`` with the flags of SocketCAN (0x20000000 error,
0x40000000 remote, 0x80000000 extended), ``dlc`` and ``data`` as a little-endian 64 bit word, so that a block is decoded
with shifts and masks instead of a loop.
"""

import mmap
import struct
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

FRAME = np.dtype([("t_ns", "<i8"), ("id", "<u4"), ("dlc", "u1"), ("pad", "u1", (3,)), ("data", "<u8")])
Frames = npt.NDArray[np.void]
_PACK = struct.Struct("<qIB3x8s")

ERROR_FLAG = 0x20000000
REMOTE_FLAG = 0x40000000
EXTENDED_FLAG = 0x80000000

DEFAULT_RING_FRAMES = 1 << 16


def pack_frames(rows: Iterable[tuple[int, int, bytes]]) -> Frames:
    """Pack (t_ns, id, data) tuples into frames; data longer than 8 bytes is cut."""
    raw = b"".join(_PACK.pack(t_ns, can_id, min(len(data), 8), data) for t_ns, can_id, data in rows)
    return np.frombuffer(raw, FRAME)


def map_pages(frames: int) -> mmap.mmap:
    """Return zeroed memory for this many frames on separate pages, which are returned to the system when released.

    Memory freed on a thread's heap stays with that thread, often fragmented.
    """
    return mmap.mmap(-1, frames * FRAME.itemsize, flags=mmap.MAP_PRIVATE)


class FrameRing:
    """A ring of frames between one writer (the receive thread) and one reader.

    Nothing is allocated while it runs. It lies on separate memory pages, since a reconnected bus has a new ring in
    another thread. When the reader is late the newest frames are discarded and counted in ``overflow_count``:
    the gap has a known size, and no frame is torn.
    """

    def __init__(self, capacity: int = DEFAULT_RING_FRAMES) -> None:
        self._buffer = map_pages(capacity)
        self._frames = np.frombuffer(self._buffer, FRAME)
        self._capacity = capacity
        self._written = 0
        self._read = 0
        self.overflow_count = 0

    @property
    def received_count(self) -> int:
        """Frames received since the start, including discarded ones."""
        return self._written + self.overflow_count

    @property
    def free_slots(self) -> int:
        return self._capacity - (self._written - self._read)

    def append_frame(self, t_ns: int, can_id: int, data: bytes) -> None:
        """Store one frame (writer's side only); ``data`` has at most 8 bytes."""
        written = self._written
        if written - self._read >= self._capacity:
            self.overflow_count += 1
            return
        place = written % self._capacity * FRAME.itemsize
        _PACK.pack_into(self._buffer, place, t_ns, can_id, len(data), data)
        self._written = written + 1  # last, so that the reader only sees complete slots

    def drain_frames(self) -> Frames:
        """Return a copy of all waiting frames, oldest first (reader's side only)."""
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
