"""Keeps the last seconds of all frames of a bus for the black box."""

from collections import deque

import numpy as np

from fdhil.drivers.can.candump_log import format_id
from fdhil.drivers.can.frame_ring import FRAME, REMOTE_FLAG, Frames, map_pages

KEPT_S = 10.0
CHUNK_FRAMES = 1 << 13


class FrameHistory:
    """The frames of the last ``kept_s`` (by receive stamp), copied into chunks of memory pages.

    A chunk is released once all of its frames are older. The received blocks have any size: keeping those of a frame
    flood would fragment the heap.
    """

    def __init__(self, kept_s: float = KEPT_S) -> None:
        self._kept_ns = round(kept_s * 1e9)
        self._chunks: deque[Frames] = deque()  # filled part of each
        self._newest, self._filled = np.empty(0, FRAME), CHUNK_FRAMES

    def add_frames(self, frames: Frames) -> None:
        if not frames.size:
            return
        oldest_ns = int(frames["t_ns"][-1]) - self._kept_ns
        while frames.size:
            frames = self._fill_chunk(frames)
        while int(self._chunks[0]["t_ns"][-1]) < oldest_ns:
            self._chunks.popleft()

    def _fill_chunk(self, frames: Frames) -> Frames:
        if self._filled == CHUNK_FRAMES:
            self._newest, self._filled = np.frombuffer(map_pages(CHUNK_FRAMES), FRAME), 0
            self._chunks.append(self._newest[:0])
        begin, self._filled = self._filled, min(CHUNK_FRAMES, self._filled + frames.size)
        self._newest[begin : self._filled] = frames[: self._filled - begin]
        self._chunks[-1] = self._newest[: self._filled]
        return frames[self._filled - begin :]

    def get_frames(self) -> Frames:
        """Return the kept frames, oldest first; may be called from another thread than ``add_frames``."""
        kept = np.concatenate([np.empty(0, FRAME), *list(self._chunks)])
        if not kept.size:
            return kept
        recent = kept["t_ns"] >= kept["t_ns"][-1] - self._kept_ns
        return kept[int(recent.argmax()) :]


def format_candump(bus: str, frames: Frames) -> str:
    """Format frames as a ``candump -l`` log, which ``canplayer`` and others read; stamps are monotonic."""
    pieces = range(0, frames.size, CHUNK_FRAMES)  # limits the number of line objects
    return "".join(_format_lines(bus, frames[begin : begin + CHUNK_FRAMES]) for begin in pieces)


def _format_lines(bus: str, frames: Frames) -> str:
    lines = []
    columns = (frames[name].tolist() for name in ("t_ns", "id", "dlc", "data"))
    for t_ns, can_id, length, data in zip(*columns, strict=True):
        if can_id & REMOTE_FLAG:
            payload = f"R{length or ''}"
        else:
            payload = int(data).to_bytes(8, "little")[:length].hex().upper()
        lines.append(f"({t_ns // 1_000_000_000}.{t_ns // 1000 % 1_000_000:06d}) {bus} {format_id(can_id)}#{payload}\n")
    return "".join(lines)
