"""A program longer than the guard's ring: armed with its first seconds, the rest is planned and handed on as it runs.

Each block passed limits and gate alone. When the stream falls behind, or a block is refused, no more rows come: the
guard then ramps to zero by itself (``TableStarved``), with a second of reserve left.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from fdhil.config import MachineConfig
from fdhil.correction.streaming import StreamBlock, stream
from fdhil.records import Float, Int, Parameters, Reason, Trajectory

RING_S = 10.0  # of rows that the guard is given ahead of where the machine is; it ramps down below 1 s
FIRST_BLOCKS = 5
PIECE_ROWS = 500

Rows = dict[str, list[int]]


class Piece(NamedTuple):
    """Rows from ``first`` on: demand and offset per axis, in increments; ``final``: no more follow."""

    first: int
    demand: Rows
    offset: Rows
    final: bool


@dataclass(slots=True)
class Stream:
    """The blocks of one program in the guard's increments; ``end`` is one past the last row handed out.

    ``before_um`` and ``after_um`` are the contour errors of the first blocks. ``refused`` is why no more blocks come.
    """

    reference: Trajectory
    config: MachineConfig
    program_digest: str
    blocks: Iterator[StreamBlock]
    end: int = 0
    final: bool = False
    refused: tuple[Reason, ...] = ()
    before_um: Float = field(default_factory=lambda: np.empty(0))
    after_um: Float = field(default_factory=lambda: np.empty(0))
    largest_um: float = 0.0

    @staticmethod
    def of(
        reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, program_digest: str
    ) -> Stream:
        """Begin to plan; nothing is solved yet."""
        rows = reference.time_s.size
        pieces = (
            {axis: path[first : first + PIECE_ROWS] for axis, path in reference.position_mm.items()}
            for first in range(0, rows, PIECE_ROWS)
        )
        return Stream(reference, config, program_digest, stream(pieces, models, config))

    def take(self, count: int = 1) -> Piece:
        """Return the rows of the next ``count`` blocks; none when none is left."""
        first = self.end
        offsets: dict[str, list[Float]] = {axis: [] for axis in self.reference.axes}
        for block in islice(self.blocks, count):
            if block.refused:
                self.refused = block.refused
                break
            for axis, values in block.offset_um.items():
                offsets[axis].append(np.asarray(values))
                self.largest_um = max(self.largest_um, float(np.abs(values).max(initial=0.0)))
            if first == 0:
                self.before_um = np.append(self.before_um, block.before_um)
                self.after_um = np.append(self.after_um, block.after_um)
            self.end += block.before_um.size
            self.final = block.final
        demand = {axis: self._counts(axis, self.reference.position_mm[axis][first : self.end]) for axis in offsets}
        offset = {
            axis: self._counts(axis, np.concatenate(parts) * 1e-3) if parts else [] for axis, parts in offsets.items()
        }
        return Piece(first, demand, offset, self.final)

    def _counts(self, axis: str, mm: Float) -> list[int]:
        scaling = self.config.axis[axis].scaling
        whole: Int = np.rint(mm * scaling.sign * scaling.increments_per_mm).astype(np.int64)
        counts: list[int] = whole.tolist()
        return counts

    @property
    def done(self) -> bool:
        """Whether no more rows come."""
        return self.final or bool(self.refused)

    def lacks(self, status: Mapping[str, Any]) -> bool:
        """Whether the guard, by its status, holds less than the ring ahead of the machine."""
        if self.done or not status.get("rows"):
            return False
        ahead = int(status["rows"][1]) - int(status.get("row") or 0)
        return ahead * self.reference.dt_s < RING_S


def worth_streaming(reference: Trajectory, method: str | None) -> bool:
    """Whether a program is longer than what the guard is given at first; only the inverse can be streamed."""
    return method in (None, "inverse") and float(reference.time_s[-1]) > RING_S
