"""The frames of a machine whose drives follow a demand two cycles late."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fdhil.config import MachineConfig, parse_config
from fdhil.drivers.can.frame_ring import Frames, pack_frames
from tests.bench import bench_axis

Row = tuple[int, int, bytes]


def build_machine_config(
    folder: Path = Path(), axes: str = "X", bus: dict[str, object] | None = None, **sections: object
) -> MachineConfig:
    """Return the bench's config with these axes; ``drive``, ``voltage`` apply to every axis, others are sections."""
    per_axis: dict[str, object] = {
        key: sections.pop(key) for key in ("drive", "voltage", "correction", "feedforward") if key in sections
    }
    axis = bench_axis(corrected=False, **per_axis)
    document = {
        "machine": {"name": "bench"},
        "axis": dict.fromkeys(axes, axis),
        "bus": {"can0": bus or {"interface": "virtual", "channel": "fdhil-tests"}},
        **sections,
    }
    return parse_config(document, folder=folder)


@dataclass
class FrameBuilder:
    """Frames of one drive over ``n`` SYNCs; row k of every signal is the drive's value at SYNC k."""

    n: int = 200
    node_id: int = 1
    counter: bool = True
    delay: int = 2
    start_ns: int = 1_000_000_000
    period_ns: int = 1_000_000

    def __post_init__(self) -> None:
        k = np.arange(-8, self.n + 8)
        self.reference = {int(i): round(3e5 * math.sin(0.02 * i)) for i in k}
        self.offset = {int(i): round(100 * math.sin(0.05 * i)) for i in k}

    def build_tpdo1(self, k: int) -> tuple[int, int]:
        return 1000 + 7 * k, -50 * k

    def build_tpdo2(self, k: int) -> tuple[int, int, int]:
        return 0x1237, (k * 3) % 200 - 100, (k * 5) % 3000 - 1500

    def build_rows(self) -> list[Row]:
        """Frames (t_ns, id, data) in order: SYNC k, TPDOs, then the targets for SYNC k+1."""
        out: list[Row] = [*self.build_targets(-1)]
        for k in range(self.n):
            out += [self.build_sync(k), *self.build_tpdos(k), *self.build_targets(k)]
        return out

    def time_ns(self, k: int, offset: float) -> int:
        return self.start_ns + int((k + offset) * self.period_ns)

    def build_sync(self, k: int) -> Row:
        return self.time_ns(k, 0), 0x80, bytes([k % 240 + 1]) if self.counter else b""

    def build_tpdos(self, k: int) -> list[Row]:
        node = self.node_id
        out = [
            (self.time_ns(k, 0.1), 0x180 + node, struct.pack("<ii", *self.build_tpdo1(k))),
            (self.time_ns(k, 0.2), 0x280 + node, struct.pack("<Hhh", *self.build_tpdo2(k))),
        ]
        if k % 10 == 0:
            shown = self.reference[k] + self.offset[k]
            read_back = self.offset[k + self.delay]
            out.append((self.time_ns(k, 0.3), 0x380 + node, struct.pack("<ii", shown, read_back)))
            out.append((self.time_ns(k, 0.35), 0x480 + node, struct.pack("<Ibh", 1 << 16 if k >= 100 else 0, 8, 0)))
        return out

    def build_targets(self, k: int) -> list[Row]:
        """Return the targets: those sent after SYNC k are latched at SYNC k+1: r[k+1+delay]."""
        node, row = self.node_id, k + 1 + self.delay
        return [
            (self.time_ns(k, 0.5), 0x200 + node, struct.pack("<Hi", 0x0F, self.reference[row])),
            (self.time_ns(k, 0.6), 0x300 + node, struct.pack("<i", self.offset[row])),
        ]

    def build_frames(self) -> Frames:
        return pack_frames(self.build_rows())
