"""Keeps the last seconds of all frames of a bus, as they came, for the black box."""

from __future__ import annotations

from collections import deque

import numpy as np

from fdhil.drivers.can.frames import ERROR_FLAG, FRAME, Frames

KEPT_S = 10.0


class FrameHistory:
    """Blocks of frames; whole blocks go once all of their frames are older than ``kept_s`` (by receive stamp)."""

    def __init__(self, kept_s: float = KEPT_S) -> None:
        self._kept_ns = round(kept_s * 1e9)
        self._blocks: deque[Frames] = deque()

    def add(self, frames: Frames) -> None:
        """Keep a block."""
        if not frames.size:
            return
        self._blocks.append(frames)
        oldest = int(frames["t_ns"][-1]) - self._kept_ns
        while int(self._blocks[0]["t_ns"][-1]) < oldest:
            self._blocks.popleft()

    def frames(self) -> Frames:
        """Return what is kept, oldest first; may be called from another thread than ``add``."""
        return np.concatenate([np.empty(0, FRAME), *list(self._blocks)])


def candump(bus: str, frames: Frames) -> str:
    """Return frames as lines of a ``candump -l`` log, which ``canplayer`` and others read; stamps are monotonic."""
    lines = []
    columns = (frames[name].tolist() for name in ("t_ns", "id", "dlc", "data"))
    for t_ns, can_id, length, data in zip(*columns, strict=True):
        shown = f"{can_id:08X}" if can_id & ERROR_FLAG or can_id > 0x7FF else f"{can_id:03X}"
        payload = int(data).to_bytes(8, "little")[:length].hex().upper()
        lines.append(f"({t_ns // 1_000_000_000}.{t_ns // 1000 % 1_000_000:06d}) {bus} {shown}#{payload}\n")
    return "".join(lines)
